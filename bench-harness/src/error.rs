//! What can go wrong in a rollout.

use ksim_datasets::DatasetError;
use ksim_envs::EnvironmentError;
use ksim_envs::vector::VectorError;

use crate::k_sim::KSimError;
use crate::policy::PolicyError;

/// Why a rollout failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HarnessError {
    /// A setting that makes no sense.
    #[error("rollout: {name}: expected {expected}, found {found}")]
    Config {
        /// The setting.
        name: &'static str,
        /// What would have been accepted.
        expected: &'static str,
        /// What was given.
        found: String,
    },
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
    /// The environments could not be stepped together.
    #[error(transparent)]
    Vector(#[from] VectorError),
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
        source: Box<PolicyError>,
    },
    /// The record could not be written.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// K-Sim could not be computed.
    #[error(transparent)]
    KSim(Box<KSimError>),
}

impl From<KSimError> for HarnessError {
    fn from(error: KSimError) -> Self {
        Self::KSim(Box::new(error))
    }
}
