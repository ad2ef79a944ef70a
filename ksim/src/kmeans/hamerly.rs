//! Lloyd's iteration with Hamerly's bounds (Hamerly 2010): a row whose distance to its own center
//! is below a lower bound on the distance to every other needs no look at the others.
//!
//! The labels are those of plain Lloyd at every iteration; the bounds only save work, most of it
//! once the centers move little.

use rayon::prelude::*;

use super::params::KMeansParams;
use super::scan::PackedCenters;
use super::{KMeans, scan};
use crate::matrix::{CHUNK_ROWS, Matrix, squared_distance};
use crate::normalizer::column_variances;
use crate::tiles::RowSet;

/// Iterates from the given centers until they rest.
pub(super) fn fit(data: &Matrix, centers: Vec<f64>, params: &KMeansParams) -> KMeans {
    let width = data.n_features();
    let variances = column_variances(data);
    let tolerance = params.tolerance * variances.iter().sum::<f64>() / width as f64;
    let mut fit = Fit::new(data, centers);
    let mut converged = false;
    let mut n_iterations = 0;
    while !converged && n_iterations < params.max_iterations {
        fit.assign();
        let shift = fit.move_centers();
        n_iterations += 1;
        converged = shift <= tolerance;
    }
    let labels = scan::assign(data, &fit.centers);
    KMeans::assigned(fit.centers, labels, data, n_iterations, converged)
}

struct Fit<'a> {
    data: &'a Matrix,
    centers: Vec<f64>,
    rows: Vec<RowState>,
    /// Per cluster: sum of its rows, and their number.
    sums: Vec<f64>,
    counts: Vec<i64>,
    /// How far each center moved last.
    shifts: Vec<f64>,
}

/// 12 bytes a row.
#[derive(Debug, Clone, Copy)]
struct RowState {
    label: u32,
    /// At least the distance to the row's own center.
    upper: f32,
    /// At most the distance to any other center.
    lower: f32,
}

/// What the rows of one chunk change in the sums.
struct Delta {
    sums: Vec<f64>,
    counts: Vec<i64>,
}

impl<'a> Fit<'a> {
    fn new(data: &'a Matrix, centers: Vec<f64>) -> Self {
        let n_clusters = centers.len() / data.n_features();
        // No row belongs anywhere yet: an infinite upper bound sends each through a full look.
        let unknown = RowState {
            label: u32::MAX,
            upper: f32::INFINITY,
            lower: 0.0,
        };
        Self {
            data,
            rows: vec![unknown; data.n_rows()],
            sums: vec![0.0; centers.len()],
            counts: vec![0; n_clusters],
            shifts: vec![0.0; n_clusters],
            centers,
        }
    }

    fn width(&self) -> usize {
        self.data.n_features()
    }

    /// Gives every row the label of its nearest center and brings the sums up to date.
    fn assign(&mut self) {
        let packed = PackedCenters::new(&self.centers, self.width());
        let drift = Drift::new(&self.shifts);
        let half_gaps = half_gaps(&self.centers, self.width());
        let pass = Pass {
            data: self.data,
            packed: &packed,
            drift: &drift,
            half_gaps: &half_gaps,
        };
        let deltas: Vec<Delta> = self
            .rows
            .par_chunks_mut(CHUNK_ROWS)
            .enumerate()
            .map(|(chunk, rows)| pass.chunk(chunk * CHUNK_ROWS, rows))
            .collect();
        for delta in deltas {
            self.sums
                .iter_mut()
                .zip(delta.sums)
                .for_each(|(sum, d)| *sum += d);
            self.counts
                .iter_mut()
                .zip(delta.counts)
                .for_each(|(count, d)| *count += d);
        }
    }

    /// Moves every center to the mean of its rows; returns the sum of squared shifts.
    fn move_centers(&mut self) -> f64 {
        let width = self.width();
        let mut moved = self.centers.clone();
        for (c, center) in moved.chunks_exact_mut(width).enumerate() {
            if self.counts[c] > 0 {
                let sums = &self.sums[c * width..][..width];
                for (value, sum) in center.iter_mut().zip(sums) {
                    *value = sum / self.counts[c] as f64;
                }
            }
        }
        let empty: Vec<usize> = (0..self.counts.len())
            .filter(|&c| self.counts[c] == 0)
            .collect();
        if !empty.is_empty() {
            for (&c, row) in empty.iter().zip(self.farthest_rows(empty.len())) {
                self.data.read_row(row, &mut moved[c * width..][..width]);
            }
        }
        let squared: Vec<f64> = moved
            .chunks_exact(width)
            .zip(self.centers.chunks_exact(width))
            .map(|(a, b)| squared_distance(a, b))
            .collect();
        self.shifts = squared.iter().map(|s| s.sqrt()).collect();
        self.centers = moved;
        squared.iter().sum()
    }

