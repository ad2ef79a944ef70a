//! NumPy's default generator, draw for draw: what `numpy.random.default_rng(seed)` gives, so that a seeded reset is the
//! published environments' reset.
//!
//! The generator is PCG64 (O'Neill 2014, XSL-RR 128/64), seeded by NumPy's `SeedSequence`. The draws are those of
//! `Generator` in NumPy 1.17 and later, in their order and to the last bit.

mod ziggurat;

use rand_core::Rng;
use rand_pcg::Pcg64;

use ziggurat::{DENSITY, INSIDE, WIDTH};

/// Where the ziggurat's tail begins.
const TAIL: f64 = 3.654_152_885_361_009;
/// Its reciprocal, as NumPy rounds it.
const TAIL_RECIPROCAL: f64 = 0.273_661_237_329_758_3;

/// NumPy's `default_rng(seed)`.
#[derive(Debug, Clone)]
pub struct Generator {
    bits: Pcg64,
    /// High half of the last 64 bits that a 32-bit draw took: the next 32-bit draw.
    high: Option<u32>,
}

impl Generator {
    /// The generator that NumPy makes of `seed`.
    pub fn new(seed: u64) -> Self {
        let words = seed_words(seed);
        let wide = |at: usize| (u128::from(words[at]) << 64) | u128::from(words[at + 1]);
        Self {
            bits: Pcg64::new(wide(0), wide(2)),
            high: None,
        }
    }

    /// `random()`: uniform in `[0, 1)`, a multiple of 2^-53.
    pub fn random(&mut self) -> f64 {
        const STEP: f64 = 1.0 / (1_u64 << 53) as f64;
        (self.bits.next_u64() >> 11) as f64 * STEP
    }

    /// `uniform(low, high)`: uniform in `[low, high)`.
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.random()
    }

    /// `standard_normal()`, by the ziggurat of Marsaglia and Tsang (2000) with 256 layers.
    pub fn standard_normal(&mut self) -> f64 {
        loop {
            let bits = self.bits.next_u64();
            let layer = (bits & 0xff) as usize;
            let draw = (bits >> 9) & ((1 << 52) - 1);
            let magnitude = draw as f64 * WIDTH[layer];
            let x = if bits & 0x100 == 0 {
                magnitude
            } else {
                -magnitude
            };
            if draw < INSIDE[layer] {
                return x;
            }
            if layer == 0 {
                return self.tail(draw & 0x100 != 0);
            }
            let height = (DENSITY[layer - 1] - DENSITY[layer]) * self.random() + DENSITY[layer];
            if height < (-0.5 * x * x).exp() {
                return x;
            }
        }
    }

    /// A draw beyond the last layer, by Marsaglia's method (1964).
    fn tail(&mut self, negative: bool) -> f64 {
        loop {
            let x = -TAIL_RECIPROCAL * (-self.random()).ln_1p();
            let y = -(-self.random()).ln_1p();
            if y + y > x * x {
                return if negative { -(TAIL + x) } else { TAIL + x };
            }
        }
    }

    /// `integers(n)`: uniform in `0..n`, by Lemire's method (2019). Takes no bits for `n` of 1, half a 64-bit output up
    /// to 2^32, whole ones above; `n` of 0 gives 0.
    pub fn integers(&mut self, n: u64) -> u64 {
        match n {
            0 | 1 => 0,
            _ => match u32::try_from(n) {
                Ok(n) => u64::from(self.below_32(n)),
                Err(_) if n == 1 << 32 => u64::from(self.next_32()),
                Err(_) => self.below_64(n),
            },
        }
    }

    fn below_32(&mut self, n: u32) -> u32 {
        let biased = n.wrapping_neg() % n;
        loop {
            let product = u64::from(self.next_32()) * u64::from(n);
            if product as u32 >= biased {
                return (product >> 32) as u32;
            }
        }
    }

    fn below_64(&mut self, n: u64) -> u64 {
        let biased = n.wrapping_neg() % n;
        loop {
            let product = u128::from(self.bits.next_u64()) * u128::from(n);
            if product as u64 >= biased {
                return (product >> 64) as u64;
            }
        }
    }

    fn next_32(&mut self) -> u32 {
        if let Some(high) = self.high.take() {
            return high;
        }
        let bits = self.bits.next_u64();
        self.high = Some((bits >> 32) as u32);
        bits as u32
    }
}

/// The four words with which `SeedSequence(seed)` seeds PCG64: state (high, low), stream (high, low).
///
/// The seed's 32-bit words are spread over a pool of four, every word mixed into every other, and the pool is hashed
/// into as many words as are needed (after O'Neill's `seed_seq_fe`).
fn seed_words(seed: u64) -> [u64; 4] {
    let mut hash = Hash::new(0x43b0_d7e5, 0x931e_8875);
    let mut pool = [seed as u32, (seed >> 32) as u32, 0, 0].map(|word| hash.next(word));
    for source in 0..pool.len() {
        for target in (0..pool.len()).filter(|&target| target != source) {
            let hashed = hash.next(pool[source]);
            let mixed = (pool[target].wrapping_mul(0xca01_f9dd))
                .wrapping_sub(hashed.wrapping_mul(0x4973_f715));
            pool[target] = mixed ^ (mixed >> 16);
        }
    }
    let mut hash = Hash::new(0x8b51_f9dd, 0x58f3_8ded);
    let mut word = |at: usize| u64::from(hash.next(pool[at % pool.len()]));
    std::array::from_fn(|at| word(2 * at) | (word(2 * at + 1) << 32))
}

/// The multiplicative hash of `SeedSequence`, whose multiplier changes at every use.
struct Hash {
    constant: u32,
    multiplier: u32,
}

impl Hash {
    fn new(constant: u32, multiplier: u32) -> Self {
        Self {
            constant,
            multiplier,
        }
    }

    fn next(&mut self, word: u32) -> u32 {
        let word = word ^ self.constant;
        self.constant = self.constant.wrapping_mul(self.multiplier);
        let word = word.wrapping_mul(self.constant);
        word ^ (word >> 16)
    }
}
