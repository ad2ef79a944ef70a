//! Networks by our own kernels: inference, gradients by the input, and training, in f32 on the CPU.
//!
//! Samples go through a network in chunks, which are what threads share out. In a chunk activations lie as
//! `[position][sample][channel]`: see module `product`. Every number is summed in an order that depends neither on the
//! samples beside it nor on the number of threads, and gradients by weights are added chunk by chunk. Only whether a
//! group of windows (a call, or see [`Network::in_groups_of`]) has fewer than four makes a difference, in the last
//! digits: see module `winograd`. Such a group may read its weights as bf16: see module `panels`.

mod adam;
mod aligned;
mod backward;
mod chunk;
mod forward;
mod geometry;
mod mish;
mod network;
mod norm;
mod outer;
mod panels;
mod parameters;
mod plan;
mod prepared;
mod product;
mod shared;
mod training;
mod unet;
mod winograd;

use crate::error::PlannerError;
use crate::family::Precision;
use crate::nets::{Architecture, Backend, Network, TrainableNetwork, TrainingState, Weights};

/// The backend of this module.
#[derive(Debug, Clone, Copy, Default)]
pub struct NativeBackend {
    precision: Precision,
}

impl NativeBackend {
    /// The backend, which computes in f32.
    pub fn new() -> Self {
        Self::default()
    }

    /// With [`Precision::Bf16`], groups of fewer than four windows are computed with weights that are rounded to
    /// bf16 and read in half the time; sums, larger groups and trainings stay f32.
    pub fn with_precision(precision: Precision) -> Self {
        Self { precision }
    }
}

impl Backend for NativeBackend {
    fn name(&self) -> &'static str {
        "native"
    }

    fn network(
        &self,
        architecture: &Architecture,
        weights: &Weights,
    ) -> Result<Box<dyn Network>, PlannerError> {
        let halves = self.precision == Precision::Bf16;
        let network = network::NativeNetwork::new(architecture, weights, halves)?;
        Ok(Box::new(network))
    }

    fn trainable(
        &self,
        architecture: &Architecture,
        state: TrainingState,
    ) -> Result<Box<dyn TrainableNetwork>, PlannerError> {
        Ok(Box::new(training::NativeTraining::new(
            architecture,
            &state,
        )?))
    }
}
