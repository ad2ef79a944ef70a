//! Weights in panels, as f32 or in half the bytes.
//!
//! One window waits for weights to be read. As bf16, the upper half of an f32, they are read in half the time. An
//! output's weights for two inputs share a word, the first in its lower half, so that a vector of words becomes two
//! vectors of f32 by a shift and a mask, however long vectors are. Sums stay f32.

use half::bf16;
use pulp::Simd;

use super::product::PANEL;

/// Weights of `[panel][tap][input][PANEL]`.
#[derive(Clone, Copy)]
pub(super) enum Panels<'a> {
    /// As they are.
    Whole(&'a [f32]),
    /// Rounded to bf16: `[panel][tap][pair of inputs][PANEL]`, the last pair of a tap filled up with zeros.
    Halves(&'a [u32]),
}

impl<'a> Panels<'a> {
    /// The weights of a tap of a panel, of layers with so many of both.
    #[inline(always)]
    pub(super) fn tap(self, (panel, tap): (usize, usize), taps: usize, inputs: usize) -> Self {
        let at = panel * taps + tap;
        match self {
            Self::Whole(numbers) => {
                let len = inputs * PANEL;
                Self::Whole(&numbers[at * len..][..len])
            }
            Self::Halves(words) => {
                let len = inputs.div_ceil(2) * PANEL;
                Self::Halves(&words[at * len..][..len])
            }
        }
    }

    /// The weights of `n` inputs of a tap, from the input `first`, which is even.
    #[inline(always)]
    pub(super) fn inputs(self, first: usize, n: usize) -> Self {
        match self {
            Self::Whole(numbers) => Self::Whole(&numbers[first * PANEL..][..n * PANEL]),
            Self::Halves(words) => {
                Self::Halves(&words[first / 2 * PANEL..][..n.div_ceil(2) * PANEL])
            }
        }
    }
}

/// Words for the weights of a layer.
pub(super) fn n_words(n_weights: usize, inputs: usize) -> usize {
    n_weights / inputs * inputs.div_ceil(2)
}

/// Rounds the weights of a layer, `[panel][tap][input][PANEL]`.
pub(super) fn halve(weights: &[f32], inputs: usize, words: &mut [u32]) {
    let (rows, _) = weights.as_chunks::<PANEL>();
    let (words, _) = words.as_chunks_mut::<PANEL>();
    let taps = rows.chunks_exact(inputs);
    for (rows, words) in taps.zip(words.chunks_exact_mut(inputs.div_ceil(2))) {
        for (pair, words) in rows.chunks(2).zip(words) {
            for (output, word) in words.iter_mut().enumerate() {
                let bits = |row: &[f32; PANEL]| u32::from(bf16::from_f32(row[output]).to_bits());
                *word = bits(&pair[0]) | pair.get(1).map_or(0, bits) << 16;
            }
        }
    }
}

/// The weights of both inputs of a pair.
#[inline(always)]
pub(super) fn widen<S: Simd, const VECTORS: usize>(
    simd: S,
    words: &[S::u32s; VECTORS],
) -> [[S::f32s; VECTORS]; 2] {
    let sixteen = simd.splat_u32s(16);
    let upper = simd.splat_u32s(0xFFFF_0000);
    let mut pair = [[simd.splat_f32s(0.0); VECTORS]; 2];
    for v in 0..VECTORS {
        let first = simd.wrapping_dyn_shl_u32s(words[v], sixteen);
        pair[0][v] = simd.transmute_f32s_u32s(first);
        pair[1][v] = simd.transmute_f32s_u32s(simd.and_u32s(words[v], upper));
    }
    pair
}
