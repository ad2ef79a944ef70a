//! Exact search at any width: a single-precision first pass over tiles of rows, then f64.

use std::sync::Arc;

use rayon::prelude::*;

use super::scan::{self, BATCH_QUERIES, Query};
use super::{NeighborIndex, Neighbors, SearchRequest};
use crate::error::SearchError;
use crate::matrix::{Matrix, max_norm};
use crate::tiles::RowSet;

/// Exact search for batches of queries: vectorised f32 distances with a proven error bound discard
/// almost every row, the rest are ranked in f64. The same neighbors as [`Linear`](super::Linear).
#[derive(Debug, Clone)]
pub struct Blocked {
    data: Arc<Matrix>,
    max_norm: f64,
}

impl Blocked {
    /// Indexes `data`: one pass for the largest norm, no copy.
    pub fn new(data: Arc<Matrix>) -> Self {
        let max_norm = max_norm(&data);
        Self { data, max_norm }
    }
}

impl NeighborIndex for Blocked {
    fn engine(&self) -> &'static str {
        "blocked"
    }

    fn is_exact(&self) -> bool {
        true
    }

    fn n_rows(&self) -> usize {
        self.data.n_rows()
    }

    fn n_features(&self) -> usize {
        self.data.n_features()
    }

    fn search(&self, request: &SearchRequest<'_>) -> Result<Neighbors, SearchError> {
        request.check(self.n_features())?;
        let n_queries = request.queries.n_rows();
        let lists = (0..n_queries.div_ceil(BATCH_QUERIES))
            .into_par_iter()
            .flat_map_iter(|batch| {
                let end = ((batch + 1) * BATCH_QUERIES).min(n_queries);
                let queries: Vec<Query<'_>> = (batch * BATCH_QUERIES..end)
                    .map(|query| Query {
                        values: request.queries.row(query),
                        excluded: request.excluded(query),
                    })
                    .collect();
                let rows = RowSet::Range {
                    start: 0,
                    end: self.n_rows(),
                };
                scan::nearest(
                    &self.data,
                    rows,
                    &queries,
                    request.n_neighbors,
                    self.max_norm,
                )
            })
            .collect();
        Ok(Neighbors::from_lists(lists, None))
    }
}
