//! Lloyd's iteration with the group bounds of Yinyang k-means (Ding et al. 2015): every row keeps
//! an upper bound on the distance to its own center and, for up to eight groups of neighboring
//! centers, a lower bound on the distance to any other center of the group. Only groups whose
//! bound does not clear the upper one are looked at.
//!
//! The labels are exact at every iteration; the bounds only save work, most of it near the end,
//! when a few centers still move and whole groups rest. Steps are over-relaxed, the last one is
//! plain, and the iteration rests by the length of the plain step. (Anderson acceleration was tried
//! and dropped: on real states it took more iterations, not fewer.)
//!
//! Bounds are stored relative to the drift of the centers so far, so that an iteration reads them
//! without writing: now-bound = stored − drift of the group (for lower ones), stored + drift of
//! the own center (for the upper one).

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::KMeans;
use super::params::KMeansParams;
use super::scan::{self, PackedCenters, RowScores, TileScores, squared_norms};
use crate::matrix::{CHUNK_ROWS, Matrix, max_norm, squared_distance, underflow};
use crate::normalizer::column_variances;
use crate::tiles::{RowSet, TILE_ROWS, new_tile, pack};

/// Iterates from the given centers until they rest.
pub(super) fn fit(data: &Matrix, centers: Vec<f64>, params: &KMeansParams) -> KMeans {
    let width = data.n_features();
    let variances = column_variances(data);
    let tolerance = params.tolerance * variances.iter().sum::<f64>() / width as f64;
    let mut fit = Fit::new(data, scan::neighbors_together(&centers, width));
    let mut converged = false;
    let mut n_iterations = 0;
    while !converged && n_iterations < params.max_iterations {
        let n_changed = fit.assign();
        let means = fit.means();
        n_iterations += 1;
        converged = fit.squared_shifts(&means).iter().sum::<f64>() <= tolerance;
        // Where no label changed, the means are where it ends, and past them there is nothing.
        if converged || n_changed == 0 || n_iterations == params.max_iterations {
            fit.sum_anew();
            fit.move_to(fit.means());
        } else {
            fit.move_beyond(means);
        }
    }
    let labels = scan::assign(data, &fit.centers);
    KMeans::assigned(
        fit.centers,
        labels,
        data,
        Some(n_iterations),
        Some(converged),
    )
}

/// A step goes this many times as far as Lloyd's. Any factor below 2 lowers the inertia at every
/// step, since the inertia of a cluster is a parabola around its mean; near the end, where the
/// centers creep along a flat valley, this one takes less than half the steps.
const RELAXATION: f64 = 1.8;

/// A row that belongs nowhere yet.
const NO_LABEL: u32 = u32::MAX;

struct Fit<'a> {
    data: &'a Matrix,
    centers: Vec<f64>,
    chunks: Vec<Chunk>,
    /// Per cluster: sum of its rows, and their number.
    sums: Vec<f64>,
    counts: Vec<i64>,
    drift: Drift,
    /// Largest norm of a row.
    max_norm: f64,
}

/// What is known of [`CHUNK_ROWS`] rows.
struct Chunk {
    labels: Vec<u32>,
    upper: Vec<f32>,
    /// One run of rows per group.
    lower: Vec<f32>,
}

/// How far the centers have moved in all.
struct Drift {
    /// Per center.
    own: Vec<f64>,
    /// Per group: sum over iterations of the largest shift of a member.
    group: Vec<f64>,
}

/// What the rows of one chunk change in the sums.
struct Delta {
    sums: Vec<f64>,
    counts: Vec<i64>,
    n_changed: usize,
}

impl<'a> Fit<'a> {
    fn new(data: &'a Matrix, centers: Vec<f64>) -> Self {
        let n_clusters = centers.len() / data.n_features();
        let n_groups = PackedCenters::new(&centers, data.n_features()).n_groups();
        let n_chunks = data.n_rows().div_ceil(CHUNK_ROWS);
        let chunks = (0..n_chunks)
            .map(|chunk| {
                let n = CHUNK_ROWS.min(data.n_rows() - chunk * CHUNK_ROWS);
                Chunk {
                    labels: vec![NO_LABEL; n],
                    upper: vec![f32::INFINITY; n],
                    lower: vec![f32::NEG_INFINITY; n * n_groups],
                }
            })
            .collect();
        Self {
            data,
            chunks,
            sums: vec![0.0; centers.len()],
            counts: vec![0; n_clusters],
            drift: Drift {
                own: vec![0.0; n_clusters],
                group: vec![0.0; n_groups],
            },
            centers,
            max_norm: max_norm(data),
        }
    }

