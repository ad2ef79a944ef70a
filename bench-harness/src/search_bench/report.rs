//! What was measured, as a document: `ksim.bench.search/1`, described in `docs/bench-search.md`.
//!
//! The order of the fields here is the order in the JSON.

use serde::Serialize;

use crate::stats::Estimate;

/// Name and version of the schema. A change that could break a reader changes the number.
pub const SCHEMA: &str = "ksim.bench.search/1";

/// All measurements of a run.
#[derive(Debug, Clone, Serialize)]
pub struct SearchReport {
    /// [`SCHEMA`].
    pub schema: &'static str,
    /// Version of ksim.
    pub version: &'static str,
    /// Where reference and queries come from.
    pub source: SourcePart,
    /// K.
    pub n_neighbors: usize,
    /// Seed of k-means and of the bootstrap.
    pub seed: u64,
    /// Cores of the machine.
    pub n_cores: usize,
    /// One for every engine, size, width, number of threads and kind of queries.
    pub measurements: Vec<Measurement>,
}

/// Where reference and queries come from.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SourcePart {
    /// Name of the dataset; `None` for generated trajectories.
    pub dataset: Option<String>,
    /// Names of the rollouts asked with; empty where episodes are held out or generated.
    pub rollouts: Vec<String>,
}

/// One engine on one reference, asked with one kind of queries.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Measurement {
    /// The engine asked for.
    pub search: &'static str,
    /// The engine that ran: another only for `auto`.
    pub engine: &'static str,
    /// Whether its answers are the true nearest rows.
    pub exact: bool,
    /// Clusters, where the engine has them.
    pub n_clusters: Option<usize>,
    /// Reference rows.
    pub n_rows: usize,
    /// Those that are no jittered copies of others.
    pub n_distinct_rows: usize,
    /// State columns.
    pub n_columns: usize,
    /// Threads of build and batch.
    pub threads: usize,
    /// Kind of the queries, or the rollouts' name.
    pub queries: String,
    /// Number of queries.
    pub n_queries: usize,
    /// Seconds to build the index over normalized states, k-means included: built once.
    pub build_s: f64,
    /// Iterations of k-means on all rows, where there are clusters of our own.
    pub kmeans_iterations: Option<usize>,
    /// Their inertia.
    pub inertia: Option<f64>,
    /// Bytes of the normalized states, which every engine reads and none copies: 8 a value.
    pub reference_bytes: u64,
    /// Peak of resident memory during build and search, above what was resident before, the states included:
    /// what the index and its use cost on top of the reference. Memory that the process had taken and freed before does
    /// not show, so that of several engines in a run only the first has all of it. `None` where the system does not
    /// say.
    pub memory_bytes: Option<u64>,
    /// Seconds per query in one batch.
    pub query_s: f64,
    /// Seconds per query asked one at a time, on one thread: the best mean of the repeats; `None` if none were.
    pub single_query_s: Option<f64>,
    /// Queries that the oracle answered too, all alike if the engine is exact; 0 says nothing.
    pub n_checked: usize,
    /// K-Sim: mean over all queries.
    pub k_sim: f64,
    /// What it costs that the engine is not exact; `None` if it is.
    pub approximation: Option<Approximation>,
}

/// Departure of an approximate engine from exact search, over all queries.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Approximation {
    /// Mean share of the true K nearest rows that were found.
    pub recall_at_k: f64,
    /// Share of queries matched with another row.
    pub match_differs_share: f64,
    /// K-Sim less that of exact search, both means over all queries, with the 95 % bootstrap interval over episodes.
    pub score_difference: Estimate,
    /// The largest difference of a query, either way.
    pub max_score_difference: f64,
}
