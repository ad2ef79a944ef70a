//! Planners that stay inside their training data: one trait, one registry, several algorithms.
//!
//! Module map: [`planner`] is what every planner is, [`family`] how one is trained and
//! loaded, [`registry`] which there are; [`nets`] describes the networks of the diffusion planners and
//! the small interface behind which a backend computes them, [`native`] is one by our own kernels.

pub mod error;
pub mod family;
#[cfg(feature = "native")]
pub mod native;
pub mod nets;
pub mod planner;
pub mod registry;

pub use error::PlannerError;
pub use family::{
    LoadOptions, PlannerFamily, Precision, Preset, SilentObserver, TrainControl, TrainObserver,
    TrainProgress, TrainRequest, TrainSummary,
};
pub use planner::{Candidates, PlanRequest, Planner, PlannerSpec};
pub use registry::Registry;