    /// Gives every row the label of its nearest center and brings the sums up to date; returns how
    /// many labels changed.
    fn assign(&mut self) -> usize {
        let packed = PackedCenters::new(&self.centers, self.data.n_features());
        let pass = Pass::new(self.data, &packed, &self.drift, self.max_norm);
        let deltas: Vec<Delta> = self
            .chunks
            .par_iter_mut()
            .enumerate()
            .map(|(index, chunk)| {
                let start = index * CHUNK_ROWS;
                Arch::new().dispatch(AssignChunk {
                    pass: &pass,
                    start,
                    chunk,
                })
            })
            .collect();
        self.add_all(deltas)
    }

    /// Brings the sums up to date; returns how many labels changed.
    fn add_all(&mut self, deltas: Vec<Delta>) -> usize {
        let mut n_changed = 0;
        for delta in deltas {
            n_changed += delta.n_changed;
            self.sums
                .iter_mut()
                .zip(delta.sums)
                .for_each(|(sum, d)| *sum += d);
            self.counts
                .iter_mut()
                .zip(delta.counts)
                .for_each(|(count, d)| *count += d);
        }
        n_changed
    }

    /// The sums from the labels alone: what has come to them and left again over the iterations may
    /// have taken digits along.
    fn sum_anew(&mut self) {
        let point = vec![0.0; self.data.n_features()];
        let deltas: Vec<Delta> = self
            .chunks
            .par_iter()
            .enumerate()
            .map_with(point, |point, (index, chunk)| {
                let mut delta = Delta::new(self.sums.len(), self.counts.len());
                for (&label, row) in chunk.labels.iter().zip(index * CHUNK_ROWS..) {
                    self.data.read_row(row, point);
                    delta.add(label, point, 1);
                }
                delta
            })
            .collect();
        self.sums.fill(0.0);
        self.counts.fill(0);
        self.add_all(deltas);
    }

    /// The mean of each center's rows: where Lloyd's iteration moves it. An empty cluster starts
    /// anew at the row farthest from its center.
    fn means(&self) -> Vec<f64> {
        let width = self.data.n_features();
        let mut means = self.centers.clone();
        for (c, center) in means.chunks_exact_mut(width).enumerate() {
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
                self.data.read_row(row, &mut means[c * width..][..width]);
            }
        }
        means
    }

    /// How far each center would move, squared.
    fn squared_shifts(&self, to: &[f64]) -> Vec<f64> {
        let width = self.data.n_features();
        let pairs = to.chunks_exact(width).zip(self.centers.chunks_exact(width));
        pairs.map(|(a, b)| squared_distance(a, b)).collect()
    }

    fn move_to(&mut self, centers: Vec<f64>) {
        self.drift.add(&self.squared_shifts(&centers));
        self.centers = centers;
    }

    /// Moves every center towards its mean and past it; an empty cluster's to its row.
    fn move_beyond(&mut self, mut means: Vec<f64>) {
        let width = self.data.n_features();
        for (at, mean) in means.iter_mut().enumerate() {
            if self.counts[at / width] > 0 {
                *mean = self.centers[at] + RELAXATION * (*mean - self.centers[at]);
            }
        }
        self.move_to(means);
    }

    /// The `n` rows farthest from their own center, where an empty cluster starts anew.
    fn farthest_rows(&self, n: usize) -> Vec<usize> {
        let width = self.data.n_features();
        let labels = self
            .chunks
            .par_iter()
            .flat_map_iter(|chunk| chunk.labels.iter().copied());
        let labels: Vec<u32> = labels.collect();
        let mut rows: Vec<(f64, usize)> = labels
            .par_iter()
            .enumerate()
            .map(|(row, &label)| {
                let center = &self.centers[label as usize * width..][..width];
                (self.data.squared_distance(row, center), row)
            })
            .collect();
        rows.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        rows.truncate(n);
        rows.into_iter().map(|(_, row)| row).collect()
    }
}

impl Drift {
    fn add(&mut self, squared_shifts: &[f64]) {
        let size = PackedCenters::group_size(self.own.len());
        for (drift, shifts) in self.group.iter_mut().zip(squared_shifts.chunks(size)) {
            *drift += shifts.iter().fold(0.0f64, |most, s| most.max(s.sqrt()));
        }
        self.own
            .iter_mut()
            .zip(squared_shifts)
            .for_each(|(drift, s)| *drift += s.sqrt());
    }
}

