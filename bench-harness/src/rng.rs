//! The only source of randomness here: seeded ChaCha8 streams, one per purpose, so that one more draw for one of them
//! does not shift the numbers of another.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};

/// What a stream is for.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Purpose {
    RandomAction = 1,
    PolicySample = 2,
    ActionNoise = 3,
    Bootstrap = 4,
    Recovery = 5,
    Synthetic = 6,
    QueryNoise = 7,
    HeldOut = 8,
}

/// A seeded stream of numbers.
#[derive(Debug, Clone)]
pub(crate) struct Rng(ChaCha8Rng);

impl Rng {
    pub(crate) fn new(seed: u64, purpose: Purpose) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(purpose as u64);
        Self(rng)
    }

    /// A seed for a stream of its own.
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

    /// Standard normal, by Box and Muller (1958): two uniforms a draw, of the pair only the cosine is used.
    pub(crate) fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// One stream per slot of a vector environment, started anew with every episode.
#[derive(Debug)]
pub(crate) struct SlotRngs {
    purpose: Purpose,
    slots: Vec<Rng>,
}

impl SlotRngs {
    pub(crate) fn new(purpose: Purpose) -> Self {
        Self {
            purpose,
            slots: Vec::new(),
        }
    }

    pub(crate) fn start(&mut self, slot: usize, seed: u64) {
        let rng = Rng::new(seed, self.purpose);
        if self.slots.len() <= slot {
            self.slots.resize(slot + 1, rng.clone());
        }
        self.slots[slot] = rng;
    }

    /// The stream of a slot that has been started.
    pub(crate) fn slot(&mut self, slot: usize) -> &mut Rng {
        &mut self.slots[slot]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_differ_by_seed_and_purpose_and_repeat() {
        let draw = |seed, purpose| Rng::new(seed, purpose).seed();
        assert_eq!(draw(0, Purpose::Bootstrap), draw(0, Purpose::Bootstrap));
        assert_ne!(draw(0, Purpose::Bootstrap), draw(1, Purpose::Bootstrap));
        assert_ne!(draw(0, Purpose::Bootstrap), draw(0, Purpose::ActionNoise));
    }

    #[test]
    fn normals_have_mean_0_variance_1_and_kurtosis_3() {
        let mut rng = Rng::new(1, Purpose::ActionNoise);
        let n = 100_000;
        let values: Vec<f64> = (0..n).map(|_| rng.normal()).collect();
        let moment = |k: i32| values.iter().map(|x| x.powi(k)).sum::<f64>() / f64::from(n);
        assert!(moment(1).abs() < 0.02);
        assert!((moment(2) - 1.0).abs() < 0.02);
        assert!((moment(4) - 3.0).abs() < 0.15);
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
