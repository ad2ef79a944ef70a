//! Networks by our own kernels: inference, gradients by the input, and training, in f32 on the CPU.
//!
//! Samples go through a network in chunks, which are what threads share out. In a chunk activations lie as
//! `[position][sample][channel]`: see module `product`. Every number is summed in an order that depends neither on the
//! samples beside it nor on the number of threads, and gradients by weights are added chunk by chunk. Only whether a
//! call has fewer than four windows makes a difference, in the last digits: see module `winograd`.

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
mod parameters;
mod plan;
mod prefetch;
mod prepared;
mod product;
mod shared;
mod training;
mod unet;
mod winograd;

use crate::error::PlannerError;
use crate::nets::{Architecture, Backend, Network, TrainableNetwork, TrainingState, Weights};

/// The backend of this module.
#[derive(Debug, Clone, Copy, Default)]
pub struct NativeBackend;

impl NativeBackend {
    /// The backend.
    pub fn new() -> Self {
        Self
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
        Ok(Box::new(network::NativeNetwork::new(
            architecture,
            weights,
        )?))
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
