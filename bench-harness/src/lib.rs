//! Closed-loop rollouts: policies, the one rollout loop, its records and their statistics; and benches.
//!
//! Module map: [`policy`] chooses actions; [`rollout`] is the only loop that steps environments; [`record`] is what
//! it leaves, per episode and per step; [`recording`] writes it as a dataset; [`stats`] are pure functions over
//! records; [`k_sim`] scores it against the data; [`planner_source`] finds planners. [`suite`] plays benchmarks of
//! them, kept in a [`run_dir`], and
//! [`report`] says what came of it; [`search_bench`] measures the engines of
//! `ksim` against each other; [`figure`] draws, and [`page`] is the page of `ksim report`.

mod error;
pub mod figure;
pub mod k_sim;
pub mod page;
pub mod planner_source;
pub mod policy;
pub mod record;
pub mod recording;
pub mod report;
mod rng;
pub mod rollout;
pub mod run_dir;
pub mod search_bench;
pub mod stats;
pub mod suite;

pub use error::HarnessError;
