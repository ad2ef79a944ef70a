//! Greedy k-means++ (Arthur & Vassilvitskii 2007): every next center is the best of several rows
//! drawn with probability proportional to their squared distance from the centers so far.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use crate::matrix::{CHUNK_ROWS, Matrix};
use crate::rng::Rng;
use crate::tiles::{RowSet, TILE_ROWS, new_tile, pack, squared_distances};

/// Start centers, row-major, shape `(n_clusters, n_features)`; needs `n_clusters` rows at least.
pub(super) fn plus_plus(data: &Matrix, n_clusters: usize, rng: &mut Rng) -> Vec<f64> {
    let n_trials = 2 + (n_clusters as f64).ln() as usize;
    let mut closest = vec![f32::INFINITY; data.n_rows()];
    let mut chosen = vec![rng.below(data.n_rows()) as u32];
    let mut sums = keep_closest(data, chosen[0], &mut closest);
    while chosen.len() < n_clusters {
        let trials: Vec<u32> = (0..n_trials)
            .map(|_| draw(&closest, &sums, rng, &chosen))
            .collect();
        let potentials = potentials(data, &trials, &closest);
        let best = (0..trials.len())
            .min_by(|&a, &b| potentials[a].total_cmp(&potentials[b]))
            .map_or(trials[0], |best| trials[best]);
        sums = keep_closest(data, best, &mut closest);
        chosen.push(best);
    }
    let mut centers = vec![0.0; n_clusters * data.n_features()];
    for (&row, center) in chosen
        .iter()
        .zip(centers.chunks_exact_mut(data.n_features()))
    {
        data.read_row(row as usize, center);
    }
    centers
}

/// One row with probability proportional to `closest`; `sums` are its sums by chunk. Where every
/// row coincides with a center, the first row that is not one yet.
fn draw(closest: &[f32], sums: &[f64], rng: &mut Rng, chosen: &[u32]) -> u32 {
    let total: f64 = sums.iter().sum();
    let mut left = rng.uniform() * total;
    if total > 0.0 && total.is_finite() {
        for (chunk, &sum) in sums.iter().enumerate() {
            if left < sum {
                let start = chunk * CHUNK_ROWS;
                for (at, &value) in closest[start..].iter().take(CHUNK_ROWS).enumerate() {
                    left -= f64::from(value);
                    if left < 0.0 {
                        return (start + at) as u32;
                    }
                }
            }
            left -= sum;
        }
    }
    // Rounding ran past the end, or nothing is left to draw by distance.
    let farthest = (0..closest.len() as u32)
        .filter(|row| !chosen.contains(row))
        .max_by(|&a, &b| {
            closest[a as usize]
                .total_cmp(&closest[b as usize])
                .then(b.cmp(&a))
        });
    farthest.unwrap_or(chosen[0])
}

/// Lowers `closest` to the distances from `center`; returns the new sums by chunk.
fn keep_closest(data: &Matrix, center: u32, closest: &mut [f32]) -> Vec<f64> {
    let points = [data.high_row(center as usize)];
    closest
        .par_chunks_mut(CHUNK_ROWS)
        .enumerate()
        .map(|(chunk, closest)| {
            let start = chunk * CHUNK_ROWS;
            let rows = RowSet::Range {
                start,
                end: start + closest.len(),
            };
            let mut sum = 0.0;
            Arch::new().dispatch(Distances {
                data,
                rows,
                points: &points,
                visit: &mut |_, at, squared| {
                    for (closest, &squared) in closest[at..].iter_mut().zip(squared) {
                        *closest = closest.min(squared);
                        sum += f64::from(*closest);
                    }
                },
            });
            sum
        })
        .collect()
}

/// For each trial the sum of squared distances that choosing it would leave.
fn potentials(data: &Matrix, trials: &[u32], closest: &[f32]) -> Vec<f64> {
    let points: Vec<&[f32]> = trials
        .iter()
        .map(|&row| data.high_row(row as usize))
        .collect();
    let by_chunk: Vec<Vec<f64>> = closest
        .par_chunks(CHUNK_ROWS)
        .enumerate()
        .map(|(chunk, closest)| {
            let start = chunk * CHUNK_ROWS;
            let rows = RowSet::Range {
                start,
                end: start + closest.len(),
            };
            let mut sums = vec![0.0; trials.len()];
            Arch::new().dispatch(Distances {
                data,
                rows,
                points: &points,
                visit: &mut |point, at, squared| {
                    sums[point] += sum_of_minima(&closest[at..at + squared.len()], squared);
                },
            });
            sums
        })
        .collect();
    (0..trials.len())
        .map(|trial| by_chunk.iter().map(|sums| sums[trial]).sum())
        .collect()
}

/// Σ min(a, b) over eight interleaved f64 sums, a fixed order that vector units can follow.
fn sum_of_minima(a: &[f32], b: &[f32]) -> f64 {
    let mut partial = [0.0f64; 8];
    for (a, b) in a.chunks(8).zip(b.chunks(8)) {
        for (partial, (&a, &b)) in partial.iter_mut().zip(a.iter().zip(b)) {
            *partial += f64::from(a.min(b));
        }
    }
    partial.iter().sum()
}

/// Distances of a few points to a run of rows: `visit(point, position of the first, distances)`.
struct Distances<'a> {
    data: &'a Matrix,
    rows: RowSet<'a>,
    points: &'a [&'a [f32]],
    visit: &'a mut dyn FnMut(usize, usize, &[f32]),
}

impl WithSimd for Distances<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let mut tile = new_tile(self.data.n_features());
        let mut squared = [0.0; TILE_ROWS];
        let mut start = 0;
        while start < self.rows.len() {
            let count = TILE_ROWS.min(self.rows.len() - start);
            pack(self.data, self.rows, start, count, &mut tile);
            for (point, values) in self.points.iter().enumerate() {
                squared_distances(simd, &tile, values, f32::INFINITY, &mut squared);
                (self.visit)(point, start, &squared[..count]);
            }
            start += count;
        }
    }
}
