//! Weights in the further forms that some ways of computing take, made when first needed.

use rayon::prelude::*;

use super::aligned::Aligned;
use super::panels::{Panels, halve};
use super::parameters;
use super::plan::{Layer, Plan};
use super::winograd::transform_weights;

/// Weights in other forms.
#[derive(Debug, Default)]
pub(super) struct Prepared {
    /// For the way back.
    transposed: Option<Aligned>,
    /// Winograd's.
    forward: Option<Aligned>,
    /// Winograd's for the way back.
    backward: Option<Aligned>,
    /// In half the bytes, forward and back.
    halves: [Option<Aligned<u32>>; 2],
}

impl Prepared {
    /// Makes what is missing for a pass with a way `back` or without, by Winograd or not.
    pub(super) fn need(&mut self, plan: &Plan, parameters: &[f32], back: bool, winograd: bool) {
        if back && self.transposed.is_none() {
            let mut transposed = Aligned::zeros(plan.n_transposed);
            parameters::transpose(plan, parameters, &mut transposed);
            self.transposed = Some(transposed);
        }
        if winograd && self.forward.is_none() {
            let mut forward = Aligned::zeros(plan.n_winograd);
            fill_forward(plan, parameters, &mut forward);
            self.forward = Some(forward);
        }
        if back && winograd && self.backward.is_none() {
            let mut backward = Aligned::zeros(plan.n_winograd);
            let transposed = self.transposed.as_deref().unwrap_or_default();
            fill_backward(plan, transposed, &mut backward);
            self.backward = Some(backward);
        }
    }

    /// Makes what there is anew, of other weights.
    pub(super) fn refresh(&mut self, plan: &Plan, parameters: &[f32]) {
        if let Some(transposed) = &mut self.transposed {
            parameters::transpose(plan, parameters, transposed);
        }
        if let Some(forward) = &mut self.forward {
            fill_forward(plan, parameters, forward);
        }
        if let (Some(backward), Some(transposed)) = (&mut self.backward, &self.transposed) {
            fill_backward(plan, transposed, backward);
        }
        self.halves = [None, None];
    }

    /// Makes what is missing of the weights in half the bytes, after [`Prepared::need`].
    pub(super) fn need_halves(&mut self, plan: &Plan, parameters: &[f32], back: bool) {
        let [forward, backward] = &mut self.halves;
        if forward.is_none() {
            let mut words = Aligned::zeros(plan.n_halves[0]);
            for layer in &plan.layers {
                let weights = &parameters[layer.weights..][..layer.n_weights()];
                let words = &mut words[layer.halves[0]..][..layer.n_halves()[0]];
                halve(weights, layer.inputs, words);
            }
            *forward = Some(words);
        }
        if let (true, None, Some(transposed)) = (back, &backward, &self.transposed) {
            let mut words = Aligned::zeros(plan.n_halves[1]);
            for layer in &plan.layers {
                let weights = &transposed[layer.transposed..][..layer.n_transposed()];
                let words = &mut words[layer.halves[1]..][..layer.n_halves()[1]];
                halve(weights, layer.outputs, words);
            }
            *backward = Some(words);
        }
    }

    /// A layer's weights for the way back, as f32 or in half the bytes.
    pub(super) fn transposed(&self, layer: &Layer, halves: bool) -> Panels<'_> {
        match (&self.halves[1], &self.transposed) {
            (Some(words), _) if halves => {
                Panels::Halves(&words[layer.halves[1]..][..layer.n_halves()[1]])
            }
            (_, Some(whole)) => Panels::Whole(&whole[layer.transposed..][..layer.n_transposed()]),
            // It was not needed so far.
            (_, None) => Panels::Whole(&[]),
        }
    }

    /// A layer's weights, as f32 or in half the bytes.
    pub(super) fn weights<'a>(
        &'a self,
        layer: &Layer,
        parameters: &'a [f32],
        halves: bool,
    ) -> Panels<'a> {
        match &self.halves[0] {
            Some(words) if halves => {
                Panels::Halves(&words[layer.halves[0]..][..layer.n_halves()[0]])
            }
            _ => Panels::Whole(&parameters[layer.weights..][..layer.n_weights()]),
        }
    }

    pub(super) fn forward(&self) -> &[f32] {
        self.forward.as_deref().unwrap_or_default()
    }

    pub(super) fn backward(&self) -> &[f32] {
        self.backward.as_deref().unwrap_or_default()
    }
}

fn fill_forward(plan: &Plan, parameters: &[f32], transformed: &mut [f32]) {
    each_layer(plan, transformed, |index, piece| {
        let layer = &plan.layers[index];
        let weights = &parameters[layer.weights..][..layer.n_weights()];
        let sizes = (layer.kind.taps(), layer.inputs, layer.outputs);
        transform_weights(weights, sizes, false, piece);
    });
}

fn fill_backward(plan: &Plan, transposed: &[f32], transformed: &mut [f32]) {
    each_layer(plan, transformed, |index, piece| {
        let layer = &plan.layers[index];
        let weights = &transposed[layer.transposed..][..layer.n_transposed()];
        let sizes = (layer.kind.taps(), layer.outputs, layer.inputs);
        transform_weights(weights, sizes, true, piece);
    });
}

/// Calls `fill` with the number of every layer for Winograd and its piece.
fn each_layer(plan: &Plan, transformed: &mut [f32], fill: impl Fn(usize, &mut [f32]) + Sync) {
    let mut rest = transformed;
    let mut pieces = Vec::new();
    for (index, layer) in plan.layers.iter().enumerate() {
        if let Some(winograd) = &layer.winograd {
            let len = winograd.points * layer.inputs * layer.outputs;
            let (piece, after) = rest.split_at_mut(len);
            pieces.push((index, piece));
            rest = after;
        }
    }
    pieces
        .into_par_iter()
        .for_each(|(index, piece)| fill(index, piece));
}
