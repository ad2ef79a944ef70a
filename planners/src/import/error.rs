//! What can be wrong with a checkpoint file.

use std::path::{Path, PathBuf};

use crate::error::PlannerError;

/// A checkpoint cannot be imported.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// The file cannot be opened or read.
    #[error("{}: cannot {doing} it", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        doing: &'static str,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The file is not a whole zip archive as PyTorch writes it.
    #[error("{}: {problem}", path.display())]
    Archive {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// The pickle in it does something else than list tensors.
    #[error("{}: data.pkl, byte {offset}: {problem}", path.display())]
    Pickle {
        /// The file.
        path: PathBuf,
        /// Byte of the instruction, from the start of `data.pkl`.
        offset: usize,
        /// What is wrong.
        problem: String,
    },
    /// A tensor in it does not fit the numbers that are stored for it.
    #[error("{}: tensor \"{name}\": {problem}", path.display())]
    Tensor {
        /// The file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// What is wrong.
        problem: String,
    },
    /// Its tensors are not those of a network that the reference implementation trains.
    #[error("{}: {problem}", path.display())]
    Network {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// None of the files is of a network that the others need.
    #[error("none of the files holds the network \"{network}\", which the others need")]
    Missing {
        /// Its name in [`crate::model::network`].
        network: &'static str,
    },
    /// Its tensors do not fit the network that their shapes tell of.
    #[error("{}: not a whole network \"{network}\"", path.display())]
    Weights {
        /// The file.
        path: PathBuf,
        /// Its name in [`crate::model::network`].
        network: &'static str,
        /// What does not fit.
        source: Box<PlannerError>,
    },
}

impl ImportError {
    pub(super) fn io(path: &Path, doing: &'static str, source: std::io::Error) -> Self {
        Self::Io {
            path: path.to_owned(),
            doing,
            source,
        }
    }

    pub(super) fn archive(path: &Path, problem: impl Into<String>) -> Self {
        Self::Archive {
            path: path.to_owned(),
            problem: problem.into(),
        }
    }

    pub(super) fn tensor(path: &Path, name: &str, problem: impl Into<String>) -> Self {
        Self::Tensor {
            path: path.to_owned(),
            name: name.to_owned(),
            problem: problem.into(),
        }
    }

    pub(super) fn network(path: &Path, problem: impl Into<String>) -> Self {
        Self::Network {
            path: path.to_owned(),
            problem: problem.into(),
        }
    }
}