impl Delta {
    fn new(n_values: usize, n_clusters: usize) -> Self {
        Self {
            sums: vec![0.0; n_values],
            counts: vec![0; n_clusters],
            n_changed: 0,
        }
    }

    fn add(&mut self, label: u32, point: &[f64], sign: i64) {
        if label == NO_LABEL {
            return;
        }
        self.counts[label as usize] += sign;
        let sums = &mut self.sums[label as usize * point.len()..][..point.len()];
        for (sum, value) in sums.iter_mut().zip(point) {
            *sum += sign as f64 * value;
        }
    }
}

/// One assignment pass: everything the chunks share.
struct Pass<'a> {
    data: &'a Matrix,
    packed: &'a PackedCenters<'a>,
    drift: &'a Drift,
    own_drift: Vec<f32>,
    group_drift: Vec<f32>,
    /// Half the distance of each center to the nearest other.
    half_gaps: Vec<f32>,
    /// f32 copies of the centers, row by row.
    centers: Vec<f32>,
    /// More than the f32 arithmetic on bounds can be off by.
    slack: f32,
}

/// A row of a chunk that needs a look, and at which groups (one bit each).
#[derive(Debug, Clone, Copy)]
struct Pending {
    local: u32,
    label: u32,
    groups: u8,
}

impl<'a> Pass<'a> {
    fn new(data: &'a Matrix, packed: &'a PackedCenters<'a>, drift: &'a Drift, norm: f64) -> Self {
        let largest = drift
            .own
            .iter()
            .chain(&drift.group)
            .fold(0.0f64, |m, d| m.max(*d));
        // Every stored or compared number is below this in magnitude, and is rounded a handful
        // of times at 2⁻²⁴.
        let magnitude = 2.0 * (norm + packed.max_norm()) + largest;
        Self {
            data,
            packed,
            drift,
            own_drift: drift.own.iter().map(|&d| d as f32).collect(),
            group_drift: drift.group.iter().map(|&d| d as f32).collect(),
            half_gaps: packed.half_gaps().iter().map(|&gap| gap as f32).collect(),
            centers: packed.exact().iter().map(|&v| v as f32).collect(),
            slack: (magnitude * 2f64.powi(-20) + underflow(data.n_features())) as f32,
        }
    }

    /// Draws the verdict for one row from its scores against some groups (the own one among
    /// them), and stores its label and bounds; the other groups are known to hold no nearer center.
    fn settle(
        &self,
        (row, local): (usize, usize),
        scores: &[Option<RowScores>; MAX_GROUPS],
        squared_norm: f32,
        chunk: &mut Chunk,
    ) {
        let mut overall = RowScores {
            label: 0,
            best: f32::INFINITY,
            second: f32::INFINITY,
        };
        for scores in scores.iter().flatten() {
            if scores.best < overall.best {
                let second = overall.best.min(scores.second);
                overall = RowScores { second, ..*scores };
            } else {
                overall.second = overall.second.min(scores.best);
            }
        }
        let n = chunk.labels.len();
        let mut store = |group: usize, distance: f64| {
            chunk.lower[group * n + local] =
                ((distance + self.drift.group[group]) as f32).next_down();
        };
        let (label, upper) = match self.packed.certain(&overall, squared_norm) {
            Some(bounds) => {
                for (group, scores) in scores.iter().enumerate() {
                    if let Some(scores) = scores {
                        let own = scores.label == overall.label;
                        let other = if own { scores.second } else { scores.best };
                        store(group, bounds.at_least(other));
                    }
                }
                (overall.label, bounds.at_most(overall.best))
            }
            None => {
                let exact = self.packed.exact_bounds(self.data, row);
                for (group, &distance) in exact.groups.iter().enumerate() {
                    store(group, distance);
                }
                (exact.label, exact.distance)
            }
        };
        chunk.labels[local] = label;
        chunk.upper[local] = ((upper - self.drift.own[label as usize]) as f32).next_up();
    }
}

/// One bit of a byte per group.
const MAX_GROUPS: usize = PackedCenters::MAX_GROUPS;

/// The assignment of one chunk.
struct AssignChunk<'a, 'b> {
    pass: &'a Pass<'a>,
    start: usize,
    chunk: &'b mut Chunk,
}

