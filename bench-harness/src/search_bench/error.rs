//! Why engines could not be measured.

use ksim::{DataError, ScoreError, SearchError};

/// Why engines could not be measured.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SearchBenchError {
    /// Neither rollouts nor episodes to hold out.
    #[error(
        "the dataset has one episode, so none can be held out to ask with: give rollouts, or a dataset of several episodes"
    )]
    NothingToAsk,
    /// Sizes, widths, engines, clusters or threads of which none go together.
    #[error(
        "nothing to measure: engines {engines} on states of {widths} columns (kd-tree takes at most {})",
        ksim::KdTree::MAX_FEATURES
    )]
    EmptyPlan {
        /// The engines asked for.
        engines: String,
        /// The widths asked for.
        widths: String,
    },
    /// Wider states than there are.
    #[error("a width of {asked} columns was asked for, the states have {found}")]
    Width {
        /// Columns asked for.
        asked: usize,
        /// Columns there are.
        found: usize,
    },
    /// An exact engine and the oracle disagree: a defect of the engine.
    #[error(
        "{engine}, {n_rows} rows of {width} columns, {queries} query {query}: its neighbors are not those of the oracle `linear`; please report this"
    )]
    NotExact {
        /// The engine.
        engine: &'static str,
        /// Reference rows.
        n_rows: usize,
        /// State columns.
        width: usize,
        /// The kind of queries.
        queries: String,
        /// Which of them, from 0.
        query: usize,
    },
    /// Threads could not be started.
    #[error("cannot start {n_threads} threads")]
    Threads {
        /// How many.
        n_threads: usize,
        /// Why not.
        source: rayon::ThreadPoolBuildError,
    },
    /// The data cannot be used.
    #[error(transparent)]
    Data(#[from] DataError),
    /// An engine cannot be built, or the queries cannot be scored.
    #[error(transparent)]
    Score(#[from] ScoreError),
    /// A search failed.
    #[error(transparent)]
    Search(#[from] SearchError),
}
