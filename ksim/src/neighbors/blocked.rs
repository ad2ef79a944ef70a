//! Exact search at any width: a quantized first pass over blocks of rows, then f64.

use std::sync::Arc;

use rayon::prelude::*;

use super::quantized::{BATCH_QUERIES, Codes, RoundedRows, Searcher, Simd};
use super::scan::Query;
use super::{NeighborIndex, Neighbors, SearchRequest};
use crate::error::SearchError;
use crate::matrix::{Matrix, max_norm};

/// Fewer queries than this are not worth a batch of their own: the rows are shared out instead.
const SMALL_BATCH: usize = 64;

/// Exact search for batches of queries: rows rounded to bytes, with a proven error bound, discard
/// almost every row, the rest are ranked in f64. The same neighbors as [`Linear`](super::Linear).
///
/// The rounded rows take about a byte per value, in blocks of four columns, and four per row.
#[derive(Debug, Clone)]
pub struct Blocked {
    data: Arc<Matrix>,
    codes: Arc<Codes>,
    max_norm: f64,
    simd: Simd,
}

impl Blocked {
    /// Indexes `data`: a few passes over it, and a rounded copy.
    pub fn new(data: Arc<Matrix>) -> Self {
        let rows: Vec<u32> = (0..data.n_rows() as u32).collect();
        let codes = Arc::new(Codes::new(&data, &[&rows]));
        let max_norm = max_norm(&data);
        Self {
            data,
            codes,
            max_norm,
            simd: Simd::best(),
        }
    }

    /// Indexes `data` by rows that were rounded before: no pass over the data.
    ///
    /// # Errors
    /// [`SearchError::RoundedRows`] if they are not of as many rows and columns.
    pub fn from_rounded(data: Arc<Matrix>, rounded: RoundedRows) -> Result<Self, SearchError> {
        let shape = (data.n_rows(), data.n_features());
        let (codes, max_norm) = rounded.into_codes(shape, 1)?;
        Ok(Self {
            data,
            codes: Arc::new(codes),
            max_norm,
            simd: Simd::best(),
        })
    }

    /// The rounded rows, shared, for [`from_rounded`](Self::from_rounded).
    pub fn rounded(&self) -> RoundedRows {
        RoundedRows::of(&self.codes, self.max_norm)
    }

    /// Takes another vector unit than the best; the answers are the same.
    pub fn with_simd(mut self, simd: Simd) -> Self {
        self.simd = simd;
        self
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
        let threads = rayon::current_num_threads();
        // Whole rounds of all threads, where there are queries enough.
        let rounds = n_queries.div_ceil(BATCH_QUERIES * threads).max(1);
        let batch = n_queries.div_ceil(rounds * threads).max(SMALL_BATCH);
        let n_batches = n_queries.div_ceil(batch);
        let searcher = Searcher {
            data: &self.data,
            codes: &self.codes,
            max_norm: self.max_norm,
            simd: self.simd,
            parts: threads.div_ceil(n_batches.max(1)),
        };
        let lists = (0..n_batches)
            .into_par_iter()
            .flat_map_iter(|number| {
                let end = ((number + 1) * batch).min(n_queries);
                let queries: Vec<Query<'_>> = (number * batch..end)
                    .map(|query| Query {
                        values: request.queries.row(query),
                        excluded: request.excluded(query),
                    })
                    .collect();
                searcher.nearest(0, &queries, request.n_neighbors_of(self.n_rows()))
            })
            .collect();
        Ok(Neighbors::from_lists(lists, None))
    }
}
