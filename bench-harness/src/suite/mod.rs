//! Benchmarks of planners: planners × environments × runs, from a TOML file.
//!
//! A **cell** is one planner in one environment in one run of some episodes. Cells are played one after the other and
//! kept as they are done ([`crate::run_dir`]), so that a benchmark that was stopped goes on with the cells that are
//! missing. Run r resets with the seeds `seed + r·episodes`, `seed + r·episodes + 1`, …: no two runs share a start,
//! and all planners have the same.

mod config;
mod contents;
mod error;
mod play;

pub use config::{EnvironmentEntry, PlannerEntry, Suite};
pub use error::SuiteError;
pub use play::{CellName, Played, SuiteObserver, play};