impl WithSimd for AssignChunk<'_, '_> {
    type Output = Delta;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Delta {
        let Self { pass, start, chunk } = self;
        let width = pass.data.n_features();
        let mut delta = Delta::new(pass.centers.len(), pass.half_gaps.len());
        let mut pending = pass.filter(simd, start, chunk);
        // Rows of one cluster tend to need the same groups.
        pending.sort_unstable_by_key(|row| (row.label, row.local));
        let (mut tile, mut norms) = (new_tile(width), [0.0; TILE_ROWS]);
        let mut scores = vec![TileScores::default(); pass.group_drift.len()];
        let mut point = vec![0.0; width];
        for pending in pending.chunks(TILE_ROWS) {
            let rows: [u32; TILE_ROWS] =
                std::array::from_fn(|at| start as u32 + pending.get(at).map_or(0, |row| row.local));
            pack(
                pass.data,
                RowSet::Listed(&rows),
                0,
                pending.len(),
                &mut tile,
            );
            squared_norms(simd, &tile, &mut norms);
            let groups = pending.iter().fold(0, |groups, row| groups | row.groups);
            let looked_at = |group: usize| groups & (1 << group) != 0;
            for (group, scores) in scores.iter_mut().enumerate() {
                if looked_at(group) {
                    pass.packed
                        .score_tile(simd, &tile, pass.packed.packs(group), scores);
                }
            }
            for (at, row) in pending.iter().enumerate() {
                let of_group =
                    |group: usize| looked_at(group).then(|| scores.get(group).map(|s| s.of(at)));
                let scores: [_; MAX_GROUPS] =
                    std::array::from_fn(|group| of_group(group).flatten());
                let (local, global) = (row.local as usize, rows[at] as usize);
                pass.settle((global, local), &scores, norms[at], chunk);
                let label = chunk.labels[local];
                if label != row.label {
                    delta.n_changed += 1;
                    pass.data.read_row(global, &mut point);
                    delta.add(row.label, &point, -1);
                    delta.add(label, &point, 1);
                }
            }
        }
        delta
    }
}

