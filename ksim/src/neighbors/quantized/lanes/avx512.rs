//! AVX-512 BW: 32 rows in a vector.

#![expect(unsafe_code, reason = "vector instructions of one x86-64 extension")]

use std::arch::x86_64::*;

use super::avx2::Avx2;
use super::{Lanes, Operation, PAIR_BYTES, STRIP_ROWS, StripStep, VECTORS};

/// Proof that the machine has AVX-512 F and BW, and AVX2.
#[derive(Debug, Clone, Copy)]
pub(super) struct Avx512 {
    avx2: Avx2,
}

impl Avx512 {
    pub(super) fn detect() -> Option<Self> {
        let avx2 = Avx2::detect()?;
        (is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512bw"))
            .then_some(Self { avx2 })
    }

    pub(super) fn run<O: Operation>(self, operation: O) -> O::Output {
        #[target_feature(enable = "avx2,avx512f,avx512bw")]
        fn inner<O: Operation>(lanes: Avx512, operation: O) -> O::Output {
            operation.with(lanes)
        }
        // SAFETY: `self` exists only where the features were detected.
        unsafe { inner(self, operation) }
    }
}

const LANES: usize = 32;

impl Lanes for Avx512 {
    const LANES: usize = LANES;
    type Vector = __m512i;

    #[inline(always)]
    fn splat(self, value: i16) -> __m512i {
        // SAFETY: AVX-512 was detected.
        unsafe { _mm512_set1_epi16(value) }
    }

    #[inline(always)]
    fn load(self, values: &[i16]) -> __m512i {
        let values = &values[..LANES];
        // SAFETY: AVX-512 was detected; 64 bytes lie behind the pointer, of any alignment.
        unsafe { _mm512_loadu_si512(values.as_ptr().cast()) }
    }

    #[inline(always)]
    fn add(self, a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: AVX-512 was detected.
        unsafe { _mm512_adds_epi16(a, b) }
    }

    #[inline(always)]
    fn flip(self, codes: &[i8; PAIR_BYTES], flips: u32, out: &mut [i8; PAIR_BYTES]) {
        // SAFETY: AVX2 was detected as well; both arrays have the 32 bytes, of any alignment.
        unsafe {
            let flips = _mm256_set1_epi32(flips.cast_signed());
            let codes = _mm256_loadu_si256(codes.as_ptr().cast());
            let flipped = _mm256_sub_epi8(_mm256_xor_si256(codes, flips), flips);
            _mm256_storeu_si256(out.as_mut_ptr().cast(), flipped);
        }
    }

    #[inline(always)]
    fn norms(self, codes: &[[i8; PAIR_BYTES]; 2], out: &mut [i16; STRIP_ROWS]) {
        // SAFETY: AVX2 was detected as well; the arrays have 32 bytes each, of any alignment.
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
    fn dot(self, sum: __m512i, query: u32, rows: &[i8]) -> __m512i {
        let rows = &rows[..2 * LANES];
        // SAFETY: AVX-512 was detected; 64 bytes lie behind the pointer, of any alignment.
        unsafe {
            let rows = _mm512_loadu_si512(rows.as_ptr().cast());
            let products = _mm512_maddubs_epi16(_mm512_set1_epi32(query.cast_signed()), rows);
            _mm512_adds_epi16(sum, products)
        }
    }

    #[inline(always)]
    fn dots(self, sums: &mut [__m512i; VECTORS], query: u32, rows: &[i8]) {
        for (sum, rows) in sums.iter_mut().zip(rows.chunks_exact(2 * LANES)) {
            *sum = self.dot(*sum, query, rows);
        }
    }

    #[inline(always)]
    fn at_least(self, sum: __m512i, limit: __m512i) -> u32 {
        // SAFETY: AVX-512 was detected.
        unsafe { _mm512_cmpge_epi16_mask(sum, limit) }
    }

    #[inline(always)]
    fn strip_at_least(self, strip: &[[i8; PAIR_BYTES]], steps: &[StripStep], limit: i16) -> u32 {
        // A strip fills half a vector of this unit.
        self.avx2.strip_at_least(strip, steps, limit)
    }

    #[inline(always)]
    fn any_at_least(self, sums: &[__m512i; VECTORS], limit: __m512i) -> u32 {
        (0..VECTORS).fold(0, |bits, vector| {
            bits | u32::from(self.at_least(sums[vector], limit) != 0) << (2 * vector)
        })
    }
}
