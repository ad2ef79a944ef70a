//! Interval of a success rate.

use statrs::distribution::{ContinuousCDF as _, Normal};

use super::Estimate;

/// Success rate p = k/n with the score interval of Wilson (1927): with z the (1 + level)/2 quantile of the normal
/// distribution, `(p + z²/2n ± z √(p(1 - p)/n + z²/4n²)) / (1 + z²/n)`. Unlike p ± z·σ it stays within [0, 1] and
/// holds its level for few episodes and for rates close to 0 or 1. `level` is in (0, 1).
///
/// `None` for n = 0.
pub fn wilson(n_successes: usize, n: usize, level: f64) -> Option<Estimate> {
    if n == 0 {
        return None;
    }
    let z = Normal::standard().inverse_cdf((1.0 + level) / 2.0);
    let count = n as f64;
    let p = n_successes as f64 / count;
    let center = p + z * z / (2.0 * count);
    let half = z * (p * (1.0 - p) / count + z * z / (4.0 * count * count)).sqrt();
    let scale = 1.0 + z * z / count;
    // Exact at the ends, where center and half cancel up to rounding.
    let low = if n_successes == 0 {
        0.0
    } else {
        (center - half) / scale
    };
    let high = if n_successes == n {
        1.0
    } else {
        (center + half) / scale
    };
    Some(Estimate {
        value: p,
        interval: Some([low, high]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The formula in Python, with the quantile of its `statistics.NormalDist`.
    const KNOWN: &[(usize, usize, f64, f64)] = &[
        (0, 10, 0.000000000000, 0.277532799863),
        (8, 10, 0.490162471537, 0.943317848546),
        (10, 10, 0.722467200137, 1.000000000000),
        (1, 1, 0.206549314377, 1.000000000000),
        (137, 200, 0.617650439143, 0.745376790098),
    ];

    #[test]
    fn intervals_are_those_of_the_formula() {
        for &(k, n, low, high) in KNOWN {
            let estimate = wilson(k, n, 0.95).unwrap();
            assert_eq!(estimate.value, k as f64 / n as f64);
            let [found_low, found_high] = estimate.interval.unwrap();
            assert!((found_low - low).abs() < 1e-9, "{k}/{n}: {found_low}");
            assert!((found_high - high).abs() < 1e-9, "{k}/{n}: {found_high}");
        }
        assert_eq!(wilson(0, 0, 0.95), None);
    }
}
