//! Nearest and second nearest center of many rows: an f32 pass with an error bound, and f64 where
//! the bound leaves a doubt.
//!
//! Centers are compared by s = ‖c‖²/2 − x·c, which orders them as the distance does, since
//! ‖x − c‖² = ‖x‖² + 2s. In f32 over w columns s is off by at most
//! γ(w + 5)(‖x‖ + ‖c‖)‖c‖, see [`gamma`], counting the rounding of x and c themselves.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::nearest_center;
use crate::matrix::{CHUNK_ROWS, Matrix, gamma, squared_distance, underflow};
use crate::tiles::{RowSet, TILE_ROWS, new_tile, pack};

/// Centers scored together; with as many accumulators no multiply-add waits for another.
const PACK: usize = 8;

/// Centers laid out for the pass, in packs of [`PACK`] and, for the bounds of the iteration, in at
/// most eight groups of packs.
#[derive(Debug)]
pub(super) struct PackedCenters<'a> {
    exact: &'a [f64],
    width: usize,
    /// `[pack][column][PACK]`, negated.
    negated: Vec<f32>,
    /// ‖c‖²/2; infinite for the padding of the last pack.
    half_norms: Vec<f32>,
    max_norm: f64,
}

/// f32 scores of one row against some of the centers.
#[derive(Debug, Clone, Copy)]
pub(super) struct RowScores {
    pub(super) label: u32,
    pub(super) best: f32,
    pub(super) second: f32,
}

/// Turns scores of one row into bounds on distances.
#[derive(Debug, Clone, Copy)]
pub(super) struct DistanceBounds {
    squared_norm: f64,
    slack: f64,
}

impl DistanceBounds {
    pub(super) fn at_least(&self, score: f32) -> f64 {
        (self.squared_norm + 2.0 * f64::from(score) - self.slack)
            .max(0.0)
            .sqrt()
    }

    pub(super) fn at_most(&self, score: f32) -> f64 {
        (self.squared_norm + 2.0 * f64::from(score) + self.slack)
            .max(0.0)
            .sqrt()
    }
}

/// What f64 says of one row.
#[derive(Debug)]
pub(super) struct ExactBounds {
    pub(super) label: u32,
    /// Distance to the label's center.
    pub(super) distance: f64,
    /// Per group, the distance to its nearest center that is not the label.
    pub(super) groups: Vec<f64>,
}

impl<'a> PackedCenters<'a> {
    /// Groups at most: one bit of a byte each.
    pub(super) const MAX_GROUPS: usize = 8;

    pub(super) fn new(exact: &'a [f64], width: usize) -> Self {
        let n_packs = (exact.len() / width).div_ceil(PACK);
        let mut negated = vec![0.0; n_packs * width * PACK];
        let mut half_norms = vec![f32::INFINITY; n_packs * PACK];
        let mut max_norm = 0.0f64;
        for (c, center) in exact.chunks_exact(width).enumerate() {
            let squared: f64 = center.iter().map(|v| v * v).sum();
            half_norms[c] = (squared / 2.0) as f32;
            max_norm = max_norm.max(squared.sqrt());
            for (column, &value) in center.iter().enumerate() {
                negated[((c / PACK) * width + column) * PACK + c % PACK] = -value as f32;
            }
        }
        Self {
            exact,
            width,
            negated,
            half_norms,
            max_norm,
        }
    }

    pub(super) fn exact(&self) -> &[f64] {
        self.exact
    }

    pub(super) fn max_norm(&self) -> f64 {
        self.max_norm
    }

    fn n_packs(&self) -> usize {
        self.half_norms.len() / PACK
    }

    /// Centers in a group, a whole number of packs.
    pub(super) fn group_size(n_clusters: usize) -> usize {
        n_clusters.div_ceil(PACK).div_ceil(Self::MAX_GROUPS) * PACK
    }

    fn size(&self) -> usize {
        Self::group_size(self.exact.len() / self.width)
    }

    pub(super) fn n_groups(&self) -> usize {
        (self.exact.len() / self.width).div_ceil(self.size())
    }

    pub(super) fn group_of(&self, label: usize) -> usize {
        label / self.size()
    }

