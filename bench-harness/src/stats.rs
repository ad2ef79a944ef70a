//! Statistics of rollouts: pure functions of numbers and seeds.
//!
//! What is random is resampled with ChaCha8 from a given seed; the same input gives the same output on any number of
//! threads. Episodes are taken as independent; steps never are.

mod bootstrap;
mod iqm;
mod paired;
mod wilson;

use serde::Serialize;

pub use bootstrap::{BootstrapOptions, bootstrap_mean, bootstrap_pooled};
pub use iqm::{interquartile_mean, stratified_iqm};
pub use paired::{McNemar, UnequalLengths, mcnemar, paired_difference};
pub use wilson::wilson;

/// A number with its uncertainty.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// The number.
    pub value: f64,
    /// `[low, high]`; `None` where there is too little to tell.
    pub interval: Option<[f64; 2]>,
}
