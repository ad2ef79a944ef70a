//! The `torch` backend: networks computed by libtorch, on a CPU or a CUDA device.
//!
//! It is what trainings run on, and what the `native` backend is compared with: the same names and shapes of weights,
//! and outputs that agree to 1e-5. No type of `tch` is in a public signature. Results do not depend on what else a
//! process computes, but with another number of threads libtorch may sum in another order.

mod layers;
mod model;
mod network;
mod optimizer;
mod session;
mod training;

use std::str::FromStr;

use crate::error::PlannerError;
use crate::nets::{Architecture, Backend, Network, TrainableNetwork, TrainingState, Weights};
use session::Session;

/// Where libtorch computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Device {
    /// The processor.
    #[default]
    Cpu,
    /// The CUDA device of this number.
    Cuda(usize),
}

impl FromStr for Device {
    type Err = PlannerError;

    /// Reads `cpu`, `cuda` or `cuda:1`.
    fn from_str(text: &str) -> Result<Self, PlannerError> {
        let number = match text {
            "cpu" => return Ok(Self::Cpu),
            "cuda" => Some(0),
            _ => text.strip_prefix("cuda:").and_then(|n| n.parse().ok()),
        };
        let unknown = || PlannerError::UnknownBackend {
            what: "device",
            name: text.to_owned(),
            known: vec!["cpu", "cuda", "cuda:N"],
        };
        number.map(Self::Cuda).ok_or_else(unknown)
    }
}

const NAME: &str = "torch";

/// Makes networks that libtorch computes.
#[derive(Debug, Clone, Copy)]
pub struct TorchBackend {
    session: Session,
}

impl TorchBackend {
    /// One that computes on `device`. On a CPU, operations use `n_threads` threads, at least one: a single candidate
    /// plans fastest with one, a batch of a training with all cores.
    ///
    /// # Errors
    /// There is no such device, or this libtorch cannot use it.
    pub fn new(device: Device, n_threads: usize) -> Result<Self, PlannerError> {
        let session = Session::new(device, n_threads)?;
        Ok(Self { session })
    }
}

impl Backend for TorchBackend {
    fn name(&self) -> &'static str {
        NAME
    }

    fn network(
        &self,
        architecture: &Architecture,
        weights: &Weights,
    ) -> Result<Box<dyn Network>, PlannerError> {
        let network = network::TorchNetwork::new(self.session, architecture, weights)?;
        Ok(Box::new(network))
    }

    fn trainable(
        &self,
        architecture: &Architecture,
        state: TrainingState,
    ) -> Result<Box<dyn TrainableNetwork>, PlannerError> {
        let network = training::TorchTrainable::new(self.session, architecture, state)?;
        Ok(Box::new(network))
    }
}