    /// The packs of one group.
    pub(super) fn packs(&self, group: usize) -> Range<usize> {
        let packs = self.size() / PACK;
        group * packs..((group + 1) * packs).min(self.n_packs())
    }

    /// Half the distance from each center to the nearest other, a hair less for rounding.
    pub(super) fn half_gaps(&self) -> Vec<f64> {
        let rows: Vec<&[f64]> = self.exact.chunks_exact(self.width).collect();
        rows.par_iter()
            .enumerate()
            .map(|(a, center)| {
                let others = rows.iter().enumerate().filter(|(b, _)| *b != a);
                let nearest = others
                    .map(|(_, o)| squared_distance(center, o))
                    .fold(f64::INFINITY, f64::min);
                nearest.sqrt() / 2.0 * (1.0 - 1e-6)
            })
            .collect()
    }

    /// Bounds that hold if the best score is the smallest beyond the rounding of f32, else `None`.
    pub(super) fn certain(&self, scores: &RowScores, squared_norm: f32) -> Option<DistanceBounds> {
        let squared_norm = f64::from(squared_norm);
        let sum = gamma(self.width + 8);
        let lost = underflow(self.width).powi(2);
        let norms = squared_norm.sqrt() + self.max_norm;
        let doubt = sum * norms * self.max_norm + lost;
        let slack = 2.0 * doubt + sum * squared_norm + lost;
        let gap = f64::from(scores.second) - f64::from(scores.best);
        // Squares that may have overflowed count as doubt, and so does NaN.
        let in_range = norms * norms < f64::from(f32::MAX) / 4.0;
        (in_range && gap > 2.0 * doubt).then_some(DistanceBounds {
            squared_norm,
            slack,
        })
    }

    /// The verdict of f64, against all centers.
    pub(super) fn exact_bounds(&self, data: &Matrix, row: usize) -> ExactBounds {
        let mut point = vec![0.0; self.width];
        data.read_row(row, &mut point);
        let (label, squared) = nearest_center(self.exact, &point);
        let mut groups = vec![f64::INFINITY; self.n_groups()];
        for (c, center) in self.exact.chunks_exact(self.width).enumerate() {
            if c != label as usize {
                let group = &mut groups[self.group_of(c)];
                *group = group.min(squared_distance(center, &point).sqrt());
            }
        }
        ExactBounds {
            label,
            distance: squared.sqrt(),
            groups,
        }
    }
}

/// The cluster of every row of `data`.
pub(super) fn assign(data: &Matrix, centers: &[f64]) -> Vec<u32> {
    let packed = PackedCenters::new(centers, data.n_features());
    let mut labels = vec![0; data.n_rows()];
    labels
        .par_chunks_mut(CHUNK_ROWS)
        .enumerate()
        .for_each(|(chunk, labels)| {
            Arch::new().dispatch(Assign {
                packed: &packed,
                data,
                start: chunk * CHUNK_ROWS,
                labels,
            });
        });
    labels
}

struct Assign<'a> {
    packed: &'a PackedCenters<'a>,
    data: &'a Matrix,
    start: usize,
    labels: &'a mut [u32],
}

impl WithSimd for Assign<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let mut tile = new_tile(self.data.n_features());
        let (mut scores, mut norms) = (TileScores::default(), [0.0; TILE_ROWS]);
        let rows = RowSet::Range {
            start: self.start,
            end: self.start + self.labels.len(),
        };
        for (index, labels) in self.labels.chunks_mut(TILE_ROWS).enumerate() {
            pack(self.data, rows, index * TILE_ROWS, labels.len(), &mut tile);
            squared_norms(simd, &tile, &mut norms);
            self.packed
                .score_tile(simd, &tile, 0..self.packed.n_packs(), &mut scores);
            for (at, label) in labels.iter_mut().enumerate() {
                let row = self.start + index * TILE_ROWS + at;
                *label = match self.packed.certain(&scores.of(at), norms[at]) {
                    Some(_) => scores.label[at],
                    None => self.packed.exact_bounds(self.data, row).label,
                };
            }
        }
    }
}

