//! NEON, which every 64-bit Arm has: 8 rows in a vector.

#![expect(unsafe_code, reason = "vector instructions of one Arm extension")]

use std::arch::aarch64::*;

use super::{Lanes, Operation, PAIR_BYTES, STRIP_ROWS, VECTORS};

/// Proof that the machine has NEON.
#[derive(Debug, Clone, Copy)]
pub(super) struct Neon(());

impl Neon {
    pub(super) fn detect() -> Option<Self> {
        std::arch::is_aarch64_feature_detected!("neon").then_some(Self(()))
    }

    pub(super) fn run<O: Operation>(self, operation: O) -> O::Output {
        // NEON is part of the base line of the architecture: nothing to enable.
        operation.with(self)
    }
}

const LANES: usize = 8;

impl Lanes for Neon {
    const LANES: usize = LANES;
    type Vector = int16x8_t;

    #[inline(always)]
    fn splat(self, value: i16) -> int16x8_t {
        // SAFETY: NEON was detected.
        unsafe { vdupq_n_s16(value) }
    }

    #[inline(always)]
    fn load(self, values: &[i16]) -> int16x8_t {
        let values = &values[..LANES];
        // SAFETY: NEON was detected; 8 values lie behind the pointer.
        unsafe { vld1q_s16(values.as_ptr()) }
    }

    #[inline(always)]
    fn add(self, a: int16x8_t, b: int16x8_t) -> int16x8_t {
        // SAFETY: NEON was detected.
        unsafe { vqaddq_s16(a, b) }
    }

    #[inline(always)]
    fn flip(self, codes: &[i8; PAIR_BYTES], flips: u32, out: &mut [i8; PAIR_BYTES]) {
        for (codes, out) in codes
            .as_chunks::<16>()
            .0
            .iter()
            .zip(out.as_chunks_mut::<16>().0)
        {
            // SAFETY: NEON was detected; both arrays have 16 bytes.
            unsafe {
                let flips = vreinterpretq_s8_u32(vdupq_n_u32(flips));
                let flipped = vsubq_s8(veorq_s8(vld1q_s8(codes.as_ptr()), flips), flips);
                vst1q_s8(out.as_mut_ptr(), flipped);
            }
        }
    }

    #[inline(always)]
    fn norms(self, codes: &[[i8; PAIR_BYTES]; 2], out: &mut [i16; STRIP_ROWS]) {
        let [first, second] = codes.each_ref().map(|pair| pair.as_chunks::<16>().0);
        let rows = out.as_chunks_mut::<LANES>().0.iter_mut();
        for ((first, second), out) in first.iter().zip(second).zip(rows) {
            // SAFETY: NEON was detected; the arrays have 16 bytes each.
            unsafe {
                let half = |pair: &[i8; 16]| {
                    let codes = vld1q_s8(pair.as_ptr());
                    let low = vmull_s8(vget_low_s8(codes), vget_low_s8(codes));
                    vshrq_n_s16::<1>(vpaddq_s16(low, vmull_high_s8(codes, codes)))
                };
                vst1q_s16(
                    out.as_mut_ptr(),
                    vnegq_s16(vaddq_s16(half(first), half(second))),
                );
            }
        }
    }

    #[inline(always)]
    fn dot(self, sum: int16x8_t, query: u32, rows: &[i8]) -> int16x8_t {
        let rows = &rows[..2 * LANES];
        // SAFETY: NEON was detected; 16 bytes lie behind the pointer. The query's bytes are at
        // most 127, so that they are the same numbers signed.
        unsafe {
            let query = vreinterpretq_s8_u32(vdupq_n_u32(query));
            let rows = vld1q_s8(rows.as_ptr());
            let low = vmull_s8(vget_low_s8(query), vget_low_s8(rows));
            let high = vmull_high_s8(query, rows);
            vqaddq_s16(sum, vpaddq_s16(low, high))
        }
    }

    #[inline(always)]
    fn dots(self, sums: &mut [int16x8_t; VECTORS], query: u32, rows: &[i8]) {
        for (sum, rows) in sums.iter_mut().zip(rows.chunks_exact(2 * LANES)) {
            *sum = self.dot(*sum, query, rows);
        }
    }

    #[inline(always)]
    fn at_least(self, sum: int16x8_t, limit: int16x8_t) -> u32 {
        const BITS: [u16; LANES] = [1, 2, 4, 8, 16, 32, 64, 128];
        // SAFETY: NEON was detected; `BITS` has 8 values.
        unsafe {
            let passed = vcgeq_s16(sum, limit);
            u32::from(vaddvq_u16(vandq_u16(passed, vld1q_u16(BITS.as_ptr()))))
        }
    }

    #[inline(always)]
    fn any_at_least(self, sums: &[int16x8_t; VECTORS], limit: int16x8_t) -> u32 {
        (0..VECTORS).fold(0, |bits, vector| {
            // SAFETY: NEON was detected.
            let most = unsafe { vmaxvq_u16(vcgeq_s16(sums[vector], limit)) };
            bits | u32::from(most != 0) << (2 * vector)
        })
    }
}
