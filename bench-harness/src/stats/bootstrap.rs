//! Percentile bootstrap.

use rayon::prelude::*;

use super::Estimate;
use crate::rng::{Purpose, Rng};

/// How intervals are resampled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BootstrapOptions {
    /// Number of resamples; none gives no intervals.
    pub n_resamples: usize,
    /// Share of resamples that the interval holds, in (0, 1).
    pub level: f64,
    /// Seed of the resamples.
    pub seed: u64,
}

impl Default for BootstrapOptions {
    fn default() -> Self {
        Self {
            n_resamples: 2000,
            level: 0.95,
            seed: 0,
        }
    }
}

/// Mean with the percentile interval of Efron (1979): the (1 ± level)/2 quantiles of the means of resamples, each of
/// as many values, drawn with replacement. `None` for no values; no interval for a single one.
pub fn bootstrap_mean(values: &[f64], options: &BootstrapOptions) -> Option<Estimate> {
    let n = values.len();
    Some(Estimate {
        value: mean(values)?,
        interval: interval(n > 1, options, |rng| {
            let sum: f64 = (0..n).map(|_| values[rng.below(n)]).sum();
            sum / n as f64
        }),
    })
}

/// Mean over the members of all groups, each given by its sum and its number of members, with the interval of
/// [`bootstrap_mean`] over groups: a resample draws as many groups and pools their members. `None` for no members.
pub fn bootstrap_pooled(groups: &[(f64, usize)], options: &BootstrapOptions) -> Option<Estimate> {
    let filled = groups.iter().copied().filter(|(_, n)| *n > 0);
    let groups: Vec<(f64, usize)> = filled.collect();
    if groups.is_empty() {
        return None;
    }
    let pooled = |drawn: &mut dyn Iterator<Item = (f64, usize)>| {
        let (sum, n) = drawn.fold((0.0, 0), |(sum, n), one| (sum + one.0, n + one.1));
        sum / n as f64
    };
    Some(Estimate {
        value: pooled(&mut groups.iter().copied()),
        interval: interval(groups.len() > 1, options, |rng| {
            pooled(&mut (0..groups.len()).map(|_| groups[rng.below(groups.len())]))
        }),
    })
}

pub(super) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Percentile interval of what `resample` computes; `None` where `has_spread` is not.
pub(super) fn interval(
    has_spread: bool,
    options: &BootstrapOptions,
    resample: impl Fn(&mut Rng) -> f64 + Sync,
) -> Option<[f64; 2]> {
    if !has_spread || options.n_resamples == 0 {
        return None;
    }
    let mut rng = Rng::new(options.seed, Purpose::Bootstrap);
    let seeds: Vec<u64> = (0..options.n_resamples).map(|_| rng.seed()).collect();
    let mut statistics: Vec<f64> = seeds
        .into_par_iter()
        .map(|seed| resample(&mut Rng::new(seed, Purpose::Bootstrap)))
        .collect();
    statistics.sort_by(f64::total_cmp);
    let tail = (1.0 - options.level) / 2.0;
    Some([
        quantile(&statistics, tail),
        quantile(&statistics, 1.0 - tail),
    ])
}

/// The `q`-quantile of at least one ascending value, linear between neighbors.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let last = sorted.len() - 1;
    let at = q.clamp(0.0, 1.0) * last as f64;
    let below = at as usize;
    let above = (below + 1).min(last);
    sorted[below] + (sorted[above] - sorted[below]) * (at - below as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_is_that_of_the_normal_approximation_for_many_values() {
        let values: Vec<f64> = (0..400).map(|i| f64::from(i % 10)).collect();
        let estimate = bootstrap_mean(&values, &BootstrapOptions::default()).unwrap();
        assert_eq!(estimate.value, 4.5);
        let [low, high] = estimate.interval.unwrap();
        // The standard error of the mean is √8.25 / √400.
        let half = 1.96 * 8.25f64.sqrt() / 20.0;
        assert!((low - (4.5 - half)).abs() < 0.03, "{low}");
        assert!((high - (4.5 + half)).abs() < 0.03, "{high}");
        let wider = BootstrapOptions {
            level: 0.99,
            ..BootstrapOptions::default()
        };
        let [low_99, high_99] = bootstrap_mean(&values, &wider).unwrap().interval.unwrap();
        assert!(low_99 < low && high < high_99);
    }

    #[test]
    fn few_values() {
        let options = BootstrapOptions::default();
        assert_eq!(bootstrap_mean(&[], &options), None);
        let one = bootstrap_mean(&[2.0], &options).unwrap();
        assert_eq!((one.value, one.interval), (2.0, None));
        let same = bootstrap_mean(&[2.0, 2.0], &options).unwrap();
        assert_eq!(same.interval, Some([2.0, 2.0]));
    }

    #[test]
    fn groups_count_by_their_members() {
        let options = BootstrapOptions::default();
        let estimate = bootstrap_pooled(&[(9.0, 9), (0.0, 1), (0.0, 0)], &options).unwrap();
        // A resample has both groups, or one of them twice.
        assert_eq!((estimate.value, estimate.interval), (0.9, Some([0.0, 1.0])));
        let values = [1.0, 4.0, 2.0, 8.0];
        let single = values.map(|value| (value, 1));
        assert_eq!(
            bootstrap_pooled(&single, &options),
            bootstrap_mean(&values, &options)
        );
        assert_eq!(bootstrap_pooled(&[(0.0, 0)], &options), None);
    }

    #[test]
    fn quantiles_interpolate() {
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.5), 2.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 1.0), 4.0);
    }
}
