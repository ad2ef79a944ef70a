//! What can go wrong with a benchmark.

use std::path::PathBuf;

use ksim_datasets::DatasetError;
use ksim_envs::EnvironmentError;
use ksim_envs::vector::VectorError;

use crate::error::HarnessError;
use crate::k_sim::KSimError;
use crate::planner_source::SourceError;
use crate::policy::PolicyError;
use crate::run_dir::RunDirError;

/// Why a benchmark cannot be played.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SuiteError {
    /// The file cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is no suite.
    #[error("{}", path.display())]
    Toml {
        /// The file.
        path: PathBuf,
        /// What is wrong, and where.
        source: toml::de::Error,
    },
    /// An entry that makes no sense.
    #[error("suite: {place}: expected {expected}, found {found}")]
    Entry {
        /// Where, such as `planner "Diffuser"`.
        place: String,
        /// What would have been accepted.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A cell failed.
    #[error("{cell}")]
    Cell {
        /// Planner, environment and run.
        cell: String,
        /// What failed.
        source: Box<SuiteError>,
    },
    /// The dataset cannot be found or read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The environment cannot be made.
    #[error(transparent)]
    Environment(#[from] EnvironmentError),
    /// The environments cannot be stepped together.
    #[error(transparent)]
    Vector(#[from] VectorError),
    /// The planner cannot be opened.
    #[error(transparent)]
    Source(Box<SourceError>),
    /// The policy cannot be made.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// The rollout failed.
    #[error(transparent)]
    Harness(Box<HarnessError>),
    /// K-Sim cannot be computed.
    #[error(transparent)]
    KSim(#[from] KSimError),
    /// The folder of results cannot be used.
    #[error(transparent)]
    RunDir(#[from] RunDirError),
}

impl From<SourceError> for SuiteError {
    fn from(error: SourceError) -> Self {
        Self::Source(Box::new(error))
    }
}

impl From<HarnessError> for SuiteError {
    fn from(error: HarnessError) -> Self {
        Self::Harness(Box::new(error))
    }
}
