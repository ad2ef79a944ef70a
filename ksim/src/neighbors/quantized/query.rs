//! One query, rounded and with its columns in the order of what they tell.

use super::codes::GROUP;
use super::scale::{LARGEST, Scale};

/// Σq² of the columns a query uses, at most: four columns of the largest code. Then no partial sum
/// of the first pass overflows upwards (see the module's text).
const LARGEST_SUM: i32 = 4 * 127 * 127;

/// Groups that a query uses, at most, for the same reason.
const MOST_GROUPS: usize = 400;

/// A stage of the first pass stops where a row that is no neighbor is this many standard
/// deviations beyond the threshold.
const CERTAINTY: f64 = 2.75;

/// A query as the first pass sees it.
#[derive(Debug)]
pub(super) struct Prepared {
    /// Groups of columns, the most telling first.
    pub(super) groups: Vec<u16>,
    /// Per pair of columns, in the order of `groups`: both magnitudes, twice.
    pub(super) pairs: Vec<u32>,
    /// Per pair, its signs: bit 0 for a negative first, bit 1 for a negative second column.
    pub(super) signs: Vec<u8>,
    /// Σq² over the first groups, one number each.
    pub(super) sums: Vec<i32>,
    /// Mean and variance of a row's squared distance over the first groups, in steps.
    expected: Vec<(f64, f64)>,
    /// Distance of the query, clipped to the grid, from its codes.
    error: f64,
    /// Squared distance that clipping moved it.
    clipped: f64,
    /// Relative error of sums of squares over its columns.
    rounding: f64,
}

impl Prepared {
    pub(super) fn new(values: &[f64], scale: &Scale) -> Self {
        let (limit, n_groups) = (scale.limit(), values.len().div_ceil(GROUP));
        let mut codes = vec![0i32; n_groups * GROUP];
        let (mut error, mut clipped) = (0.0, 0.0);
        for ((code, value), center) in codes.iter_mut().zip(values).zip(&scale.center) {
            let moved = value - center;
            let inside = moved.clamp(-limit, limit);
            let rounded = (inside / scale.step).round().clamp(-LARGEST, LARGEST);
            *code = rounded as i32;
            error += (inside - rounded * scale.step).powi(2);
            clipped += (moved - inside).powi(2);
        }
        let sum =
            |group: usize| -> i32 { codes[group * GROUP..][..GROUP].iter().map(|q| q * q).sum() };
        let columns = |group: usize| group * GROUP..((group + 1) * GROUP).min(values.len());
        let spread = |group: usize| scale.variance[columns(group)].iter().sum::<f64>();
        let mut ranked: Vec<(f64, u16)> = (0..n_groups)
            .map(|group| (f64::from(sum(group)) + spread(group), group as u16))
            .collect();
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut prepared = Self {
            groups: Vec::with_capacity(n_groups),
            pairs: Vec::with_capacity(2 * n_groups),
            signs: Vec::with_capacity(2 * n_groups),
            sums: Vec::with_capacity(n_groups),
            expected: Vec::with_capacity(n_groups),
            error: f64::sqrt(error) * (1.0 + 1e-9),
            clipped,
            rounding: (values.len() as f64 + 16.0) * f64::EPSILON,
        };
        let (mut total, mut mean, mut variance) = (0, 0.0, 0.0);
        for (expected, group) in ranked {
            let at = usize::from(group);
            if total + sum(at) > LARGEST_SUM || prepared.groups.len() == MOST_GROUPS {
                continue;
            }
            total += sum(at);
            mean += expected;
            for column in columns(at) {
                let (v, q) = (scale.variance[column], f64::from(codes[column]));
                variance += 2.0 * v * v + 4.0 * v * q * q;
            }
            prepared.groups.push(group);
            prepared.sums.push(total);
            prepared.expected.push((mean, variance));
            for pair in codes[at * GROUP..][..GROUP].chunks_exact(2) {
                let [first, second] = [pair[0].unsigned_abs(), pair[1].unsigned_abs()];
                prepared.pairs.push((first | second << 8) * 0x0001_0001);
                prepared
                    .signs
                    .push(u8::from(pair[0] < 0) | u8::from(pair[1] < 0) << 1);
            }
        }
        prepared
    }

    /// T of the module's text: rows within √`squared` of the query differ from it by at most this
    /// in the sum of squared differences of codes.
    pub(super) fn reach(
        &self,
        squared: f64,
        block_error: f64,
        block_clipped: bool,
        step: f64,
    ) -> f64 {
        let widened = squared * (1.0 + self.rounding);
        let left = if block_clipped {
            widened
        } else {
            (widened - self.clipped * (1.0 - self.rounding)).max(0.0)
        };
        let radius = (left.sqrt() + self.error + block_error) / step;
        radius * radius * (1.0 + 1e-9) + 1.0
    }

    /// What a row's sum over the first `n_groups` groups must be at least.
    pub(super) fn limit(&self, n_groups: usize, reach: f64) -> i16 {
        let limit = ((f64::from(self.sums[n_groups - 1]) - reach) / 2.0).floor();
        limit.clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16
    }

    /// How many groups to look at first.
    pub(super) fn first_groups(&self, reach: f64) -> usize {
        let telling = |(mean, variance): &(f64, f64)| mean - CERTAINTY * variance.sqrt() >= reach;
        self.expected
            .iter()
            .position(telling)
            .map_or(self.groups.len(), |at| at + 1)
    }
}
