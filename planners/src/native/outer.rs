//! The gradient by a layer's weights: sums of outer products of its inputs with the gradients by its outputs.
//!
//! Inputs are copied into strips of [`STRIP`] channels and gradients into panels, so that the innermost loop reads
//! both in one run. Chunks of samples are added in their order, and within a chunk rows in theirs; every number is
//! summed by one thread.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};

use super::geometry::Pass;
use super::plan::Layer;
use super::product::PANEL;

/// Inputs that are computed together.
const STRIP: usize = 6;

/// Rows of the input that go with as many rows of the output.
#[derive(Debug, Clone, Copy)]
struct Run {
    input: usize,
    output: usize,
    rows: usize,
}

/// Some panels of a layer's gradient.
pub(super) struct Outer<'a> {
    pub(super) layer: &'a Layer,
    pub(super) panels: Range<usize>,
    /// The weights' gradient in these panels.
    pub(super) weights: &'a mut [f32],
    /// The bias's.
    pub(super) bias: &'a mut [f32],
}

/// Copies of a chunk's numbers, in the order in which they are read.
#[derive(Default)]
pub(super) struct Copies {
    strips: Vec<f32>,
    panels: Vec<f32>,
}

impl Outer<'_> {
    /// Adds what a chunk of `samples` has: `input` is the layer's input, `gradient` the one by its output.
    pub(super) fn add(
        &mut self,
        copies: &mut Copies,
        samples: usize,
        input: &[f32],
        gradient: &[f32],
    ) {
        let layer = self.layer;
        let rows = copy_strips(input, layer.inputs, &mut copies.strips);
        let out_rows = gradient.len() / layer.outputs;
        copies
            .panels
            .resize(self.panels.len() * out_rows * PANEL, 0.0);
        let panels = copies.panels.chunks_exact_mut(out_rows * PANEL);
        for (panel, copy) in self.panels.clone().zip(panels) {
            copy_panel(gradient, layer.outputs, panel, copy);
        }
        let runs = (0..layer.kind.taps())
            .map(|tap| runs(layer, tap, samples))
            .collect::<Vec<_>>();
        Arch::new().dispatch(Add {
            outer: self,
            copies,
            rows,
            out_rows,
            runs: &runs,
        });
    }
}

/// `[strip][row][STRIP]`, the last strip filled up with zeros; returns the number of rows.
fn copy_strips(input: &[f32], inputs: usize, strips: &mut Vec<f32>) -> usize {
    let rows = input.len() / inputs;
    strips.resize(inputs.div_ceil(STRIP) * rows * STRIP, 0.0);
    for (strip, copy) in strips.chunks_exact_mut(rows * STRIP).enumerate() {
        let first = strip * STRIP;
        let width = STRIP.min(inputs - first);
        for (row, copy) in input
            .chunks_exact(inputs)
            .zip(copy.as_chunks_mut::<STRIP>().0)
        {
            match row[first..].first_chunk::<STRIP>() {
                Some(numbers) => *copy = *numbers,
                None => {
                    copy[..width].copy_from_slice(&row[first..]);
                    copy[width..].fill(0.0);
                }
            }
        }
    }
    rows
}

/// The columns of a panel, filled up with zeros.
fn copy_panel(gradient: &[f32], outputs: usize, panel: usize, copy: &mut [f32]) {
    let first = panel * PANEL;
    for (row, copy) in gradient
        .chunks_exact(outputs)
        .zip(copy.as_chunks_mut::<PANEL>().0)
    {
        match row[first..].first_chunk::<PANEL>() {
            Some(numbers) => *copy = *numbers,
            None => {
                let width = outputs - first;
                copy[..width].copy_from_slice(&row[first..]);
                copy[width..].fill(0.0);
            }
        }
    }
}

/// Which rows of the input go with which of the output by a tap; neighbors are joined.
fn runs(layer: &Layer, tap: usize, samples: usize) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    for pass in &layer.forward {
        for m in 0..pass.count {
            let Some(position) = reads(pass, m, tap, layer.length) else {
                continue;
            };
            let input = position * samples;
            let output = (pass.start + m * pass.step) * samples;
            match runs.last_mut() {
                Some(run) if run.input + run.rows == input && run.output + run.rows == output => {
                    run.rows += samples;
                }
                _ => runs.push(Run {
                    input,
                    output,
                    rows: samples,
                }),
            }
        }
    }
    runs
}

fn reads(pass: &Pass, m: usize, weight: usize, length: usize) -> Option<usize> {
    let tap = pass.taps.iter().find(|tap| tap.weight == weight)?;
    pass.reads(m, *tap, length)
}

struct Add<'a, 'b> {
    outer: &'a mut Outer<'b>,
    copies: &'a Copies,
    rows: usize,
    out_rows: usize,
    runs: &'a [Vec<Run>],
}

impl WithSimd for Add<'_, '_> {
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

impl Add<'_, '_> {
    #[inline(always)]
    fn run<S: Simd, const VECTORS: usize>(self, simd: S) {
        let layer = self.outer.layer;
        let depth = layer.kind.taps() * layer.inputs * PANEL;
        let panels = self.copies.panels.chunks_exact(self.out_rows * PANEL);
        let weights = self.outer.weights.chunks_exact_mut(depth);
        let biases = self.outer.bias.chunks_exact_mut(PANEL);
        for ((panel, weights), bias) in panels.zip(weights).zip(biases) {
            let panel = panel.as_chunks::<PANEL>().0;
            for row in panel {
                bias.iter_mut()
                    .zip(row)
                    .for_each(|(sum, value)| *sum += value);
            }
            let taps = weights.chunks_exact_mut(layer.inputs * PANEL);
            for (runs, weights) in self.runs.iter().zip(taps) {
                let strips = self.copies.strips.chunks_exact(self.rows * STRIP);
                for (strip, weights) in strips.zip(weights.chunks_mut(STRIP * PANEL)) {
                    let strip = strip.as_chunks::<STRIP>().0;
                    add_tile::<S, VECTORS>(simd, (strip, panel), runs, weights);
                }
            }
        }
    }
}

/// weights\[i\]\[o\] += Σ over rows of strip\[i\]·panel\[o\].
#[inline(always)]
fn add_tile<S: Simd, const VECTORS: usize>(
    simd: S,
    (strip, panel): (&[[f32; STRIP]], &[[f32; PANEL]]),
    runs: &[Run],
    weights: &mut [f32],
) {
    let mut sums = [[simd.splat_f32s(0.0); VECTORS]; STRIP];
    for run in runs {
        let strip = &strip[run.input..][..run.rows];
        let panel = &panel[run.output..][..run.rows];
        for (inputs, gradients) in strip.iter().zip(panel) {
            let (vectors, _) = S::as_simd_f32s(gradients);
            let mut local = [simd.splat_f32s(0.0); VECTORS];
            local.copy_from_slice(vectors);
            for i in 0..STRIP {
                let input = simd.splat_f32s(inputs[i]);
                for v in 0..VECTORS {
                    sums[i][v] = simd.mul_add_f32s(input, local[v], sums[i][v]);
                }
            }
        }
    }
    let (weights, _) = S::as_mut_simd_f32s(weights);
    for (weights, sums) in weights.chunks_exact_mut(VECTORS).zip(&sums) {
        for (weight, sum) in weights.iter_mut().zip(sums) {
            *weight = simd.add_f32s(*weight, *sum);
        }
    }
}
