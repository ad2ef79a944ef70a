//! The only source of randomness: a seeded ChaCha8 stream, whose values never change between
//! versions, machines or thread counts.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng};

/// What the stream is for. Each use draws from a stream of its own, so that one more draw here
/// does not shift the numbers there.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Purpose {
    KMeansInit = 1,
    Bootstrap = 2,
}

/// A seeded stream of uniform numbers.
#[derive(Debug, Clone)]
pub(crate) struct Rng(ChaCha8Rng);

impl Rng {
    pub(crate) fn new(seed: u64, purpose: Purpose) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(purpose as u64);
        Self(rng)
    }

    /// Uniform in `[0, 1)`, on the grid of 2^-53.
    pub(crate) fn uniform(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in `0..n`; the bias of the multiply-shift is below `n / 2^64`.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.0.next_u64()) * n as u128) >> 64) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_differ_by_seed_and_purpose_and_repeat() {
        let draw = |seed, purpose| Rng::new(seed, purpose).below(1 << 30);
        assert_eq!(draw(0, Purpose::Bootstrap), draw(0, Purpose::Bootstrap));
        assert_ne!(draw(0, Purpose::Bootstrap), draw(1, Purpose::Bootstrap));
        assert_ne!(draw(0, Purpose::Bootstrap), draw(0, Purpose::KMeansInit));
    }

    #[test]
    fn draws_stay_in_range() {
        let mut rng = Rng::new(3, Purpose::Bootstrap);
        for n in [1, 2, 7, 1000] {
            assert!((0..200).all(|_| rng.below(n) < n));
        }
        assert!(
            (0..200)
                .map(|_| rng.uniform())
                .all(|u| (0.0..1.0).contains(&u))
        );
    }
}
