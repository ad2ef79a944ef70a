//! Planners that stay inside their training data: one trait, one registry, several algorithms.
//!
//! Module map: [`planner`] is what every planner is, [`family`] how one is trained and loaded, [`registry`] which there
//! are. [`baselines`] need no network, [`process`] asks planners in processes of their own. [`algorithms`] holds the
//! diffusion planners, a file each; they share [`config`] and its presets, [`data`] for training windows,
//! [`diffusion`] with schedule, sampler and losses, [`training`] with checkpoints and run folders, and [`model`], the
//! file of a trained planner. [`nets`] describes their networks and the small interface behind which a backend
//! computes them; [`native`] is one, by our own kernels, `torch` another, by libtorch. [`import`] reads networks that
//! the reference implementation trained.

pub mod algorithms;
pub mod backend;
pub mod baselines;
pub mod config;
#[cfg(any(test, feature = "test-util"))]
pub mod conformance;
pub mod data;
pub mod diffusion;
pub mod error;
pub mod family;
pub mod import;
pub mod model;
#[cfg(feature = "native")]
pub mod native;
pub mod nets;
pub mod planner;
mod presets;
pub mod process;
pub mod registry;
mod rng;
mod run_folder;
mod tensor_file;
#[cfg(feature = "torch")]
pub mod torch;
pub mod training;

pub use error::PlannerError;
pub use family::{
    LoadOptions, PlannerFamily, Precision, Preset, SilentObserver, TrainControl, TrainObserver,
    TrainProgress, TrainRequest, TrainSummary,
};
pub use planner::{Candidates, PlanRequest, Planner, PlannerSpec};
pub use registry::{Registry, RunInfo, family_of, run_info, write_manifest};
