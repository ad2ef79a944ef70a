//! What can go wrong with the baselines.

use ksim::{DataError, SearchError};
use ksim_datasets::DatasetError;

/// Why a baseline could not be made of a dataset.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BaselineError {
    /// A dataset that cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A dataset without a step.
    #[error("the dataset \"{dataset}\" holds no step")]
    NoSteps {
        /// The dataset.
        dataset: String,
    },
    /// An episode in two parts.
    #[error("the dataset \"{dataset}\" has episode {episode} in two parts")]
    SplitEpisode {
        /// The dataset.
        dataset: String,
        /// Number of the episode.
        episode: i64,
    },
    /// A number that is not finite.
    #[error(
        "the dataset \"{dataset}\", episode {episode}, step {step}: {part} column {column} holds {value:?}, expected \
         a finite number"
    )]
    NotFinite {
        /// The dataset.
        dataset: String,
        /// Number of the episode.
        episode: i64,
        /// Number of the step.
        step: i64,
        /// `observation`, `action` or `reward`.
        part: &'static str,
        /// Column of the part, from 0.
        column: usize,
        /// The number.
        value: f64,
    },
    /// Rewards are needed and not recorded.
    #[error(
        "the dataset \"{dataset}\" records no rewards, and the best return cannot be chosen without"
    )]
    NoRewards {
        /// The dataset.
        dataset: String,
    },
    /// A setting out of its range.
    #[error("{name} is {found}, expected {expected}")]
    Setting {
        /// Which setting.
        name: &'static str,
        /// What is possible.
        expected: String,
        /// What was asked for.
        found: String,
    },
    /// The states cannot be indexed.
    #[error("index the states of the dataset")]
    Data(#[from] DataError),
    /// The search failed.
    #[error("search the states of the dataset")]
    Search(#[from] SearchError),
}
