//! Planners that stay inside their training data: one trait, one registry, several algorithms.
//!
//! Module map: [`planner`] is what every planner is; [`nets`] describes the networks of the diffusion planners and
//! the small interface behind which a backend computes them.

pub mod error;
pub mod nets;
pub mod planner;

pub use error::PlannerError;
pub use planner::{Candidates, PlanRequest, Planner, PlannerSpec};
