//! What the first pass asks of a vector unit, and which units this machine has.
//!
//! The pass itself is written once, over [`Lanes`]; a leaf holds nothing but the loads and the
//! arithmetic of one instruction set. All give the same integers for the same rows.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;
mod scalar;

use super::codes::STRIP_ROWS;

/// Vectors that one step of the pass carries: as many accumulators as hide the latency of a
/// multiply-add, and leave registers for its operands.
pub(super) const VECTORS: usize = 8;

/// Bytes that [`Lanes::flip`] copies, and rows that [`Lanes::norms`] takes at a time: a strip's.
pub(super) const PAIR_BYTES: usize = 2 * STRIP_ROWS;

/// One pair of columns of a query, for [`Lanes::strip_at_least`].
#[derive(Debug, Clone, Copy)]
pub(super) struct StripStep {
    /// Which pair of a strip.
    pub(super) pair: usize,
    /// Both magnitudes, at most 127, twice.
    magnitudes: u32,
    /// Both signs, bytes of 1 or −1, twice.
    signs: u32,
}

impl StripStep {
    /// `magnitudes` holds both twice; a bit of `negative` is set for each that is negative.
    pub(super) fn new(pair: usize, magnitudes: u32, negative: u8) -> Self {
        let sign = |bit: u8| if negative >> bit & 1 == 1 { 0xFF } else { 1 };
        Self {
            pair,
            magnitudes,
            signs: (sign(0) | sign(1) << 8) * 0x0001_0001,
        }
    }

    /// The two values.
    fn values(&self) -> [i16; 2] {
        let (magnitudes, signs) = (self.magnitudes.to_le_bytes(), self.signs.to_le_bytes());
        std::array::from_fn(|at| i16::from(magnitudes[at]) * i16::from(signs[at].cast_signed()))
    }
}

/// Vectors of 16-bit integers, one lane to a row.
pub(super) trait Lanes: Copy {
    /// Rows in a vector, at most 32.
    const LANES: usize;
    type Vector: Copy;

    fn splat(self, value: i16) -> Self::Vector;

    /// The first [`LANES`](Self::LANES) values.
    fn load(self, values: &[i16]) -> Self::Vector;

    /// `a + b`, saturating.
    fn add(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;

    /// Copies the codes of a pair of columns in one strip, `(code ^ flips) − flips`; `flips` holds the
    /// two columns' bytes twice, all bits set for a column to negate.
    fn flip(self, codes: &[i8; PAIR_BYTES], flips: u32, out: &mut [i8; PAIR_BYTES]);

    /// −⌊(a² + b²)/2⌋ − ⌊(c² + d²)/2⌋ for the rows of a strip, from the codes of two pairs of columns.
    fn norms(self, codes: &[[i8; PAIR_BYTES]; 2], out: &mut [i16; STRIP_ROWS]);

    /// Adds to every lane, saturating, the product of its two codes in `rows` with the pair of
    /// bytes that `query` holds twice, each at most 127 (so that no product saturates).
    fn dot(self, sum: Self::Vector, query: u32, rows: &[i8]) -> Self::Vector;

    /// [`dot`](Self::dot) for [`VECTORS`] vectors, whose rows follow each other.
    fn dots(self, sums: &mut [Self::Vector; VECTORS], query: u32, rows: &[i8]);

    /// A bit for every lane that is at least `limit`.
    fn at_least(self, sum: Self::Vector, limit: Self::Vector) -> u32;

    /// Two bits for every vector, at least one of them set where a lane is at least `limit`.
    fn any_at_least(self, sums: &[Self::Vector; VECTORS], limit: Self::Vector) -> u32;

    /// A bit for every row of a strip whose sum over the pairs of `steps` is at least `limit`: pair by
    /// pair, saturating, ⌊(a² + b²)/2⌋ is taken away, then the product with the query added.
    #[inline(always)]
    fn strip_at_least(self, strip: &[[i8; PAIR_BYTES]], steps: &[StripStep], limit: i16) -> u32 {
        let mut sums = [0i16; STRIP_ROWS];
        for step in steps {
            let [p, q] = step.values();
            let (codes, _) = strip[step.pair].as_chunks::<2>();
            for (sum, codes) in sums.iter_mut().zip(codes) {
                let [a, b] = codes.map(i16::from);
                *sum = sum.saturating_sub((a * a + b * b) >> 1);
                *sum = sum.saturating_add(a * p + b * q);
            }
        }
        let bits = sums.iter().enumerate();
        bits.fold(0, |bits, (lane, &sum)| {
            bits | u32::from(sum >= limit) << lane
        })
    }
}

/// Code that is compiled for each vector unit.
pub(super) trait Operation {
    type Output;
    fn with<L: Lanes>(self, lanes: L) -> Self::Output;
}

/// A vector unit that the first pass of `blocked` and `clusters` is compiled for. The best one
/// that the machine has is taken by itself; the answer is the same with any.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Simd {
    /// Plain Rust, on every machine.
    Scalar,
    /// x86-64 with AVX2: 16 rows at a time.
    Avx2,
    /// x86-64 with AVX-512 BW: 32 rows at a time.
    Avx512,
    /// 64-bit Arm: 8 rows at a time.
    Neon,
}

