//! What can go wrong in a rollout.

use ksim_datasets::DatasetError;
use ksim_envs::EnvironmentError;

use crate::policy::PolicyError;

/// Why a rollout failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HarnessError {
    /// An environment failed.
    #[error("episode {episode}, step {step}")]
    Environment {
        /// Number of the episode, from 0.
        episode: usize,
        /// Step in it, from 0.
        step: usize,
        /// What failed.
        source: EnvironmentError,
    },
    /// The policy failed.
    #[error("episode {episode}, step {step}: policy `{policy}`")]
    Policy {
        /// The policy.
        policy: String,
        /// Number of the episode, from 0.
        episode: usize,
        /// Step in it, from 0.
        step: usize,
        /// What failed.
        source: PolicyError,
    },
    /// The record could not be written.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
}
