//! What can go wrong with a saved index. The file's name is added by whoever opened it.

use std::io;

use ksim::{DataError, KMeansError, ScoreError};

/// A saved index that cannot be written, opened or used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IndexError {
    /// The system refused.
    #[error("cannot {action}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// Why it failed.
        source: io::Error,
    },
    /// Another kind of file.
    #[error("this is no index: it does not begin as `ksim index build` begins one")]
    NotAnIndex,
    /// An index of another version.
    #[error(
        "the index has version {found}, this ksim reads version {expected}: build it again with `ksim index build`"
    )]
    Version {
        /// Version of the file.
        found: u32,
        /// [`VERSION`](crate::VERSION).
        expected: u32,
    },
    /// The end is missing, or there is something behind it.
    #[error(
        "the index is incomplete: its {n_bytes} bytes do not end as an index ends; copy it or build it again"
    )]
    Truncated {
        /// Length of the file.
        n_bytes: u64,
    },
    /// Bytes that are not those that were written.
    #[error(
        "the index is damaged: {part}, from byte {offset} on, does not have the checksum or form it was written with; build it again with `ksim index build`"
    )]
    Damaged {
        /// The section, or part of the file.
        part: String,
        /// Where it begins.
        offset: u64,
    },
    /// A section that has to be there.
    #[error("the index has no section `{name}`")]
    NoSection {
        /// Its name.
        name: &'static str,
    },
    /// Values that do not go together.
    #[error("the index contradicts itself")]
    Data(#[from] DataError),
    /// Clusters that do not go with the rows, or cannot be fitted.
    #[error(transparent)]
    KMeans(#[from] KMeansError),
    /// A reference that cannot be used.
    #[error(transparent)]
    Score(#[from] ScoreError),
}

impl IndexError {
    /// For `map_err`: what was tried when the system refused.
    pub(crate) fn io(action: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { action, source }
    }
}
