//! K-Sim: how closely a policy's closed-loop behavior stays to its training data.
//!
//! For every step (s, π(s)) of a rollout the engine finds the reference states nearest to s, among
//! them the one whose action is nearest to π(s), and scores the step by
//! `min(1, γ√d / distance)` in normalized units; K-Sim is the mean over steps
//! (Curiosity-Diffuser, "Similarity Measurement"). It does not say whether the policy succeeds,
//! and it knows nothing of files: [`Trajectories`] go in, a [`Report`] comes out.
//!
//! ```
//! use ksim::{KSim, Search, Trajectories};
//!
//! let mut reference = Trajectories::new(2, 1)?; // two state columns, one action column
//! reference.push(0, &[0.0, 0.0, 1.0, 0.0, 2.0, 1.0], &[1.0, 1.0, -1.0])?;
//! let mut rollouts = Trajectories::new(2, 1)?;
//! rollouts.push(0, &[0.9, 0.1], &[1.0])?;
//!
//! let ksim = KSim::params().search(Search::Linear).fit(reference)?;
//! let report = ksim.score(&rollouts)?;
//! assert_eq!(report.steps[0].reference_row, 1);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! | module | holds |
//! |---|---|
//! | `matrix`, `buffer`, `trajectories` | the numbers: rows held as pairs of f32, owned or lent; episodes |
//! | `normalizer` | z-scores by the reference's statistics |
//! | `kmeans` | greedy k-means++, Lloyd with Yinyang bounds |
//! | `neighbors` | one search trait, four engines |
//! | `score` | K-Sim, its aggregates and intervals |

mod buffer;
mod error;
mod kmeans;
mod matrix;
mod neighbors;
mod normalizer;
mod prefetch;
mod rng;
mod score;
mod tiles;
mod trajectories;

pub use buffer::Buffer;
pub use error::{DataError, KMeansError, ScoreError, SearchError};
pub use kmeans::{KMeans, KMeansBackend, KMeansParams};
pub use matrix::{Matrix, MatrixView};
pub use neighbors::{
    Blocked, Clusters, KdTree, Linear, Neighbor, NeighborIndex, Neighbors, RoundedRows,
    SearchRequest, Simd,
};
pub use normalizer::Normalizer;
pub use prefetch::prefetch;
pub use score::{
    Aggregate, ApproximationError, EpisodeScore, KSim, KSimParams, Prepared, Reference, Report,
    ScoreOptions, Search, StepScore,
};
pub use trajectories::{EpisodeRows, Trajectories};
