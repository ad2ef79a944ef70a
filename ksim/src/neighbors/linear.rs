//! The oracle: every row, in f64.

use std::sync::Arc;

use rayon::prelude::*;

use super::{NeighborIndex, Neighbors, SearchRequest, rank};
use crate::error::SearchError;
use crate::matrix::Matrix;

/// Exact search by a plain f64 scan of every row: `O(n_rows · n_features)` per query, any width.
/// The other exact engines are tested against it.
#[derive(Debug, Clone)]
pub struct Linear {
    data: Arc<Matrix>,
}

impl Linear {
    /// Indexes `data`; nothing is built.
    pub fn new(data: Arc<Matrix>) -> Self {
        Self { data }
    }
}

impl NeighborIndex for Linear {
    fn engine(&self) -> &'static str {
        "linear"
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
        let lists = (0..request.queries.n_rows())
            .into_par_iter()
            .map(|query| {
                let excluded = request.excluded(query);
                let rows = (0..self.n_rows() as u32).filter(|&r| !excluded.contains(&(r as usize)));
                rank(
                    &self.data,
                    request.queries.row(query),
                    rows,
                    request.n_neighbors_of(self.n_rows()),
                )
            })
            .collect();
        Ok(Neighbors::from_lists(lists, None))
    }
}
