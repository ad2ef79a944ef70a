//! The way back of few windows through a large layer, with the weights of the way forward.
//!
//! One window waits for weights to be read, so both ways read the same ones: what stays in the cache is not read
//! twice. The weights of an input lie in a run of [`PANEL`] outputs; their products with the gradient are summed lane
//! by lane, for as many inputs at a time as the first cache holds, and the lanes at the end.

use pulp::{Arch, Simd, WithSimd};

use super::aligned::Aligned;
use super::geometry::Pass;
use super::panels::{Panels, widen};
use super::plan::Layer;
use super::product::{PANEL, n_panels};

/// From so many weights on it pays.
const LEAST_WEIGHTS: usize = 1 << 16;

/// Numbers of the result, for all inputs at a time, whose lanes stay in the first cache.
const BLOCK: usize = 512;

/// Rows of the gradient that are held in registers. For a group with more of them the product with a copy of the
/// weights, whose sums stay in registers, is faster. A row's sums do not depend on the rows beside it.
const ROWS: usize = 4;

/// Whether a layer is computed this way for groups of so many windows.
pub(super) fn pays(layer: &Layer, group: usize) -> bool {
    layer.n_weights() >= LEAST_WEIGHTS && layer.length * group <= ROWS
}

/// The gradient by a layer's input, from the gradient by its output.
pub(super) struct Shared<'a> {
    /// `[positions of the output][samples][outputs]`.
    pub(super) gradient: &'a [f32],
    /// Positions of the output.
    pub(super) length: usize,
    pub(super) samples: usize,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    pub(super) taps: usize,
    /// `[panel][tap][inputs][PANEL]`, as on the way forward.
    pub(super) weights: Panels<'a>,
    /// Of the way back.
    pub(super) passes: &'a [Pass],
    /// The result is added to what is there.
    pub(super) adds: bool,
}

/// A row of the gradient that a tap reads for a row of the result.
#[derive(Debug, Clone, Copy)]
struct Pair {
    result: usize,
    gradient: usize,
}

impl Shared<'_> {
    /// Writes all of `output`, `[positions][samples][inputs]`; `lanes` is room.
    pub(super) fn write(&self, lanes: &mut Aligned, output: &mut [f32]) {
        let rows = output.len() / self.inputs;
        let block = (BLOCK / rows).clamp(PANEL, self.inputs.max(PANEL));
        // Two inputs may share a word.
        let block = block.next_multiple_of(2);
        lanes.grow(rows * block * PANEL);
        let pairs: Vec<Vec<Pair>> = (0..self.taps).map(|tap| self.pairs(tap)).collect();
        Arch::new().dispatch(Run {
            shared: self,
            pairs: &pairs,
            block,
            lanes,
            output,
        });
    }

    fn pairs(&self, weight: usize) -> Vec<Pair> {
        let mut pairs = Vec::new();
        for pass in self.passes {
            let Some(tap) = pass.taps.iter().find(|tap| tap.weight == weight) else {
                continue;
            };
            for m in 0..pass.count {
                if let Some(position) = pass.reads(m, *tap, self.length) {
                    let result = (pass.start + m * pass.step) * self.samples;
                    pairs.extend((0..self.samples).map(|n| Pair {
                        result: result + n,
                        gradient: position * self.samples + n,
                    }));
                }
            }
        }
        pairs
    }
}

struct Run<'a> {
    shared: &'a Shared<'a>,
    pairs: &'a [Vec<Pair>],
    /// Inputs at a time.
    block: usize,
    lanes: &'a mut [f32],
    output: &'a mut [f32],
}

impl WithSimd for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match PANEL / S::F32_LANES {
            1 => self.run::<S, 1>(simd),
            2 => self.run::<S, 2>(simd),
            4 => self.run::<S, 4>(simd),
            _ => self.run::<S, PANEL>(simd),
        }
    }
}

// Loops, not closures over arrays: those would not become part of the vectorized function.
impl Run<'_> {
    #[inline(always)]
    fn run<S: Simd, const VECTORS: usize>(self, simd: S) {
        let shared = self.shared;
        let inputs = shared.inputs;
        let rows = self.output.len() / inputs;
        for first in (0..inputs).step_by(self.block) {
            let n = self.block.min(inputs - first);
            let lanes = &mut S::as_mut_simd_f32s(self.lanes).0[..rows * n];
            lanes.fill(simd.splat_f32s(0.0));
            for panel in 0..n_panels(shared.outputs) {
                for (tap, pairs) in self.pairs.iter().enumerate() {
                    let weights = shared.weights.tap((panel, tap), shared.taps, inputs);
                    let weights = weights.inputs(first, n);
                    for pairs in pairs.chunks(ROWS) {
                        let of = (pairs, panel, n);
                        match pairs.len() {
                            1 => add::<S, 1, VECTORS>(simd, shared, of, weights, lanes),
                            2 => add::<S, 2, VECTORS>(simd, shared, of, weights, lanes),
                            3 => add::<S, 3, VECTORS>(simd, shared, of, weights, lanes),
                            _ => add::<S, ROWS, VECTORS>(simd, shared, of, weights, lanes),
                        }
                    }
                }
            }
            for row in 0..rows {
                let output = &mut self.output[row * inputs + first..][..n];
                for c in 0..n {
                    let sum = simd.reduce_sum_f32s(lanes[row * n + c]);
                    output[c] = if shared.adds { output[c] + sum } else { sum };
                }
            }
        }
    }
}

/// Adds the products of some rows of the gradient with a tap's weights in a panel, of `n` inputs.
#[inline(always)]
fn add<S: Simd, const N: usize, const VECTORS: usize>(
    simd: S,
    shared: &Shared<'_>,
    (pairs, panel, n): (&[Pair], usize, usize),
    weights: Panels<'_>,
    lanes: &mut [S::f32s],
) {
    let column = panel * PANEL;
    let width = PANEL.min(shared.outputs - column);
    let mut gradients = [[simd.splat_f32s(0.0); VECTORS]; N];
    let mut starts = [0; N];
    for i in 0..N {
        let mut row = [0.0; PANEL];
        let start = pairs[i].gradient * shared.outputs + column;
        row[..width].copy_from_slice(&shared.gradient[start..][..width]);
        gradients[i].copy_from_slice(S::as_simd_f32s(&row).0);
        starts[i] = pairs[i].result;
    }
    match weights {
        Panels::Whole(weights) => {
            let (weights, _) = S::as_simd_f32s(weights).0.as_chunks::<VECTORS>();
            for c in 0..n {
                for i in 0..N {
                    let sum = &mut lanes[starts[i] * n + c];
                    for v in 0..VECTORS {
                        *sum = simd.mul_add_f32s(gradients[i][v], weights[c][v], *sum);
                    }
                }
            }
        }
        Panels::Halves(words) => {
            let (words, _) = S::as_simd_u32s(words).0.as_chunks::<VECTORS>();
            for c in (0..n).step_by(2) {
                let weights = widen::<S, VECTORS>(simd, &words[c / 2]);
                for half in 0..(n - c).min(2) {
                    for i in 0..N {
                        let sum = &mut lanes[starts[i] * n + c + half];
                        for v in 0..VECTORS {
                            *sum = simd.mul_add_f32s(gradients[i][v], weights[half][v], *sum);
                        }
                    }
                }
            }
        }
    }
}
