//! A network under training.

use rayon::prelude::*;

use super::adam::{self, Updated};
use super::aligned::Aligned;
use super::chunk::Keep;
use super::network::NativeNetwork;
use super::outer::{Copies, Outer};
use super::parameters::{gather, scatter};
use super::plan::Layer;
use super::product::{PANEL, n_panels};
use crate::error::PlannerError;
use crate::nets::{Adam, Architecture, Network, TrainableNetwork, TrainingState};

/// Panels of a layer's gradient that a thread takes at a time.
const PANELS: usize = 4;

/// A network under training by our own kernels.
#[derive(Debug)]
pub(super) struct NativeTraining {
    network: NativeNetwork,
    ema: Aligned,
    first_moment: Aligned,
    second_moment: Aligned,
    gradient: Aligned,
    has_gradient: bool,
    n_updates: u64,
}

impl NativeTraining {
    pub(super) fn new(
        architecture: &Architecture,
        state: &TrainingState,
    ) -> Result<Self, PlannerError> {
        for weights in [&state.ema, &state.first_moment, &state.second_moment] {
            architecture.check_weights(weights)?;
        }
        let network = NativeNetwork::new(architecture, &state.weights, false)?;
        Ok(Self {
            ema: gather(&network.plan, &state.ema)?,
            first_moment: gather(&network.plan, &state.first_moment)?,
            second_moment: gather(&network.plan, &state.second_moment)?,
            gradient: Aligned::zeros(network.plan.n_parameters),
            has_gradient: false,
            n_updates: state.n_updates,
            network,
        })
    }

    /// Gradients by the weights of all layers, of what the chunks kept.
    fn layer_gradients(&mut self, n_chunks: usize) {
        let plan = &self.network.plan;
        let chunks = &self.network.chunks[..n_chunks];
        let layers = &mut self.gradient[..plan.norms_start];
        layers.fill(0.0);
        let tasks = tasks(&plan.layers, layers);
        tasks
            .into_par_iter()
            .for_each_init(Copies::default, |copies, (index, mut outer)| {
                for chunk in chunks {
                    let (input, gradient) = (chunk.inputs[index], chunk.gradients[index]);
                    if let (Some(input), Some(gradient)) = (input, gradient) {
                        outer.add(
                            copies,
                            chunk.samples,
                            chunk.read(input),
                            chunk.read(gradient),
                        );
                    }
                }
            });
    }

    /// Gradients by the parameters of all norms: sums over the chunks.
    fn norm_gradients(&mut self, n_chunks: usize) {
        let sums = &mut self.gradient[self.network.plan.norms_start..];
        sums.fill(0.0);
        for chunk in &self.network.chunks[..n_chunks] {
            let pairs = sums.iter_mut().zip(&chunk.norm_gradients);
            pairs.for_each(|(sum, gradient)| *sum += gradient);
        }
    }
}

/// The gradient of every layer in parts.
fn tasks<'a>(layers: &'a [Layer], mut gradient: &'a mut [f32]) -> Vec<(usize, Outer<'a>)> {
    let mut tasks = Vec::new();
    for (index, layer) in layers.iter().enumerate() {
        let (mut weights, rest) = gradient.split_at_mut(layer.n_weights());
        let panels = n_panels(layer.outputs);
        let (mut bias, rest) = rest.split_at_mut(panels * PANEL);
        gradient = rest;
        let depth = layer.kind.taps() * layer.inputs * PANEL;
        for first in (0..panels).step_by(PANELS) {
            let end = panels.min(first + PANELS);
            let (own, rest) = weights.split_at_mut((end - first) * depth);
            weights = rest;
            let (own_bias, rest) = bias.split_at_mut((end - first) * PANEL);
            bias = rest;
            let outer = Outer {
                layer,
                panels: first..end,
                weights: own,
                bias: own_bias,
            };
            tasks.push((index, outer));
        }
    }
    tasks
}

impl Network for NativeTraining {
    fn architecture(&self) -> &Architecture {
        self.network.architecture()
    }

    fn on_rayon(&self) -> bool {
        true
    }

    fn forward(
        &mut self,
        x: &[f32],
        t: &[f32],
        keep: bool,
        out: &mut [f32],
    ) -> Result<(), PlannerError> {
        let keep = if keep { Keep::All } else { Keep::Nothing };
        self.network.run(x, t, keep, out)
    }

    fn input_gradient(
        &mut self,
        cotangent: &[f32],
        gradient: &mut [f32],
    ) -> Result<(), PlannerError> {
        self.network.input_gradient(cotangent, gradient)
    }
}

impl TrainableNetwork for NativeTraining {
    fn backward(&mut self, cotangent: &[f32]) -> Result<f64, PlannerError> {
        let enough = |keep| keep == Keep::All;
        let kept = self
            .network
            .take_kept("a gradient by the weights", enough, cotangent)?;
        self.network.back(kept, cotangent, None);
        let n_chunks = kept.samples.div_ceil(kept.chunk);
        self.layer_gradients(n_chunks);
        self.norm_gradients(n_chunks);
        self.has_gradient = true;
        Ok(adam::norm(&self.gradient))
    }

    fn update(&mut self, adam: &Adam, learning_rate: f64) -> Result<(), PlannerError> {
        if !self.has_gradient {
            return Err(PlannerError::Order {
                asked: "an update",
                missing: "gradient by the weights",
            });
        }
        self.has_gradient = false;
        self.n_updates += 1;
        let updated = Updated {
            parameters: &mut self.network.parameters,
            ema: &mut self.ema,
            first_moment: &mut self.first_moment,
            second_moment: &mut self.second_moment,
        };
        adam::update(updated, &self.gradient, adam, learning_rate, self.n_updates);
        self.network.refresh();
        Ok(())
    }

    fn state(&self) -> Result<TrainingState, PlannerError> {
        let plan = &self.network.plan;
        Ok(TrainingState {
            weights: scatter(plan, &self.network.parameters),
            ema: scatter(plan, &self.ema),
            first_moment: scatter(plan, &self.first_moment),
            second_moment: scatter(plan, &self.second_moment),
            n_updates: self.n_updates,
        })
    }
}
