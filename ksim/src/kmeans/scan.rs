//! Nearest and second nearest center of many rows: an f32 pass with an error bound, and f64 where
//! the bound leaves a doubt.
//!
//! Centers are compared by s = ‖c‖²/2 − x·c, which orders them as the distance does, since
//! ‖x − c‖² = ‖x‖² + 2s. In f32 over w columns s is off by at most
//! (w + 5)u(‖x‖ + ‖c‖)‖c‖, u = 2⁻²⁴, counting the rounding of x and c themselves.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::nearest_center;
use crate::matrix::{CHUNK_ROWS, Matrix};
use crate::tiles::{RowSet, TILE_ROWS, new_tile, pack};

/// Centers scored together; with as many accumulators no multiply-add waits for another.
const GROUP: usize = 8;

/// What is known of a row after a pass.
#[derive(Debug, Clone, Copy)]
pub(super) struct Nearest {
    pub(super) label: u32,
    /// At least the distance to the label's center.
    pub(super) upper: f64,
    /// At most the distance to any other center.
    pub(super) lower: f64,
}

/// Centers laid out for the pass.
#[derive(Debug)]
pub(super) struct PackedCenters<'a> {
    exact: &'a [f64],
    width: usize,
    /// `[group][column][GROUP]`, negated.
    negated: Vec<f32>,
    /// ‖c‖²/2; infinite for the padding of the last group.
    half_norms: Vec<f32>,
    max_norm: f64,
}

impl<'a> PackedCenters<'a> {
    pub(super) fn new(exact: &'a [f64], width: usize) -> Self {
        let n_groups = (exact.len() / width).div_ceil(GROUP);
        let mut negated = vec![0.0; n_groups * width * GROUP];
        let mut half_norms = vec![f32::INFINITY; n_groups * GROUP];
        let mut max_norm = 0.0f64;
        for (c, center) in exact.chunks_exact(width).enumerate() {
            let squared: f64 = center.iter().map(|v| v * v).sum();
            half_norms[c] = (squared / 2.0) as f32;
            max_norm = max_norm.max(squared.sqrt());
            for (column, &value) in center.iter().enumerate() {
                negated[((c / GROUP) * width + column) * GROUP + c % GROUP] = -value as f32;
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

    /// One center, in f64.
    pub(super) fn center(&self, label: usize) -> &[f64] {
        &self.exact[label * self.width..][..self.width]
    }

    /// Calls `found(position in rows, what was found)` for every row of the set.
    pub(super) fn nearest(
        &self,
        data: &Matrix,
        rows: RowSet<'_>,
        found: &mut dyn FnMut(usize, Nearest),
    ) {
        Arch::new().dispatch(Pass {
            centers: self,
            data,
            rows,
            found,
        });
    }

    /// Turns the scores of one row into a verdict.
    fn verdict(&self, data: &Matrix, row: usize, scores: Scores) -> Nearest {
        let unit = f64::from(f32::EPSILON) / 2.0;
        let squared_norm = f64::from(scores.squared_norm);
        let (best, second) = (f64::from(scores.best), f64::from(scores.second));
        let w = self.width as f64;
        let doubt = (w + 8.0) * unit * (squared_norm.sqrt() + self.max_norm) * self.max_norm;
        let slack = 2.0 * doubt + (w + 8.0) * unit * squared_norm;
        // Written so that NaN and infinity, which an overflow could bring, count as doubt.
        let certain = second - best > 2.0 * doubt && slack.is_finite();
        if certain {
            let upper = (squared_norm + 2.0 * best + slack).max(0.0).sqrt();
            let lower = (squared_norm + 2.0 * second - slack).max(0.0).sqrt();
            return Nearest {
                label: scores.label,
                upper,
                lower,
            };
        }
        let mut point = vec![0.0; self.width];
        data.read_row(row, &mut point);
        let (label, squared) = nearest_center(self.exact, &point);
        let others = self
            .exact
            .chunks_exact(self.width)
            .zip(0..)
            .filter(|(_, c)| *c != label);
        let lower = others
            .map(|(center, _)| crate::matrix::squared_distance(center, &point))
            .fold(f64::INFINITY, f64::min);
        Nearest {
            label,
            upper: squared.sqrt(),
            lower: lower.sqrt(),
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
            let start = chunk * CHUNK_ROWS;
            let rows = RowSet::Range {
                start,
                end: start + labels.len(),
            };
            packed.nearest(data, rows, &mut |at, nearest| labels[at] = nearest.label);
        });
    labels
}

/// f32 scores of one row.
#[derive(Debug, Clone, Copy)]
struct Scores {
    label: u32,
    best: f32,
    second: f32,
    squared_norm: f32,
}

/// The same for a tile, one array per field.
struct TileScores {
    label: [u32; TILE_ROWS],
    best: [f32; TILE_ROWS],
    second: [f32; TILE_ROWS],
    squared_norm: [f32; TILE_ROWS],
}

struct Pass<'a> {
    centers: &'a PackedCenters<'a>,
    data: &'a Matrix,
    rows: RowSet<'a>,
    found: &'a mut dyn FnMut(usize, Nearest),
}

impl WithSimd for Pass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let mut tile = new_tile(self.centers.width);
        let mut scores = TileScores {
            label: [0; TILE_ROWS],
            best: [0.0; TILE_ROWS],
            second: [0.0; TILE_ROWS],
            squared_norm: [0.0; TILE_ROWS],
        };
        let mut start = 0;
        while start < self.rows.len() {
            let count = TILE_ROWS.min(self.rows.len() - start);
            pack(self.data, self.rows, start, count, &mut tile);
            for from in (0..count).step_by(S::F32_LANES) {
                score_rows(simd, self.centers, &tile, from, &mut scores);
            }
            for at in 0..count {
                let row_scores = Scores {
                    label: scores.label[at],
                    best: scores.best[at],
                    second: scores.second[at],
                    squared_norm: scores.squared_norm[at],
                };
                let row = self.rows.row(start + at) as usize;
                (self.found)(start + at, self.centers.verdict(self.data, row, row_scores));
            }
            start += count;
        }
    }
}

