//! The only source of randomness: seeded ChaCha8 streams, whose values do not depend on threads or on what is drawn
//! elsewhere.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng};
use rand_distr::{Distribution, StandardNormal};

/// What a stream is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// Initial weights; the number is that of the network.
    Weights = 1,
    /// Order of the windows; the number is the epoch.
    DiffusionOrder = 2,
    CuriosityOrder = 3,
    ConfidenceOrder = 4,
    /// Timesteps and noise of an update; the number is the update.
    DiffusionNoise = 5,
    RewardNoise = 6,
    CuriosityNoise = 7,
    /// Noise of a candidate; the number is that of plan and candidate.
    Plan = 8,
    /// Choice among candidates; the number is that of the plan.
    Choice = 9,
    /// Start states of generated plans; the number is that of the round.
    Starts = 10,
    /// Noise of a candidate in a round of generated plans; the number is that of round and candidate.
    GeneratedPlan = 11,
}

/// A seeded stream of numbers.
#[derive(Debug, Clone)]
pub(crate) struct Rng(ChaCha8Rng);

impl Rng {
    /// The stream of a seed, a purpose and a number below 2^56.
    pub(crate) fn new(seed: u64, purpose: Purpose, number: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream((purpose as u64) << 56 | (number & ((1 << 56) - 1)));
        Self(rng)
    }

    /// A seed for a generator of somebody else's.
    pub(crate) fn seed(&mut self) -> u64 {
        self.0.next_u64()
    }

    /// Uniform in `[0, 1)`, on the grid of 2^-53.
    pub(crate) fn uniform(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in `0..n`; the bias of the multiply-shift is below `n / 2^64`.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.0.next_u64()) * n as u128) >> 64) as usize
    }

    /// Standard normal numbers.
    pub(crate) fn fill_normal(&mut self, out: &mut [f32]) {
        for value in out {
            let drawn: f64 = StandardNormal.sample(&mut self.0);
            *value = drawn as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_differ_by_seed_purpose_and_number_and_repeat() {
        let draw = |seed, purpose, number| Rng::new(seed, purpose, number).below(1 << 30);
        let first = draw(0, Purpose::Plan, 0);
        assert_eq!(first, draw(0, Purpose::Plan, 0));
        assert_ne!(first, draw(1, Purpose::Plan, 0));
        assert_ne!(first, draw(0, Purpose::Plan, 1));
        assert_ne!(first, draw(0, Purpose::Choice, 0));
    }

    #[test]
    fn normal_numbers_have_mean_zero_and_deviation_one() {
        let mut drawn = vec![0.0; 100_000];
        Rng::new(7, Purpose::DiffusionNoise, 3).fill_normal(&mut drawn);
        let n = drawn.len() as f64;
        let mean = drawn.iter().map(|&value| f64::from(value)).sum::<f64>() / n;
        let square = drawn
            .iter()
            .map(|&value| f64::from(value).powi(2))
            .sum::<f64>()
            / n;
        assert!(mean.abs() < 0.01, "mean {mean}");
        assert!((square - 1.0).abs() < 0.02, "variance {square}");
    }
}