impl Simd {
    /// Every unit, from the slowest.
    const ALL: [Self; 4] = [Self::Scalar, Self::Neon, Self::Avx2, Self::Avx512];

    /// The units of this machine, the best last.
    pub fn available() -> Vec<Self> {
        Self::ALL
            .into_iter()
            .filter(|simd| simd.is_available())
            .collect()
    }

    /// The best unit of this machine.
    pub fn best() -> Self {
        Self::ALL
            .into_iter()
            .rev()
            .find(|simd| simd.is_available())
            .unwrap_or(Self::Scalar)
    }

    /// Whether this machine has it.
    pub fn is_available(self) -> bool {
        match self {
            Self::Scalar => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => avx2::Avx2::detect().is_some(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => avx512::Avx512::detect().is_some(),
            #[cfg(target_arch = "aarch64")]
            Self::Neon => neon::Neon::detect().is_some(),
            #[allow(unreachable_patterns, reason = "depends on the architecture")]
            _ => false,
        }
    }

    /// Runs `operation` on this unit; on plain Rust where the machine lacks it.
    pub(super) fn run<O: Operation>(self, operation: O) -> O::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => {
                if let Some(lanes) = avx2::Avx2::detect() {
                    return lanes.run(operation);
                }
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                if let Some(lanes) = avx512::Avx512::detect() {
                    return lanes.run(operation);
                }
            }
            #[cfg(target_arch = "aarch64")]
            Self::Neon => {
                if let Some(lanes) = neon::Neon::detect() {
                    return lanes.run(operation);
                }
            }
            _ => {}
        }
        operation.with(scalar::Scalar)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs every operation of a unit over given lanes and writes down what comes out.
    struct Probe<'a> {
        rows: &'a [i8],
        starts: &'a [i16],
        query: u32,
        flips: u32,
        limit: i16,
        steps: Vec<StripStep>,
    }

    #[derive(Debug, PartialEq)]
    struct Seen {
        /// One bit per row: start + products at least the limit.
        passed: Vec<bool>,
        /// The same after adding the start once more.
        passed_twice: Vec<bool>,
        /// Per 32 rows, so that units of any width agree.
        any: Vec<bool>,
        flipped: Vec<i8>,
        norms: Vec<i16>,
        /// Per strip of two pairs, the rows at the limit.
        strips: Vec<u32>,
    }

    impl Operation for Probe<'_> {
        type Output = Seen;

        fn with<L: Lanes>(self, lanes: L) -> Seen {
            let mut seen = Seen {
                passed: Vec::new(),
                passed_twice: Vec::new(),
                any: Vec::new(),
                flipped: vec![0; self.rows.len()],
                norms: vec![0; self.rows.len() / 4],
                strips: Vec::new(),
            };
            let pairs = self.rows.as_chunks::<PAIR_BYTES>().0;
            let flipped = seen.flipped.as_chunks_mut::<PAIR_BYTES>().0;
            for (codes, out) in pairs.iter().zip(flipped) {
                lanes.flip(codes, self.flips, out);
            }
            let norms = seen.norms.as_chunks_mut::<STRIP_ROWS>().0;
            for (codes, out) in pairs.as_chunks::<2>().0.iter().zip(norms) {
                lanes.norms(codes, out);
            }
            for strip in pairs.chunks_exact(2) {
                let bits = lanes.strip_at_least(strip, &self.steps, self.limit);
                seen.strips.push(bits);
            }
            let limit = lanes.splat(self.limit);
            let mut by_vector = Vec::new();
            for (starts, rows) in self
                .starts
                .chunks_exact(VECTORS * L::LANES)
                .zip(self.rows.chunks_exact(2 * VECTORS * L::LANES))
            {
                let mut sums: [L::Vector; VECTORS] =
                    std::array::from_fn(|vector| lanes.load(&starts[vector * L::LANES..]));
                lanes.dots(&mut sums, self.query, rows);
                let any = lanes.any_at_least(&sums, limit);
                for vector in 0..VECTORS {
                    let start = lanes.load(&starts[vector * L::LANES..]);
                    let sum = lanes.dot(start, self.query, &rows[vector * 2 * L::LANES..]);
                    let bits = lanes.at_least(sum, limit);
                    assert_eq!(
                        bits,
                        lanes.at_least(sums[vector], limit),
                        "dot and dots differ"
                    );
                    let twice = lanes.at_least(lanes.add(sum, start), limit);
                    for lane in 0..L::LANES {
                        seen.passed.push(bits >> lane & 1 != 0);
                        seen.passed_twice.push(twice >> lane & 1 != 0);
                        by_vector.push(any >> (2 * vector) & 3 != 0);
                    }
                }
            }
            seen.any = by_vector
                .chunks(32)
                .map(|flags| flags.iter().any(|flag| *flag))
                .collect();
            seen
        }
    }

    /// 512 rows: a whole number of tiles of every unit.
    const ROWS: usize = 512;

    #[test]
    fn every_unit_does_what_plain_rust_does() {
        let mut state = 9u64;
        let mut next = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            state >> 40
        };
        // Miri is a thousand times slower, and a few rounds meet every instruction.
        for round in 0..if cfg!(miri) { 5 } else { 60 } {
            let largest = [127, 5, 40][round % 3];
            let code = |value: u64| (value % (2 * largest + 1)) as i64 - largest as i64;
            let rows: Vec<i8> = (0..2 * ROWS).map(|_| code(next()) as i8).collect();
            // Near both ends as well, where sums saturate.
            let starts: Vec<i16> = (0..ROWS)
                .map(|_| match next() % 8 {
                    0 => i16::MIN,
                    1 => i16::MAX,
                    _ => (next() as i16) / [1, 64][round % 2],
                })
                .collect();
            let [first, second] = [next() % (largest + 1), next() % (largest + 1)];
            let query = (first | second << 8) as u32 * 0x0001_0001;
            let limit = match round % 5 {
                0 => i16::MIN,
                1 => i16::MAX,
                // Few rows above, so that whole vectors are below.
                2 => i16::MAX - 40,
                _ => next() as i16,
            };
            let expected: Vec<i16> = starts
                .iter()
                .zip(rows.as_chunks::<2>().0)
                .map(|(&start, row)| {
                    let products =
                        first as i64 * i64::from(row[0]) + second as i64 * i64::from(row[1]);
                    (i64::from(start) + products).clamp(i64::from(i16::MIN), i64::from(i16::MAX))
                        as i16
                })
                .collect();
            let passed: Vec<bool> = expected.iter().map(|&sum| sum >= limit).collect();
            let twice = expected
                .iter()
                .zip(&starts)
                .map(|(sum, start)| sum.saturating_add(*start) >= limit);
            let signs = round % 4;
            let flips = [0, 0x00FF_00FF, 0xFF00_FF00, u32::MAX][signs];
            let negate = |(at, &code): (usize, &i8)| {
                if signs >> (at % 2) & 1 == 1 {
                    -code
                } else {
                    code
                }
            };
            let half = |row: usize, pair: usize| {
                let at = row / 16 * 64 + pair * 32 + row % 16 * 2;
                let square = |at: usize| i16::from(rows[at]) * i16::from(rows[at]);
                (square(at) + square(at + 1)) / 2
            };
            let steps: Vec<StripStep> = (0..2)
                .map(|pair| StripStep::new(pair, query.rotate_left(8 * pair as u32), signs as u8))
                .collect();
            let strip = |at: usize, lane: usize| {
                steps.iter().fold(0i16, |sum, step| {
                    let [p, q] = step.values();
                    let place = at * 64 + step.pair * 32 + lane * 2;
                    let (a, b) = (i16::from(rows[place]), i16::from(rows[place + 1]));
                    sum.saturating_sub((a * a + b * b) / 2)
                        .saturating_add(a * p + b * q)
                })
            };
            let strips = (0..2 * ROWS / 64).map(|at| {
                (0..16).fold(0, |bits, lane| {
                    bits | u32::from(strip(at, lane) >= limit) << lane
                })
            });
            let seen = Seen {
                strips: strips.collect(),
                flipped: rows.iter().enumerate().map(negate).collect(),
                norms: (0..ROWS / 2)
                    .map(|row| -half(row, 0) - half(row, 1))
                    .collect(),
                passed_twice: twice.collect(),
                any: passed.chunks(32).map(|rows| rows.contains(&true)).collect(),
                passed,
            };
            for simd in Simd::available() {
                let probe = Probe {
                    rows: &rows,
                    starts: &starts,
                    query,
                    flips,
                    limit,
                    steps: steps.clone(),
                };
                assert_eq!(simd.run(probe), seen, "{simd:?}, round {round}");
            }
        }
    }
}