/// The same centers in an order that puts near ones side by side, so that the groups of the
/// iteration are compact: each group starts at the first center left and takes the nearest to it.
pub(super) fn neighbors_together(centers: &[f64], width: usize) -> Vec<f64> {
    let rows: Vec<&[f64]> = centers.chunks_exact(width).collect();
    let size = PackedCenters::group_size(rows.len());
    let mut left: Vec<usize> = (0..rows.len()).collect();
    let mut ordered = Vec::with_capacity(centers.len());
    while let Some(&first) = left.first() {
        left.sort_by(|&a, &b| {
            let distance = |row: usize| squared_distance(rows[row], rows[first]);
            distance(a).total_cmp(&distance(b)).then(a.cmp(&b))
        });
        for row in left.drain(..size.min(left.len())) {
            ordered.extend_from_slice(rows[row]);
        }
        left.sort_unstable();
    }
    ordered
}

/// The scores of a tile, one array per field.
#[derive(Debug, Clone)]
pub(super) struct TileScores {
    label: [u32; TILE_ROWS],
    best: [f32; TILE_ROWS],
    second: [f32; TILE_ROWS],
}

impl Default for TileScores {
    fn default() -> Self {
        Self {
            label: [0; TILE_ROWS],
            best: [0.0; TILE_ROWS],
            second: [0.0; TILE_ROWS],
        }
    }
}

impl TileScores {
    pub(super) fn of(&self, at: usize) -> RowScores {
        RowScores {
            label: self.label[at],
            best: self.best[at],
            second: self.second[at],
        }
    }
}

/// Squared norms of the tile's rows.
#[inline(always)]
pub(super) fn squared_norms<S: Simd>(simd: S, tile: &[f32], norms: &mut [f32; TILE_ROWS]) {
    for from in (0..TILE_ROWS).step_by(S::F32_LANES) {
        let mut norm = simd.splat_f32s(0.0);
        for column in tile.chunks_exact(TILE_ROWS) {
            let x = S::as_simd_f32s(&column[from..from + S::F32_LANES]).0[0];
            norm = simd.mul_add_f32s(x, x, norm);
        }
        S::as_mut_simd_f32s(&mut norms[from..from + S::F32_LANES]).0[0] = norm;
    }
}

impl PackedCenters<'_> {
    /// Scores of the tile's rows against the centers of `packs`.
    #[inline(always)]
    pub(super) fn score_tile<S: Simd>(
        &self,
        simd: S,
        tile: &[f32],
        packs: Range<usize>,
        scores: &mut TileScores,
    ) {
        for from in (0..TILE_ROWS).step_by(S::F32_LANES) {
            let lanes = from..from + S::F32_LANES;
            let mut best = simd.splat_f32s(f32::INFINITY);
            let mut second = best;
            let mut label = simd.splat_u32s(0);
            for pack in packs.clone() {
                let negated = &self.negated[pack * self.width * PACK..][..self.width * PACK];
                let half_norms = &self.half_norms[pack * PACK..][..PACK];
                let mut sums: [S::f32s; PACK] =
                    std::array::from_fn(|c| simd.splat_f32s(half_norms[c]));
                let (values, _) = negated.as_chunks::<PACK>();
                for (column, values) in tile.chunks_exact(TILE_ROWS).zip(values) {
                    let x = S::as_simd_f32s(&column[lanes.clone()]).0[0];
                    for c in 0..PACK {
                        sums[c] = simd.mul_add_f32s(x, simd.splat_f32s(values[c]), sums[c]);
                    }
                }
                for (c, &score) in sums.iter().enumerate() {
                    let better = simd.less_than_f32s(score, best);
                    second = simd.select_f32s(better, best, simd.min_f32s(second, score));
                    best = simd.select_f32s(better, score, best);
                    let number = simd.splat_u32s((pack * PACK + c) as u32);
                    label = simd.select_u32s(better, number, label);
                }
            }
            S::as_mut_simd_f32s(&mut scores.best[lanes.clone()]).0[0] = best;
            S::as_mut_simd_f32s(&mut scores.second[lanes.clone()]).0[0] = second;
            S::as_mut_simd_u32s(&mut scores.label[lanes.clone()]).0[0] = label;
        }
    }
}
