//! Two policies on the same seeds.

use serde::Serialize;
use statrs::distribution::{Binomial, DiscreteCDF as _};

use super::Estimate;
use super::bootstrap::{BootstrapOptions, bootstrap_mean};

/// Two lists that should be pairs, of different lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("paired comparison of {a} episodes with {b}")]
pub struct UnequalLengths {
    /// Length of the first.
    pub a: usize,
    /// Length of the second.
    pub b: usize,
}

/// Whether two policies succeed equally often on common seeds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct McNemar {
    /// Episodes in which only the first succeeded.
    pub n_only_a: usize,
    /// Episodes in which only the second did.
    pub n_only_b: usize,
    /// Two-sided: how probable a split at least as uneven is if both are equally good.
    pub p_value: f64,
}

/// The exact test of McNemar (1947) on paired successes: episodes in which both succeed or both fail say nothing; of
/// the b + c others, min(b, c) is compared with the binomial distribution of b + c fair coins, and the tail doubled.
///
/// # Errors
/// Lists of different lengths.
pub fn mcnemar(a: &[bool], b: &[bool]) -> Result<McNemar, UnequalLengths> {
    check(a.len(), b.len())?;
    let count = |only_a: bool| {
        let pairs = a.iter().zip(b);
        pairs.filter(|&(&a, &b)| a != b && a == only_a).count()
    };
    let (n_only_a, n_only_b) = (count(true), count(false));
    let n = (n_only_a + n_only_b) as u64;
    let fewer = n_only_a.min(n_only_b) as u64;
    let coins = Binomial::new(0.5, n).expect("1/2 is a probability");
    Ok(McNemar {
        n_only_a,
        n_only_b,
        p_value: (2.0 * coins.cdf(fewer)).min(1.0),
    })
}

/// Mean of the differences a - b with its bootstrap interval over pairs. `None` for no pairs.
///
/// # Errors
/// Lists of different lengths.
pub fn paired_difference(
    a: &[f64],
    b: &[f64],
    options: &BootstrapOptions,
) -> Result<Option<Estimate>, UnequalLengths> {
    check(a.len(), b.len())?;
    let differences: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
    Ok(bootstrap_mean(&differences, options))
}

fn check(a: usize, b: usize) -> Result<(), UnequalLengths> {
    if a == b {
        Ok(())
    } else {
        Err(UnequalLengths { a, b })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcomes(only_a: usize, only_b: usize, both: usize) -> (Vec<bool>, Vec<bool>) {
        let a = [vec![true; only_a], vec![false; only_b], vec![true; both]].concat();
        let b = [vec![false; only_a], vec![true; only_b], vec![true; both]].concat();
        (a, b)
    }

    #[test]
    fn p_values_are_binomial_tails() {
        // 2 (1 + 10 + 45) / 2¹⁰, 2 · 1 / 2⁵, and an even split.
        for (only_a, only_b, p_value) in
            [(2, 8, 0.109375), (5, 0, 0.0625), (4, 4, 1.0), (0, 0, 1.0)]
        {
            let (a, b) = outcomes(only_a, only_b, 7);
            let test = mcnemar(&a, &b).unwrap();
            assert_eq!((test.n_only_a, test.n_only_b), (only_a, only_b));
            assert!((test.p_value - p_value).abs() < 1e-12, "{test:?}");
        }
    }

    #[test]
    fn differences_are_taken_pair_by_pair() {
        let a: Vec<f64> = (0..50).map(|i| f64::from(i * i)).collect();
        let b: Vec<f64> = a.iter().map(|value| value - 3.0).collect();
        let options = BootstrapOptions::default();
        let estimate = paired_difference(&a, &b, &options).unwrap().unwrap();
        assert_eq!((estimate.value, estimate.interval), (3.0, Some([3.0, 3.0])));
        assert_eq!(paired_difference(&[], &[], &options), Ok(None));
    }

    #[test]
    fn pairs_need_equal_lengths() {
        let error = UnequalLengths { a: 1, b: 2 };
        assert_eq!(mcnemar(&[true], &[true, false]), Err(error));
        let options = BootstrapOptions::default();
        assert_eq!(paired_difference(&[1.0], &[1.0, 2.0], &options), Err(error));
    }
}
