//! Nearest-neighbor search over a fixed matrix: one trait, several engines.
//!
//! Every exact engine gives the same neighbors in the same order, ties included, because all rank
//! by [`Matrix::squared_distance`]; they differ only in how few rows they have to rank.

mod best;
mod blocked;
mod clusters;
mod kd_tree;
mod linear;
mod quantized;
mod scan;

use std::fmt::Debug;
use std::ops::Range;

pub use blocked::Blocked;
pub use clusters::Clusters;
pub use kd_tree::KdTree;
pub use linear::Linear;
pub use quantized::{RoundedRows, Simd};

use crate::error::SearchError;
use crate::kmeans::KMeans;
use crate::matrix::{Matrix, MatrixView};

/// A batch of queries.
#[derive(Debug, Clone, Copy)]
pub struct SearchRequest<'a> {
    /// The queries, of shape `(n_queries, n_features)`.
    pub queries: MatrixView<'a>,
    /// How many neighbors each query wants, at least 1.
    pub n_neighbors: usize,
    /// Rows that a query may not be matched with, one range per query (for scoring a dataset
    /// against itself); `None` excludes nothing.
    pub excluded: Option<&'a [Range<usize>]>,
}

impl<'a> SearchRequest<'a> {
    /// A request without exclusions.
    pub fn new(queries: MatrixView<'a>, n_neighbors: usize) -> Self {
        Self {
            queries,
            n_neighbors,
            excluded: None,
        }
    }

    /// Neighbors that a query can have among so many rows: what engines may make room for.
    fn n_neighbors_of(&self, n_rows: usize) -> usize {
        self.n_neighbors.min(n_rows.max(1))
    }

    fn excluded(&self, query: usize) -> Range<usize> {
        self.excluded.map_or(0..0, |ranges| ranges[query].clone())
    }

    fn check(&self, n_features: usize) -> Result<(), SearchError> {
        let found = self.queries.n_features();
        if found != n_features {
            return Err(SearchError::DimensionMismatch {
                expected: n_features,
                found,
            });
        }
        if self.n_neighbors == 0 {
            return Err(SearchError::NoNeighbors);
        }
        match self.excluded {
            Some(ranges) if ranges.len() != self.queries.n_rows() => {
                Err(SearchError::ExclusionCount {
                    expected: self.queries.n_rows(),
                    found: ranges.len(),
                })
            }
            _ => Ok(()),
        }
    }
}

/// One neighbor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbor {
    /// Row of the indexed matrix.
    pub row: u32,
    /// L2 distance, not squared.
    pub distance: f64,
}

/// The answer to a batch, query by query in the order asked.
#[derive(Debug, Clone, PartialEq)]
pub struct Neighbors {
    neighbors: Vec<Neighbor>,
    /// `n_queries + 1` offsets into `neighbors`.
    offsets: Vec<usize>,
    /// The cluster that was probed for each query, where the engine has clusters.
    clusters: Option<Vec<u32>>,
}

impl Neighbors {
    fn from_lists(lists: Vec<Vec<Neighbor>>, clusters: Option<Vec<u32>>) -> Self {
        let mut offsets = Vec::with_capacity(lists.len() + 1);
        offsets.push(0);
        let mut neighbors = Vec::with_capacity(lists.iter().map(Vec::len).sum());
        for list in lists {
            neighbors.extend(list);
            offsets.push(neighbors.len());
        }
        Self {
            neighbors,
            offsets,
            clusters,
        }
    }

    /// Number of queries answered.
    pub fn n_queries(&self) -> usize {
        self.offsets.len() - 1
    }

    /// The neighbors of one query: ascending distance, ties by smaller row; fewer than asked for
    /// if there are not so many rows.
    ///
    /// # Panics
    /// If `query` is out of range.
    pub fn of(&self, query: usize) -> &[Neighbor] {
        &self.neighbors[self.offsets[query]..self.offsets[query + 1]]
    }

    /// The cluster probed for one query, where the engine has clusters.
    pub fn cluster(&self, query: usize) -> Option<u32> {
        self.clusters.as_ref().map(|clusters| clusters[query])
    }
}

/// k-nearest-neighbor search over a fixed matrix of shape `(n_rows, n_features)`.
///
/// Order: ascending L2 distance in f64, ties by smaller row; fewer results if there are not
/// `n_neighbors` rows to choose from. The answer does not depend on the number of threads.
pub trait NeighborIndex: Send + Sync + Debug {
    /// The engine's name: `linear`, `kd-tree`, `blocked`, `clusters`.
    fn engine(&self) -> &'static str;
    /// Whether the answer is the true set of nearest rows.
    fn is_exact(&self) -> bool;
    /// Number of indexed rows.
    fn n_rows(&self) -> usize;
    /// Width of a row.
    fn n_features(&self) -> usize;
    /// The clusters that are probed, where the engine has clusters.
    fn kmeans(&self) -> Option<&KMeans> {
        None
    }
    /// Answers a batch of queries in parallel.
    ///
    /// # Errors
    /// [`SearchError::DimensionMismatch`], [`SearchError::NoNeighbors`],
    /// [`SearchError::ExclusionCount`].
    fn search(&self, request: &SearchRequest<'_>) -> Result<Neighbors, SearchError>;
}

/// The `n` best of `candidates` by exact distance to `query`, ties by smaller row.
fn rank(
    data: &Matrix,
    query: &[f64],
    candidates: impl Iterator<Item = u32>,
    n: usize,
) -> Vec<Neighbor> {
    let mut ranked: Vec<(f64, u32)> = candidates
        .map(|row| (data.squared_distance(row as usize, query), row))
        .collect();
    let by_distance = |a: &(f64, u32), b: &(f64, u32)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    // A tree gives its candidates in order: looking costs less than sorting them again.
    if !ranked.is_sorted_by(|a, b| by_distance(a, b).is_le()) {
        if ranked.len() > 2 * n {
            ranked.select_nth_unstable_by(n - 1, by_distance);
            ranked.truncate(n);
        }
        ranked.sort_unstable_by(by_distance);
    }
    ranked.truncate(n);
    // From a borrow: collecting the vector itself would keep the room of all candidates.
    ranked
        .iter()
        .map(|&(squared, row)| Neighbor {
            row,
            distance: squared.sqrt(),
        })
        .collect()
}
