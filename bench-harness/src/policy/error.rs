//! What can go wrong with a policy.

use std::path::PathBuf;
use std::sync::Arc;

use ksim_datasets::DatasetError;
use ksim_planners::PlannerError;
use safetensors::SafeTensorError;

/// Why a policy could not be made or asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PolicyError {
    /// A specification that names no policy.
    #[error(
        "unknown policy `{found}`, expected one of: {}",
        super::spec::known_kinds()
    )]
    UnknownKind {
        /// What was written.
        found: String,
    },
    /// A specification that lacks its file, or has one too many.
    #[error("policy `{found}`: expected {expected}")]
    Syntax {
        /// What was written.
        found: String,
        /// How this kind is written.
        expected: &'static str,
    },
    /// An option the policy does not take, or with a value it cannot use.
    #[error("policy `{kind}`: option `{option}`: expected {expected}")]
    Option {
        /// The kind of policy.
        kind: &'static str,
        /// The option as it was written.
        option: String,
        /// What would have been accepted.
        expected: String,
    },
    /// A file that cannot be read.
    #[error("read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A file that is not in safetensors format.
    #[error("{} is not a safetensors file", path.display())]
    Tensors {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: SafeTensorError,
    },
    /// A tensor or a value of the header that is missing or cannot be used.
    #[error("{}: {item}: expected {expected}, found {found}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// Which tensor or value.
        item: String,
        /// What would have been accepted.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A policy made for an environment with other observations or actions.
    #[error(
        "policy `{policy}` has {policy_dim} {what}, environment `{environment}` has {environment_dim}"
    )]
    Width {
        /// The policy.
        policy: String,
        /// `observations` or `actions`.
        what: &'static str,
        /// Numbers that the policy takes or gives.
        policy_dim: usize,
        /// The environment.
        environment: String,
        /// Numbers that the environment gives or takes.
        environment_dim: usize,
    },
    /// A policy for another kind of environment.
    #[error(
        "policy `{policy}` drives an ant through a maze, and environment `{environment}` is none"
    )]
    NoMaze {
        /// The policy.
        policy: String,
        /// The environment.
        environment: String,
    },
    /// A recording that cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A recording with fewer episodes than are to be played.
    #[error("the recording has {n_episodes} episodes, none with number {episode} (from 0)")]
    NoEpisode {
        /// The episode that was asked for.
        episode: usize,
        /// Episodes there are.
        n_episodes: usize,
    },
    /// An action with a number that is not finite.
    #[error("action {index} is {value}, expected a finite number")]
    NotFinite {
        /// Position in the action.
        index: usize,
        /// The number.
        value: f64,
    },
    /// A planner that could not plan; several slots may share the error.
    #[error(transparent)]
    Planner(Arc<PlannerError>),
}
