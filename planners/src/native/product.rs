//! The product at the heart of every layer: windows at one position times the weights of a tap, summed over taps.
//!
//! Activations lie as `[position][sample][channel]`, so that a convolution reads whole rows and needs no copy of its
//! input: output row (l, n) is Σ over taps of input row (l + offset, n) times the weights of the tap. Weights lie in
//! panels of [`PANEL`] outputs, `[panel][tap][input][PANEL]`, the last panel filled up with zeros.
//!
//! Every output is summed in one fixed order (its starting value, then taps and inputs as the pass lists them, one
//! fused multiply-add each), so that it depends neither on the rows beside it nor on the number of threads.

use ksim::prefetch;
use pulp::{Arch, Simd, WithSimd};

use super::geometry::Pass;
use super::panels::{Panels, widen};

/// Outputs in a panel of weights.
pub(super) const PANEL: usize = 16;

/// Rows that are computed together at most: with two vectors each, six fill the registers of AVX2.
const ROWS: usize = 6;

/// So many inputs before their turn weights are asked for: the processor's own guess ends with every page.
const AHEAD: usize = 24;

/// Panels for `outputs`.
pub(super) fn n_panels(outputs: usize) -> usize {
    outputs.div_ceil(PANEL)
}

/// What the outputs start from.
#[derive(Clone, Copy)]
pub(super) enum Start<'a> {
    /// Zero.
    Zero,
    /// A bias of `n_panels·PANEL` numbers.
    Bias(&'a [f32]),
    /// What the output holds.
    Output,
}

/// A layer applied to some samples.
pub(super) struct Product<'a> {
    /// `[length][samples][inputs]`.
    pub(super) input: &'a [f32],
    /// Positions of the input.
    pub(super) length: usize,
    pub(super) samples: usize,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    /// `[panel][taps][inputs][PANEL]`.
    pub(super) weights: Panels<'a>,
    /// Taps of the weights.
    pub(super) taps: usize,
    pub(super) passes: &'a [Pass],
    pub(super) start: Start<'a>,
    /// At least `inputs` zeros: the row that taps outside of the input read.
    pub(super) zeros: &'a [f32],
}

impl Product<'_> {
    /// Writes all of `output`, `[positions][samples][outputs]`.
    pub(super) fn write(&self, output: &mut [f32]) {
        Arch::new().dispatch(Run {
            product: self,
            output,
        });
    }
}

/// Winograd's products: rows of a point, one after the other, times the point's weights. The same bits as a [`Product`]
/// of one tap, which looks every row up; with so few inputs a row that is felt.
pub(super) struct Dense<'a> {
    /// `[point][row][inputs]`.
    pub(super) input: &'a [f32],
    pub(super) points: usize,
    pub(super) inputs: usize,
    /// A multiple of [`PANEL`].
    pub(super) outputs: usize,
    /// `[point][panel][inputs][PANEL]`.
    pub(super) weights: &'a [f32],
    /// `[point][row][outputs]`, written.
    pub(super) output: &'a mut [f32],
}

impl Dense<'_> {
    pub(super) fn run(self) {
        Arch::new().dispatch(self);
    }

    #[inline(always)]
    fn points<S: Simd, const VECTORS: usize>(self, simd: S) {
        let (inputs, outputs) = (self.inputs, self.outputs);
        let n_rows = self.input.len() / self.points / inputs;
        let n_tiles = n_rows.div_ceil(ROWS);
        let of_point = self.input.chunks_exact(n_rows * inputs);
        let of_point = of_point.zip(self.weights.chunks_exact(inputs * outputs));
        let to_point = self.output.chunks_exact_mut(n_rows * outputs);
        for ((input, weights), output) in of_point.zip(to_point) {
            for (panel, weights) in weights.chunks_exact(inputs * PANEL).enumerate() {
                for tile in 0..n_tiles {
                    let (first, end) = (tile * n_rows / n_tiles, (tile + 1) * n_rows / n_tiles);
                    let rows = &input[first * inputs..end * inputs];
                    let to = &mut output[first * outputs..end * outputs];
                    let column = panel * PANEL;
                    match end - first {
                        1 => dense::<S, 1, VECTORS>(simd, rows, weights, to, column),
                        2 => dense::<S, 2, VECTORS>(simd, rows, weights, to, column),
                        3 => dense::<S, 3, VECTORS>(simd, rows, weights, to, column),
                        4 => dense::<S, 4, VECTORS>(simd, rows, weights, to, column),
                        5 => dense::<S, 5, VECTORS>(simd, rows, weights, to, column),
                        _ => dense::<S, ROWS, VECTORS>(simd, rows, weights, to, column),
                    }
                }
            }
        }
    }
}

