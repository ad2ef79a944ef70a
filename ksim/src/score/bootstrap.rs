//! Percentile bootstrap over episodes.

use rayon::prelude::*;

use crate::rng::{Purpose, Rng};

/// 95 % interval of the mean of `values` (Efron's percentile method): `[low, high]`. `None` for
/// fewer than two values, which say nothing about their spread, or without resamples.
///
/// Steps of one episode hang together, so episodes are resampled, never steps.
pub(super) fn interval_95(values: &[f64], n_resamples: usize, seed: u64) -> Option<[f64; 2]> {
    if values.len() < 2 || n_resamples == 0 {
        return None;
    }
    let mut rng = Rng::new(seed, Purpose::Bootstrap);
    let seeds: Vec<Rng> = (0..n_resamples)
        .map(|_| {
            Rng::new(
                (rng.uniform() * (1u64 << 53) as f64) as u64,
                Purpose::Bootstrap,
            )
        })
        .collect();
    let mut means: Vec<f64> = seeds
        .into_par_iter()
        .map(|mut rng| {
            let sum: f64 = values.iter().map(|_| values[rng.below(values.len())]).sum();
            sum / values.len() as f64
        })
        .collect();
    means.sort_by(f64::total_cmp);
    Some([quantile(&means, 0.025), quantile(&means, 0.975)])
}

/// The `q`-quantile of ascending values, linear between neighbors; NaN for none.
pub(super) fn quantile(sorted: &[f64], q: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else {
        return f64::NAN;
    };
    let at = q * last as f64;
    let below = (at as usize).min(last);
    let above = (below + 1).min(last);
    sorted[below] + (sorted[above] - sorted[below]) * (at - below as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_narrows_with_episodes_and_holds_the_mean() {
        let values = |n: usize| (0..n).map(|i| (i % 10) as f64).collect::<Vec<_>>();
        let width = |n| {
            let [low, high] = interval_95(&values(n), 2000, 0).unwrap();
            assert!(low < 4.5 && 4.5 < high, "{low} {high}");
            high - low
        };
        // The standard error of the mean is 2.87 / √n.
        assert!((width(40) - 2.0 * 1.96 * 2.872 / 40f64.sqrt()).abs() < 0.15);
        assert!(width(1000) < width(40) / 4.0);
    }

    #[test]
    fn one_episode_has_no_interval() {
        assert_eq!(interval_95(&[0.5], 2000, 0), None);
    }

    #[test]
    fn quantiles_interpolate() {
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.5), 2.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
        assert!(quantile(&[], 0.5).is_nan());
    }
}
