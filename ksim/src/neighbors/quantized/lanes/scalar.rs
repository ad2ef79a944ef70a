//! Plain Rust: the definition that the other units are tested against.

use super::{Lanes, PAIR_BYTES, STRIP_ROWS, VECTORS};

#[derive(Debug, Clone, Copy)]
pub(super) struct Scalar;

const LANES: usize = 16;

impl Lanes for Scalar {
    const LANES: usize = LANES;
    type Vector = [i16; LANES];

    #[inline(always)]
    fn splat(self, value: i16) -> Self::Vector {
        [value; LANES]
    }

    #[inline(always)]
    fn load(self, values: &[i16]) -> Self::Vector {
        std::array::from_fn(|lane| values[lane])
    }

    #[inline(always)]
    fn add(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
        std::array::from_fn(|lane| a[lane].saturating_add(b[lane]))
    }

    #[inline(always)]
    fn flip(self, codes: &[i8; PAIR_BYTES], flips: u32, out: &mut [i8; PAIR_BYTES]) {
        let flips = flips.to_le_bytes().map(u8::cast_signed);
        for (at, (out, code)) in out.iter_mut().zip(codes).enumerate() {
            *out = (code ^ flips[at % 2]).wrapping_sub(flips[at % 2]);
        }
    }

    #[inline(always)]
    fn norms(self, codes: &[[i8; PAIR_BYTES]; 2], out: &mut [i16; STRIP_ROWS]) {
        let half = |pair: &[i8; PAIR_BYTES], row: usize| {
            let square = |code: i8| i16::from(code) * i16::from(code);
            (square(pair[2 * row]) + square(pair[2 * row + 1])) >> 1
        };
        for (row, out) in out.iter_mut().enumerate() {
            *out = -half(&codes[0], row) - half(&codes[1], row);
        }
    }

    #[inline(always)]
    fn dot(self, sum: Self::Vector, query: u32, rows: &[i8]) -> Self::Vector {
        let [first, second, _, _] = query.to_le_bytes().map(i16::from);
        let (rows, _) = rows.as_chunks::<2>();
        std::array::from_fn(|lane| {
            let [a, b] = rows[lane].map(i16::from);
            sum[lane].saturating_add((first * a).saturating_add(second * b))
        })
    }

    #[inline(always)]
    fn dots(self, sums: &mut [Self::Vector; VECTORS], query: u32, rows: &[i8]) {
        for (sum, rows) in sums.iter_mut().zip(rows.chunks_exact(2 * LANES)) {
            *sum = self.dot(*sum, query, rows);
        }
    }

    #[inline(always)]
    fn at_least(self, sum: Self::Vector, limit: Self::Vector) -> u32 {
        (0..LANES).fold(0, |bits, lane| {
            bits | u32::from(sum[lane] >= limit[lane]) << lane
        })
    }

    #[inline(always)]
    fn any_at_least(self, sums: &[Self::Vector; VECTORS], limit: Self::Vector) -> u32 {
        (0..VECTORS).fold(0, |bits, vector| {
            bits | u32::from(self.at_least(sums[vector], limit) != 0) << (2 * vector)
        })
    }
}
