//! AVX2: 16 rows in a vector.

#![expect(unsafe_code, reason = "vector instructions of one x86-64 extension")]

use std::arch::x86_64::*;

use super::{Lanes, Operation, PAIR_BYTES, STRIP_ROWS, StripStep, VECTORS};

/// Proof that the machine has AVX2.
#[derive(Debug, Clone, Copy)]
pub(super) struct Avx2(());

impl Avx2 {
    pub(super) fn detect() -> Option<Self> {
        is_x86_feature_detected!("avx2").then_some(Self(()))
    }

    pub(super) fn run<O: Operation>(self, operation: O) -> O::Output {
        #[target_feature(enable = "avx2")]
        fn inner<O: Operation>(lanes: Avx2, operation: O) -> O::Output {
            operation.with(lanes)
        }
        // SAFETY: `self` exists only where AVX2 was detected.
        unsafe { inner(self, operation) }
    }
}

const LANES: usize = 16;

impl Lanes for Avx2 {
    const LANES: usize = LANES;
    type Vector = __m256i;

    #[inline(always)]
    fn splat(self, value: i16) -> __m256i {
        // SAFETY: AVX2 was detected.
        unsafe { _mm256_set1_epi16(value) }
    }

    #[inline(always)]
    fn load(self, values: &[i16]) -> __m256i {
        let values = &values[..LANES];
        // SAFETY: AVX2 was detected; 32 bytes lie behind the pointer, of any alignment.
        unsafe { _mm256_loadu_si256(values.as_ptr().cast()) }
    }

    #[inline(always)]
    fn add(self, a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: AVX2 was detected.
        unsafe { _mm256_adds_epi16(a, b) }
    }

    #[inline(always)]
    fn flip(self, codes: &[i8; PAIR_BYTES], flips: u32, out: &mut [i8; PAIR_BYTES]) {
        // SAFETY: AVX2 was detected; both arrays have the 32 bytes, of any alignment.
        unsafe {
            let flips = _mm256_set1_epi32(flips.cast_signed());
            let codes = _mm256_loadu_si256(codes.as_ptr().cast());
            let flipped = _mm256_sub_epi8(_mm256_xor_si256(codes, flips), flips);
            _mm256_storeu_si256(out.as_mut_ptr().cast(), flipped);
        }
    }

    #[inline(always)]
    fn norms(self, codes: &[[i8; PAIR_BYTES]; 2], out: &mut [i16; STRIP_ROWS]) {
        // SAFETY: AVX2 was detected; the arrays have 32 bytes each, of any alignment.
        unsafe {
            let half = |pair: &[i8; PAIR_BYTES]| {
                let magnitudes = _mm256_abs_epi8(_mm256_loadu_si256(pair.as_ptr().cast()));
                _mm256_srli_epi16::<1>(_mm256_maddubs_epi16(magnitudes, magnitudes))
            };
            let sum = _mm256_add_epi16(half(&codes[0]), half(&codes[1]));
            let negative = _mm256_sub_epi16(_mm256_setzero_si256(), sum);
            _mm256_storeu_si256(out.as_mut_ptr().cast(), negative);
        }
    }

    #[inline(always)]
    fn dot(self, sum: __m256i, query: u32, rows: &[i8]) -> __m256i {
        let rows = &rows[..2 * LANES];
        // SAFETY: AVX2 was detected; 32 bytes lie behind the pointer, of any alignment.
        unsafe {
            let rows = _mm256_loadu_si256(rows.as_ptr().cast());
            let products = _mm256_maddubs_epi16(_mm256_set1_epi32(query.cast_signed()), rows);
            _mm256_adds_epi16(sum, products)
        }
    }

    #[inline(always)]
    fn dots(self, sums: &mut [__m256i; VECTORS], query: u32, rows: &[i8]) {
        let rows = &rows[..2 * LANES * VECTORS];
        // SAFETY: AVX2 was detected; `VECTORS` times 32 bytes lie behind the pointer.
        unsafe {
            let query = _mm256_set1_epi32(query.cast_signed());
            for (vector, sum) in sums.iter_mut().enumerate() {
                let rows = _mm256_loadu_si256(rows.as_ptr().add(2 * LANES * vector).cast());
                *sum = _mm256_adds_epi16(*sum, _mm256_maddubs_epi16(query, rows));
            }
        }
    }

    #[inline(always)]
    fn at_least(self, sum: __m256i, limit: __m256i) -> u32 {
        // SAFETY: AVX2 was detected.
        unsafe {
            // Bytes 0 to 7 are lanes 0 to 7, bytes 16 to 23 are lanes 8 to 15.
            let below = _mm256_cmpgt_epi16(limit, sum);
            let bytes = _mm256_packs_epi16(below, _mm256_set1_epi16(-1));
            let passed = !_mm256_movemask_epi8(bytes).cast_unsigned();
            passed & 0xFF | passed >> 8 & 0xFF00
        }
    }

    #[inline(always)]
    fn strip_at_least(self, strip: &[[i8; PAIR_BYTES]], steps: &[StripStep], limit: i16) -> u32 {
        let mut sum = self.splat(0);
        for step in steps {
            let codes = strip[step.pair].as_ptr();
            // SAFETY: AVX2 was detected; 32 bytes lie behind the pointer, of any alignment.
            unsafe {
                let codes = _mm256_loadu_si256(codes.cast());
                let magnitudes = _mm256_abs_epi8(codes);
                let norms = _mm256_maddubs_epi16(magnitudes, magnitudes);
                let signs = _mm256_set1_epi32(step.signs.cast_signed());
                let query = _mm256_set1_epi32(step.magnitudes.cast_signed());
                let products = _mm256_maddubs_epi16(query, _mm256_sign_epi8(codes, signs));
                sum = _mm256_subs_epi16(sum, _mm256_srli_epi16::<1>(norms));
                sum = _mm256_adds_epi16(sum, products);
            }
        }
        self.at_least(sum, self.splat(limit))
    }

    #[inline(always)]
    fn any_at_least(self, sums: &[__m256i; VECTORS], limit: __m256i) -> u32 {
        // SAFETY: AVX2 was detected.
        let missed = unsafe {
            let below = |vector: usize| _mm256_cmpgt_epi16(limit, sums[vector]);
            // Packing keeps "all bits set" where both halves have them, and only there. In the end
            // every vector has two bytes in each half of the register.
            let pair = |vector| _mm256_packs_epi16(below(vector), below(vector + 1));
            let four = |vector| _mm256_packs_epi16(pair(vector), pair(vector + 2));
            let eight = _mm256_packs_epi16(four(0), four(4));
            let all = _mm256_cmpeq_epi8(eight, _mm256_set1_epi8(-1));
            _mm256_movemask_epi8(all).cast_unsigned()
        };
        // Neither half may have missed: two bits to a vector.
        !(missed & missed >> 16) & 0xFFFF
    }
}