impl WithSimd for Dense<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match PANEL / S::F32_LANES {
            1 => self.points::<S, 1>(simd),
            2 => self.points::<S, 2>(simd),
            4 => self.points::<S, 4>(simd),
            _ => self.points::<S, PANEL>(simd),
        }
    }
}

/// N dense rows times a panel, into the columns from `column` on.
#[inline(always)]
fn dense<S: Simd, const N: usize, const VECTORS: usize>(
    simd: S,
    input: &[f32],
    weights: &[f32],
    output: &mut [f32],
    column: usize,
) {
    let (inputs, outputs) = (input.len() / N, output.len() / N);
    let mut rows = [input; N];
    for i in 0..N {
        rows[i] = &input[i * inputs..][..inputs];
    }
    let mut sums = [[simd.splat_f32s(0.0); VECTORS]; N];
    accumulate::<S, N, VECTORS>(simd, &rows, weights, &mut sums);
    for i in 0..N {
        let (row, _) = S::as_mut_simd_f32s(&mut output[i * outputs + column..][..PANEL]);
        row.copy_from_slice(&sums[i]);
    }
}

struct Run<'a> {
    product: &'a Product<'a>,
    output: &'a mut [f32],
}

impl WithSimd for Run<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // The vectors of a panel: what the compiler keeps in registers.
        match PANEL / S::F32_LANES {
            1 => run::<S, 1>(simd, self),
            2 => run::<S, 2>(simd, self),
            4 => run::<S, 4>(simd, self),
            _ => run::<S, PANEL>(simd, self),
        }
    }
}

#[inline(always)]
fn run<S: Simd, const VECTORS: usize>(simd: S, run: Run<'_>) {
    let Run { product, output } = run;
    let mut rows = Vec::new();
    for pass in product.passes {
        product.rows(pass, &mut rows);
        let stride = pass.taps.len() + 1;
        let n_rows = pass.count * product.samples;
        let n_tiles = n_rows.div_ceil(ROWS);
        for panel in 0..n_panels(product.outputs) {
            for tile in 0..n_tiles {
                // Tiles as even as can be: no row is left over to run through the weights alone.
                let (first, end) = (tile * n_rows / n_tiles, (tile + 1) * n_rows / n_tiles);
                let tile = Tile {
                    product,
                    pass,
                    panel,
                    rows: &rows[first * stride..end * stride],
                };
                match end - first {
                    1 => tile.run::<S, 1, VECTORS>(simd, output),
                    2 => tile.run::<S, 2, VECTORS>(simd, output),
                    3 => tile.run::<S, 3, VECTORS>(simd, output),
                    4 => tile.run::<S, 4, VECTORS>(simd, output),
                    5 => tile.run::<S, 5, VECTORS>(simd, output),
                    _ => tile.run::<S, ROWS, VECTORS>(simd, output),
                }
            }
        }
    }
}

/// Where no input row is read.
const NOWHERE: usize = usize::MAX;

impl Product<'_> {
    /// For every row of a pass where its output starts and, tap by tap, where the input row starts.
    fn rows(&self, pass: &Pass, rows: &mut Vec<usize>) {
        rows.clear();
        for m in 0..pass.count {
            let output = (pass.start + m * pass.step) * self.samples;
            let first = rows.len();
            rows.push(output * self.outputs);
            for tap in &pass.taps {
                let position = pass.reads(m, *tap, self.length);
                rows.push(position.map_or(NOWHERE, |p| p * self.samples * self.inputs));
            }
            for n in 1..self.samples {
                for at in first..first + pass.taps.len() + 1 {
                    let step = if at == first {
                        self.outputs
                    } else {
                        self.inputs
                    };
                    let start = rows[at];
                    rows.push(if start == NOWHERE {
                        start
                    } else {
                        start + n * step
                    });
                }
            }
        }
    }
}

/// Some rows of a pass times a panel.
struct Tile<'a> {
    product: &'a Product<'a>,
    pass: &'a Pass,
    panel: usize,
    /// As [`Product::rows`] has them.
    rows: &'a [usize],
}

