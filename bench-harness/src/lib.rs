//! Closed-loop rollouts: policies, the one rollout loop, its records and their statistics; and benches.
//!
//! Module map: [`policy`] chooses actions; [`rollout`] is the only loop that steps environments; [`record`] is what
//! it leaves, per episode and per step; [`recording`] writes it as a dataset; [`stats`] are pure functions over
//! records; [`figure`] draws. [`search_bench`] measures the engines of `ksim` against each other.

mod error;
pub mod figure;
pub mod policy;
pub mod record;
pub mod recording;
mod rng;
pub mod rollout;
pub mod search_bench;
pub mod stats;

pub use error::HarnessError;
