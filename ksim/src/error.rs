//! What can go wrong, by concern: the data, the k-means parameters, a search, a score.

use thiserror::Error;

/// A matrix or a set of trajectories that cannot be used.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum DataError {
    /// A value is NaN, infinite or too large for the engine.
    #[error("row {row}, column {column} holds {value:e}, expected a finite number within ±3.4e38")]
    NonFinite {
        /// Row of the matrix, from 0.
        row: usize,
        /// Column of the matrix, from 0.
        column: usize,
        /// What stands there.
        value: f64,
    },
    /// The same, seen as a step of an episode.
    #[error(
        "episode {episode_index}, step {step_index}: {part} column {column} holds {value:e}, \
         expected a finite number within ±3.4e38"
    )]
    NonFiniteStep {
        /// The episode, by its own number.
        episode_index: i64,
        /// Step within the episode, from 0.
        step_index: usize,
        /// `state` or `action`.
        part: &'static str,
        /// Column of that part, from 0.
        column: usize,
        /// What stands there.
        value: f64,
    },
    /// The number of values is not a multiple of the width.
    #[error("{values} values do not fill rows of {n_features} columns")]
    RaggedRows {
        /// Values given.
        values: usize,
        /// Width asked for.
        n_features: usize,
    },
    /// States and actions of one push differ in their number of rows.
    #[error("{states} rows of states beside {actions} rows of actions")]
    UnequalRows {
        /// Rows of states.
        states: usize,
        /// Rows of actions.
        actions: usize,
    },
    /// Lent bytes that cannot be read as numbers.
    #[error("{bytes} lent bytes cannot be read as numbers: {reason}")]
    Lent {
        /// How many.
        bytes: usize,
        /// Why not.
        reason: &'static str,
    },
    /// Two planes of one matrix, or parts of one set of trajectories, that do not go together.
    #[error("{what}: found {found}, expected {expected}")]
    Parts {
        /// What was counted.
        what: &'static str,
        /// As the other part has it.
        expected: usize,
        /// As this part has it.
        found: usize,
    },
    /// A matrix without columns.
    #[error("a matrix needs at least one column")]
    NoColumns,
    /// More columns than a search numbers.
    #[error("{found} columns, expected at most {most}")]
    TooManyColumns {
        /// The most there may be.
        most: usize,
        /// Columns found.
        found: usize,
    },
    /// More rows than a row number can name.
    #[error("more than {} rows", u32::MAX)]
    TooManyRows,
    /// Statistics that nothing can be normalized by.
    #[error(
        "column {column}: mean {mean:e} and standard deviation {std:e}, expected finite numbers, the second above 0"
    )]
    Statistics {
        /// The column, from 0.
        column: usize,
        /// Its mean.
        mean: f64,
        /// Its standard deviation.
        std: f64,
    },
    /// An episode came back after another had begun.
    #[error(
        "episode {episode_index} continues after another episode began: rows of one episode must be contiguous"
    )]
    SplitEpisode {
        /// The episode, by its own number.
        episode_index: i64,
    },
}

/// Parameters that no k-means fit can take.
#[derive(Debug, Error, Clone)]
#[non_exhaustive]
pub enum KMeansError {
    /// No cluster was asked for.
    #[error("n_clusters is 0, expected at least 1")]
    NoClusters,
    /// Fewer rows than clusters.
    #[error("{n_rows} rows cannot make {n_clusters} clusters")]
    TooFewRows {
        /// Rows given.
        n_rows: usize,
        /// Clusters asked for.
        n_clusters: usize,
    },
    /// A tolerance that is negative or not finite.
    #[error("tolerance is {value}, expected a finite number of at least 0")]
    Tolerance {
        /// What was given.
        value: f64,
    },
    /// Centers of another width than the data.
    #[error("centers have {found} columns, expected {expected}")]
    CenterWidth {
        /// Width of the data.
        expected: usize,
        /// Width of the centers.
        found: usize,
    },
    /// A center that is no point.
    #[error("a center is not finite")]
    Center(#[source] DataError),
    /// Clusters of other data.
    #[error("clusters of {found} rows do not go with {expected} rows")]
    OtherRows {
        /// Rows of the data.
        expected: usize,
        /// Rows the clusters were fitted to.
        found: usize,
    },
    /// A row in a cluster that is not there.
    #[error("row {row} belongs to cluster {label}, expected one of {n_clusters}")]
    Label {
        /// The row.
        row: usize,
        /// Its cluster.
        label: u32,
        /// Number of clusters.
        n_clusters: usize,
    },
    /// The linfa backend failed.
    #[cfg(feature = "linfa")]
    #[error("linfa's k-means failed")]
    Linfa(#[source] std::sync::Arc<linfa_clustering::KMeansError>),
}

/// A neighbor search that cannot be built or answered.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum SearchError {
    /// Queries of another width than the index.
    #[error("queries have {found} columns, the index has {expected}")]
    DimensionMismatch {
        /// Width of the index.
        expected: usize,
        /// Width of the queries.
        found: usize,
    },
    /// The tree is compiled for a few widths only.
    #[error(
        "the kd-tree takes 1 to {largest} columns, found {found}: \
         choose the engine `blocked` or fewer state columns"
    )]
    TooWideForTree {
        /// Largest compiled width.
        largest: usize,
        /// Width asked for.
        found: usize,
    },
    /// Rounded rows that cannot be searched.
    #[error("rounded rows do not go with the data, or contradict themselves: {what}")]
    RoundedRows {
        /// What does not fit.
        what: &'static str,
    },
    /// No neighbors were asked for.
    #[error("n_neighbors is 0, expected at least 1")]
    NoNeighbors,
    /// One exclusion per query, or none at all.
    #[error("{found} exclusions for {expected} queries")]
    ExclusionCount {
        /// Number of queries.
        expected: usize,
        /// Number of exclusions.
        found: usize,
    },
}

/// A score that cannot be computed.
#[derive(Debug, Error, Clone)]
#[non_exhaustive]
pub enum ScoreError {
    /// The reference holds no step.
    #[error("the reference holds no step")]
    EmptyReference,
    /// The rollouts hold no step.
    #[error("the rollouts hold no step")]
    EmptyRollouts,
    /// The rollouts' states are not as wide as the reference's.
    #[error("{part}s of the rollouts have {found} columns, the reference has {expected}")]
    WidthMismatch {
        /// `state` or `action`.
        part: &'static str,
        /// Width of the reference.
        expected: usize,
        /// Width of the rollouts.
        found: usize,
    },
    /// γ outside its range.
    #[error("gamma is {value}, expected a finite number above 0")]
    Gamma {
        /// What was given.
        value: f64,
    },
    /// A step whose every candidate was excluded.
    #[error(
        "episode {episode_index}, step {step_index}: no reference step is left to compare with"
    )]
    NoCandidate {
        /// The episode, by its own number.
        episode_index: i64,
        /// Step within the episode, from 0.
        step_index: usize,
    },
    /// Same-episode exclusion asked for, but the test data are not the reference.
    #[error(
        "episode {episode_index} of the rollouts is not episode {episode_index} of the reference: \
         excluding the same episode is for scoring a dataset against itself"
    )]
    NotSelf {
        /// The episode, by its own number.
        episode_index: i64,
    },
    /// The data cannot be used.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The clusters cannot be made.
    #[error(transparent)]
    KMeans(#[from] KMeansError),
    /// The search failed.
    #[error(transparent)]
    Search(#[from] SearchError),
}