/// Scores of one vector of rows, from place `from` of the tile, against all centers.
#[inline(always)]
fn score_rows<S: Simd>(
    simd: S,
    centers: &PackedCenters<'_>,
    tile: &[f32],
    from: usize,
    scores: &mut TileScores,
) {
    let lanes = from..from + S::F32_LANES;
    let column_at = |column: usize| {
        let (vectors, _) = S::as_simd_f32s(&tile[column * TILE_ROWS..][lanes.clone()]);
        vectors[0]
    };
    let mut best = simd.splat_f32s(f32::INFINITY);
    let mut second = best;
    let mut label = simd.splat_u32s(0);
    let groups = centers.negated.chunks_exact(centers.width * GROUP);
    for (group, (negated, half_norms)) in groups
        .zip(centers.half_norms.chunks_exact(GROUP))
        .enumerate()
    {
        let mut sums: [S::f32s; GROUP] = std::array::from_fn(|c| simd.splat_f32s(half_norms[c]));
        for (column, values) in negated.chunks_exact(GROUP).enumerate() {
            let x = column_at(column);
            for c in 0..GROUP {
                sums[c] = simd.mul_add_f32s(x, simd.splat_f32s(values[c]), sums[c]);
            }
        }
        for (c, &score) in sums.iter().enumerate() {
            let better = simd.less_than_f32s(score, best);
            second = simd.select_f32s(better, best, simd.min_f32s(second, score));
            best = simd.select_f32s(better, score, best);
            label = simd.select_u32s(better, simd.splat_u32s((group * GROUP + c) as u32), label);
        }
    }
    let mut norm = simd.splat_f32s(0.0);
    for column in 0..centers.width {
        let x = column_at(column);
        norm = simd.mul_add_f32s(x, x, norm);
    }
    S::as_mut_simd_f32s(&mut scores.best[lanes.clone()]).0[0] = best;
    S::as_mut_simd_f32s(&mut scores.second[lanes.clone()]).0[0] = second;
    S::as_mut_simd_f32s(&mut scores.squared_norm[lanes.clone()]).0[0] = norm;
    S::as_mut_simd_u32s(&mut scores.label[lanes.clone()]).0[0] = label;
}
