//! A network's parameters in one piece, and back to tensors by name.

use rayon::prelude::*;

use super::aligned::Aligned;
use super::plan::{Layer, Place, Plan, What};
use super::product::{PANEL, n_panels};
use crate::error::PlannerError;
use crate::nets::{Tensor, Weights};

/// For every number of a tensor, in its order, where it lies among the parameters.
fn positions(plan: &Plan, place: &Place, mut visit: impl FnMut(usize)) {
    match place.what {
        What::Run { start, len } => (start..start + len).for_each(visit),
        What::Weight { layer, column } => {
            let layer = &plan.layers[layer];
            let taps = layer.kind.taps();
            let doubling = layer.kind == super::geometry::Kind::Doubling;
            for first in 0..place.shape[0] {
                for second in 0..place.shape[1] {
                    let (input, output) = if doubling {
                        (first, second)
                    } else {
                        (second, first)
                    };
                    for tap in 0..taps {
                        visit(layer.weight(tap, input, column + output));
                    }
                }
            }
        }
    }
}

/// All parameters; zeros fill up the panels.
///
/// # Errors
/// A tensor is missing or has another shape.
pub(super) fn gather(plan: &Plan, weights: &Weights) -> Result<Aligned, PlannerError> {
    let mut parameters = Aligned::zeros(plan.n_parameters);
    for place in &plan.places {
        let mut values = weights.tensor(&place.name, &place.shape)?.iter();
        positions(plan, place, |at| {
            if let Some(value) = values.next() {
                parameters[at] = *value;
            }
        });
    }
    Ok(parameters)
}

/// The tensors of parameters, or of anything laid out as they are.
pub(super) fn scatter(plan: &Plan, parameters: &[f32]) -> Weights {
    let mut weights = Weights::default();
    for place in &plan.places {
        let mut values = Vec::with_capacity(place.shape.iter().product());
        positions(plan, place, |at| values.push(parameters[at]));
        let shape = place.shape.clone();
        let tensor = Tensor { shape, values };
        weights.tensors.insert(place.name.clone(), tensor);
    }
    weights
}

/// Writes the weights for the way back.
pub(super) fn transpose(plan: &Plan, parameters: &[f32], transposed: &mut [f32]) {
    let mut rest = transposed;
    let mut pieces = Vec::with_capacity(plan.layers.len());
    for layer in &plan.layers {
        let (piece, after) = rest.split_at_mut(layer.n_transposed());
        pieces.push((layer, piece));
        rest = after;
    }
    pieces.into_par_iter().for_each(|(layer, piece)| {
        transpose_layer(layer, parameters, piece);
    });
}

fn transpose_layer(layer: &Layer, parameters: &[f32], out: &mut [f32]) {
    let taps = layer.kind.taps();
    let depth = taps * layer.outputs * PANEL;
    for panel in 0..n_panels(layer.inputs) {
        let first = panel * PANEL;
        let width = PANEL.min(layer.inputs - first);
        let out = &mut out[panel * depth..][..depth];
        for tap in 0..taps {
            for block in (0..layer.outputs).step_by(PANEL) {
                let n = PANEL.min(layer.outputs - block);
                let rows = &parameters[layer.weight(tap, first, block)..][..width * PANEL];
                let out = &mut out[(tap * layer.outputs + block) * PANEL..][..n * PANEL];
                transpose_square(rows, out);
            }
        }
    }
}

/// out\[o\]\[i\] = rows\[i\]\[o\], rows of [`PANEL`] numbers.
fn transpose_square(rows: &[f32], out: &mut [f32]) {
    let (rows, _) = rows.as_chunks::<PANEL>();
    let (out, _) = out.as_chunks_mut::<PANEL>();
    for (o, out) in out.iter_mut().enumerate() {
        for (out, row) in out.iter_mut().zip(rows) {
            *out = row[o];
        }
    }
}
