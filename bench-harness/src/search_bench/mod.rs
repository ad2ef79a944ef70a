//! Measures the search engines of `ksim` against each other: time, memory, and what approximation costs.
//!
//! Times are the best of several repeats, but for that of the one build; beside them and memory nothing depends on the
//! machine or on the number of threads. Every exact engine is held to the oracle `linear` on some of the queries, to
//! the last bit: a difference is an error, not a figure in the table.

mod error;
mod measure;
mod memory;
mod report;
mod source;
mod synthetic;

use std::fmt;

use ksim::Search;

pub use error::SearchBenchError;
pub use measure::run;
pub use report::{Approximation, Measurement, SCHEMA, SearchReport, SourcePart};
pub use source::StepSource;

/// Where a query comes from, as seen from the reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QueryKind {
    /// The same behavior in other episodes.
    InDistribution,
    /// The same behavior under more noise.
    Noisy,
    /// Behavior that has nothing to do with the reference.
    Random,
}

impl QueryKind {
    /// Every kind.
    pub const ALL: [Self; 3] = [Self::InDistribution, Self::Noisy, Self::Random];

    /// Its name in results.
    pub fn name(self) -> &'static str {
        match self {
            Self::InDistribution => "in-distribution",
            Self::Noisy => "noisy",
            Self::Random => "random",
        }
    }
}

impl fmt::Display for QueryKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// What is measured.
#[derive(Debug, Clone, PartialEq)]
pub struct SearchPlan {
    /// Reference rows.
    pub rows: Vec<usize>,
    /// State columns: the first so many.
    pub widths: Vec<usize>,
    /// Engines; `kd-tree` is left out where the states are too wide for it.
    pub engines: Vec<Search>,
    /// Numbers of clusters of [`Search::Clusters`].
    pub n_clusters: Vec<usize>,
    /// K.
    pub n_neighbors: usize,
    /// Queries of every kind, at most.
    pub n_queries: usize,
    /// How many of them, evenly spread, the oracle answers too.
    pub n_checked: usize,
    /// How many of them are also asked one at a time, on one thread.
    pub n_single: usize,
    /// Numbers of threads.
    pub threads: Vec<usize>,
    /// Timed repeats, of which the best counts.
    pub repeats: usize,
    /// Seed of k-means and of the bootstrap.
    pub seed: u64,
    /// Resamples of the bootstrap over episodes.
    pub n_resamples: usize,
}

impl Default for SearchPlan {
    fn default() -> Self {
        Self {
            rows: vec![100_000],
            widths: vec![31],
            engines: vec![Search::Blocked, Search::Clusters],
            n_clusters: vec![50],
            n_neighbors: 50,
            n_queries: 4000,
            n_checked: 100,
            n_single: 100,
            threads: vec![1],
            repeats: 3,
            seed: 0,
            n_resamples: 2000,
        }
    }
}