impl Pass<'_> {
    /// The rows that the bounds do not clear.
    #[inline(always)]
    fn filter<S: Simd>(&self, simd: S, start: usize, chunk: &mut Chunk) -> Vec<Pending> {
        let n = chunk.labels.len();
        let n_groups = self.group_drift.len();
        if chunk.labels.first() == Some(&NO_LABEL) {
            let groups = ((1u16 << n_groups) - 1) as u8;
            return (0..n as u32)
                .map(|local| Pending {
                    local,
                    label: NO_LABEL,
                    groups,
                })
                .collect();
        }
        let mut nearest_group = vec![f32::INFINITY; n];
        for (lower, &drift) in chunk.lower.chunks_exact(n).zip(&self.group_drift) {
            for (nearest, &lower) in nearest_group.iter_mut().zip(lower) {
                *nearest = nearest.min(lower - drift);
            }
        }
        let mut unclear = Vec::new();
        for (local, bound) in nearest_group.iter_mut().enumerate() {
            let label = chunk.labels[local] as usize;
            *bound = bound.max(self.half_gaps[label]) - self.slack;
            if chunk.upper[local] + self.own_drift[label] >= *bound {
                unclear.push(local);
            }
        }
        // A loop of its own, without a branch to guess wrong: the rows come from main memory, and
        // their reads overlap.
        let mut tightened = vec![0.0; unclear.len()];
        for (upper, &local) in tightened.iter_mut().zip(&unclear) {
            *upper = self.tightened(simd, start + local, chunk.labels[local] as usize);
        }
        let mut pending = Vec::new();
        for (local, upper) in unclear.into_iter().zip(tightened) {
            let label = chunk.labels[local] as usize;
            chunk.upper[local] = upper - self.own_drift[label];
            if upper + self.slack < nearest_group[local] {
                continue;
            }
            let mut groups = 1u8 << self.packed.group_of(label);
            for group in 0..n_groups {
                let lower = chunk.lower[group * n + local] - self.group_drift[group];
                groups |= u8::from(lower - self.slack <= upper) << group;
            }
            pending.push(Pending {
                local: local as u32,
                label: label as u32,
                groups,
            });
        }
        pending
    }

    /// An upper bound, a few 1e-7 above, on the distance of a row to its own center.
    #[inline(always)]
    fn tightened<S: Simd>(&self, simd: S, row: usize, label: usize) -> f32 {
        let width = self.data.n_features();
        let center = &self.centers[label * width..][..width];
        let (x, x_rest) = S::as_simd_f32s(self.data.high_row(row));
        let (c, c_rest) = S::as_simd_f32s(center);
        let mut sum = simd.splat_f32s(0.0);
        for (&x, &c) in x.iter().zip(c) {
            let difference = simd.sub_f32s(x, c);
            sum = simd.mul_add_f32s(difference, difference, sum);
        }
        // Four chains instead of one, or the additions would wait for each other.
        let mut rest = [0.0f32; 4];
        for (x, c) in x_rest.chunks(4).zip(c_rest.chunks(4)) {
            for (rest, (x, c)) in rest.iter_mut().zip(x.iter().zip(c)) {
                *rest += (x - c) * (x - c);
            }
        }
        let rest = (rest[0] + rest[1]) + (rest[2] + rest[3]);
        // The slack covers the rounding of x and c, the factor that of the sum.
        let squared = simd.reduce_sum_f32s(sum) + rest;
        squared.sqrt() * (1.0 + (width as f32 + 8.0) * f32::EPSILON) + self.slack
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 5;
    const CLUSTERS: usize = 20;

    fn values() -> Vec<f64> {
        (0..5000 * WIDTH)
            .map(|i| ((i * 2_654_435_761) % 10_007) as f64 / 1000.0)
            .collect()
    }

    fn nearest(centers: &[f64], row: &[f64]) -> (usize, f64) {
        let squared = |c: &[f64]| {
            c.iter()
                .zip(row)
                .map(|(a, b)| (a - b) * (a - b))
                .sum::<f64>()
        };
        let distances = centers.chunks_exact(WIDTH).map(squared).enumerate();
        distances.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap()
    }

    /// One relaxed step in plain loops; returns the new centers, the means and the inertia.
    fn plain_step(values: &[f64], centers: &[f64]) -> (Vec<f64>, Vec<f64>, f64) {
        let (mut sums, mut counts) = (vec![0.0; CLUSTERS * WIDTH], [0.0; CLUSTERS]);
        let mut inertia = 0.0;
        for row in values.chunks_exact(WIDTH) {
            let (label, squared) = nearest(centers, row);
            inertia += squared;
            counts[label] += 1.0;
            sums[label * WIDTH..][..WIDTH]
                .iter_mut()
                .zip(row)
                .for_each(|(s, v)| *s += v);
        }
        let means: Vec<f64> = sums
            .iter()
            .enumerate()
            .map(|(i, s)| s / counts[i / WIDTH])
            .collect();
        let relaxed = means
            .iter()
            .zip(centers)
            .map(|(m, c)| c + RELAXATION * (m - c))
            .collect();
        (relaxed, means, inertia)
    }

    /// A row so large that it takes the sum of a cluster along when it leaves.
    #[test]
    fn centers_are_the_means_of_their_rows() {
        let values: Vec<f64> = [0.5; 50].into_iter().chain([3e18]).collect();
        let data = Matrix::from_f64(&values, 1).unwrap();
        let fitted = fit(&data, vec![0.5, 7e18], &KMeansParams::new(2));
        let mut centers = fitted.centers().to_vec();
        centers.sort_by(f64::total_cmp);
        assert_eq!(centers[0], 0.5);
        assert_eq!(
            fitted
                .labels()
                .iter()
                .filter(|&&l| l == fitted.labels()[0])
                .count(),
            50
        );
    }

    #[test]
    fn bounds_change_nothing_and_inertia_falls() {
        let values = values();
        let data = Matrix::from_f64(&values, WIDTH).unwrap();
        let mut plain = values[..CLUSTERS * WIDTH].to_vec();
        let mut fit = Fit::new(&data, plain.clone());
        let mut inertia = f64::INFINITY;
        for iteration in 0..60 {
            fit.assign();
            let means = fit.means();
            let (next, plain_means, now) = plain_step(&values, &plain);
            assert!(
                now <= inertia,
                "iteration {iteration}: {now} above {inertia}"
            );
            let labels = fit.chunks.iter().flat_map(|chunk| &chunk.labels);
            for (&label, row) in labels.zip(values.chunks_exact(WIDTH)) {
                assert_eq!(
                    label as usize,
                    nearest(&plain, row).0,
                    "iteration {iteration}"
                );
            }
            for (a, b) in means.iter().zip(&plain_means) {
                assert!((a - b).abs() < 1e-9, "iteration {iteration}: {a} {b}");
            }
            fit.move_beyond(means);
            plain = next;
            // The two sum in different orders; from equal centers on, any difference is a bug.
            fit.centers.copy_from_slice(&plain);
            inertia = now;
        }
    }
}