    /// The `n` rows farthest from their own center, where an empty cluster starts anew.
    fn farthest_rows(&self, n: usize) -> Vec<usize> {
        let width = self.width();
        let mut rows: Vec<(f64, usize)> = self
            .rows
            .par_iter()
            .enumerate()
            .map(|(row, state)| {
                let center = &self.centers[state.label as usize * width..][..width];
                (self.data.squared_distance(row, center), row)
            })
            .collect();
        rows.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        rows.truncate(n);
        rows.into_iter().map(|(_, row)| row).collect()
    }
}

/// One assignment pass: everything the chunks share.
struct Pass<'a> {
    data: &'a Matrix,
    packed: &'a PackedCenters<'a>,
    drift: &'a Drift,
    half_gaps: &'a [f64],
}

impl Pass<'_> {
    fn chunk(&self, start: usize, rows: &mut [RowState]) -> Delta {
        let width = self.data.n_features();
        let mut pending = Vec::new();
        for (row, state) in (start..).zip(rows.iter_mut()) {
            if !self.keeps_label(row, state) {
                pending.push(row as u32);
            }
        }
        let n_clusters = self.half_gaps.len();
        let mut delta = Delta {
            sums: vec![0.0; n_clusters * width],
            counts: vec![0; n_clusters],
        };
        let mut point = vec![0.0; width];
        self.packed
            .nearest(self.data, RowSet::Listed(&pending), &mut |at, nearest| {
                let row = pending[at] as usize;
                let state = &mut rows[row - start];
                if nearest.label != state.label {
                    self.data.read_row(row, &mut point);
                    delta.add(state.label, &point, -1);
                    delta.add(nearest.label, &point, 1);
                }
                *state = RowState {
                    label: nearest.label,
                    upper: (nearest.upper as f32).next_up(),
                    lower: (nearest.lower as f32).next_down(),
                };
            });
        delta
    }

    /// Whether the bounds alone, or with one exact distance, show that the row's center is still
    /// the nearest; they are moved along with the centers. A tie is never shown: it goes to the
    /// smaller number, which only a full look finds.
    fn keeps_label(&self, row: usize, state: &mut RowState) -> bool {
        if state.label == u32::MAX {
            return false;
        }
        let label = state.label as usize;
        state.upper = ((f64::from(state.upper) + self.drift.own(label)) as f32).next_up();
        state.lower = ((f64::from(state.lower) - self.drift.others(label)) as f32).next_down();
        let bound = f64::from(state.lower).max(self.half_gaps[label]);
        if f64::from(state.upper) < bound {
            return true;
        }
        let center = self.packed.center(label);
        state.upper = (self.data.squared_distance(row, center).sqrt() as f32).next_up();
        f64::from(state.upper) < bound
    }
}

impl Delta {
    fn add(&mut self, label: u32, point: &[f64], sign: i64) {
        if label == u32::MAX {
            return;
        }
        self.counts[label as usize] += sign;
        let sums = &mut self.sums[label as usize * point.len()..][..point.len()];
        for (sum, value) in sums.iter_mut().zip(point) {
            *sum += sign as f64 * value;
        }
    }
}

/// How far the centers moved: the own one, and the one among the others that moved most.
struct Drift {
    shifts: Vec<f64>,
    largest: (usize, f64),
    runner_up: f64,
}

impl Drift {
    fn new(shifts: &[f64]) -> Self {
        let mut largest = (0, 0.0);
        let mut runner_up = 0.0;
        for (c, &shift) in shifts.iter().enumerate() {
            if shift > largest.1 {
                runner_up = largest.1;
                largest = (c, shift);
            } else if shift > runner_up {
                runner_up = shift;
            }
        }
        Self {
            shifts: shifts.to_vec(),
            largest,
            runner_up,
        }
    }

    fn own(&self, label: usize) -> f64 {
        self.shifts[label]
    }

    fn others(&self, label: usize) -> f64 {
        if label == self.largest.0 {
            self.runner_up
        } else {
            self.largest.1
        }
    }
}

/// Half the distance from each center to the nearest other, a hair less for rounding.
fn half_gaps(centers: &[f64], width: usize) -> Vec<f64> {
    let rows: Vec<&[f64]> = centers.chunks_exact(width).collect();
    rows.iter()
        .enumerate()
        .map(|(a, center)| {
            let others = rows.iter().enumerate().filter(|(b, _)| *b != a);
            let nearest = others
                .map(|(_, o)| squared_distance(center, o))
                .fold(f64::INFINITY, f64::min);
            nearest.sqrt() / 2.0 * (1.0 - 1e-12)
        })
        .collect()
}