// Loops, not closures over arrays: those would not become part of the vectorized function.
#[expect(clippy::needless_range_loop, reason = "several arrays at a time")]
impl<'a> Tile<'a> {
    #[inline(always)]
    fn run<S: Simd, const N: usize, const VECTORS: usize>(&self, simd: S, output: &mut [f32]) {
        let product = self.product;
        let stride = self.pass.taps.len() + 1;
        let column = self.panel * PANEL;
        let mut sums = [[simd.splat_f32s(0.0); VECTORS]; N];
        let width = PANEL.min(product.outputs - column);
        let mut starts = [0; N];
        for i in 0..N {
            starts[i] = self.rows[i * stride] + column;
        }
        match product.start {
            Start::Zero => {}
            Start::Bias(bias) => {
                let (bias, _) = S::as_simd_f32s(&bias[column..][..PANEL]);
                for i in 0..N {
                    sums[i].copy_from_slice(bias);
                }
            }
            Start::Output => {
                for i in 0..N {
                    let mut row = [0.0; PANEL];
                    row[..width].copy_from_slice(&output[starts[i]..][..width]);
                    let (row, _) = S::as_simd_f32s(&row);
                    sums[i].copy_from_slice(row);
                }
            }
        }
        for (index, tap) in self.pass.taps.iter().enumerate() {
            if let Some(rows) = self.inputs(index) {
                let at = (self.panel, tap.weight);
                match product.weights.tap(at, product.taps, product.inputs) {
                    Panels::Whole(weights) => {
                        accumulate::<S, N, VECTORS>(simd, &rows, weights, &mut sums);
                    }
                    Panels::Halves(words) => {
                        accumulate_halves::<S, N, VECTORS>(simd, &rows, words, &mut sums);
                    }
                }
            }
        }
        for i in 0..N {
            if width == PANEL {
                let (row, _) = S::as_mut_simd_f32s(&mut output[starts[i]..][..PANEL]);
                row.copy_from_slice(&sums[i]);
            } else {
                let mut row = [0.0; PANEL];
                S::as_mut_simd_f32s(&mut row).0.copy_from_slice(&sums[i]);
                output[starts[i]..][..width].copy_from_slice(&row[..width]);
            }
        }
    }

    /// The rows that a tap reads; none if all of them lie outside of the input.
    #[inline(always)]
    fn inputs<const N: usize>(&self, tap: usize) -> Option<[&'a [f32]; N]> {
        let product = self.product;
        let stride = self.pass.taps.len() + 1;
        let mut any = false;
        let mut rows = [&product.zeros[..product.inputs]; N];
        for i in 0..N {
            let start = self.rows[i * stride + 1 + tap];
            if start != NOWHERE {
                any = true;
                rows[i] = &product.input[start..][..product.inputs];
            }
        }
        if any { Some(rows) } else { None }
    }
}

/// sums\[i\] += Σ over inputs c of rows\[i\]\[c\]·weights\[c\].
#[expect(clippy::needless_range_loop, reason = "several arrays at a time")]
#[inline(always)]
fn accumulate<S: Simd, const N: usize, const VECTORS: usize>(
    simd: S,
    rows: &[&[f32]; N],
    weights: &[f32],
    sums: &mut [[S::f32s; VECTORS]; N],
) {
    let depth = weights.len() / PANEL;
    let (weights, _) = S::as_simd_f32s(weights);
    let (weights, _) = weights.as_chunks::<VECTORS>();
    let weights = &weights[..depth];
    let mut rows = *rows;
    for i in 0..N {
        rows[i] = &rows[i][..depth];
    }
    let mut local = *sums;
    for c in 0..depth {
        prefetch(weights, c + AHEAD);
        let weight = weights[c];
        for i in 0..N {
            let value = simd.splat_f32s(rows[i][c]);
            for v in 0..VECTORS {
                local[i][v] = simd.mul_add_f32s(value, weight[v], local[i][v]);
            }
        }
    }
    *sums = local;
}

/// As [`accumulate`], in the same order.
#[inline(always)]
fn accumulate_halves<S: Simd, const N: usize, const VECTORS: usize>(
    simd: S,
    rows: &[&[f32]; N],
    words: &[u32],
    sums: &mut [[S::f32s; VECTORS]; N],
) {
    let (words, _) = S::as_simd_u32s(words);
    let (words, _) = words.as_chunks::<VECTORS>();
    let n_whole = rows[0].len() / 2;
    let mut pairs = [&[][..]; N];
    for i in 0..N {
        pairs[i] = &rows[i].as_chunks::<2>().0[..n_whole];
    }
    let mut local = *sums;
    for (p, words) in words[..n_whole].iter().enumerate() {
        prefetch(std::slice::from_ref(words), AHEAD);
        let weights = widen::<S, VECTORS>(simd, words);
        for half in 0..2 {
            for i in 0..N {
                let value = simd.splat_f32s(pairs[i][p][half]);
                for v in 0..VECTORS {
                    local[i][v] = simd.mul_add_f32s(value, weights[half][v], local[i][v]);
                }
            }
        }
    }
    if let Some(words) = words.get(n_whole) {
        let [weights, _] = widen::<S, VECTORS>(simd, words);
        for i in 0..N {
            let value = simd.splat_f32s(rows[i][2 * n_whole]);
            for v in 0..VECTORS {
                local[i][v] = simd.mul_add_f32s(value, weights[v], local[i][v]);
            }
        }
    }
    *sums = local;
}
