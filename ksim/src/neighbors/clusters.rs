//! The paper's approximation: search only the cluster whose center is nearest.

use std::sync::Arc;

use rayon::prelude::*;

use super::quantized::{BATCH_QUERIES, Codes, RoundedRows, Searcher, Simd};
use super::scan::Query;
use super::{NeighborIndex, Neighbors, SearchRequest};
use crate::error::SearchError;
use crate::kmeans::KMeans;
use crate::matrix::{Matrix, max_norm};

/// One-probe search over k-means clusters ("Similarity Measurement" of the Curiosity-Diffuser
/// paper): the cluster with the nearest center is searched exactly, the others not at all.
///
/// A query whose cluster is empty, or has only excluded rows, goes to the cluster with the next
/// nearest center.
#[derive(Debug, Clone)]
pub struct Clusters {
    data: Arc<Matrix>,
    kmeans: KMeans,
    /// Rows by cluster, ascending within each.
    rows: Vec<u32>,
    /// `n_clusters + 1` offsets into `rows`.
    offsets: Vec<usize>,
    /// A segment for each cluster.
    codes: Arc<Codes>,
    max_norm: f64,
    simd: Simd,
}

impl Clusters {
    /// Groups the rows of `data` by the clusters of `kmeans`, which was fitted to them.
    ///
    /// # Panics
    /// If `kmeans` was fitted to another number of rows.
    pub fn new(data: Arc<Matrix>, kmeans: KMeans) -> Self {
        let (rows, offsets) = rows_by_cluster(&data, &kmeans);
        let segments: Vec<&[u32]> = offsets
            .windows(2)
            .map(|ends| &rows[ends[0]..ends[1]])
            .collect();
        let codes = Arc::new(Codes::new(&data, &segments));
        let max_norm = max_norm(&data);
        Self {
            data,
            kmeans,
            rows,
            offsets,
            codes,
            max_norm,
            simd: Simd::best(),
        }
    }

    /// The same by rows that were rounded before: no pass over the data.
    ///
    /// # Errors
    /// [`SearchError::RoundedRows`] if they are not of as many rows, columns and clusters.
    ///
    /// # Panics
    /// As [`new`](Self::new).
    pub fn from_rounded(
        data: Arc<Matrix>,
        kmeans: KMeans,
        rounded: RoundedRows,
    ) -> Result<Self, SearchError> {
        let (rows, offsets) = rows_by_cluster(&data, &kmeans);
        let shape = (data.n_rows(), data.n_features());
        let (codes, max_norm) = rounded.into_codes(shape, kmeans.n_clusters())?;
        let belongs = |cluster: usize| {
            let mut rows = codes.rows(codes.segment(cluster)).into_iter();
            rows.all(|row| kmeans.labels()[row as usize] as usize == cluster)
        };
        if !(0..kmeans.n_clusters()).into_par_iter().all(belongs) {
            let what = "the clusters of their rows";
            return Err(SearchError::RoundedRows { what });
        }
        Ok(Self {
            data,
            kmeans,
            rows,
            offsets,
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

    /// The clusters searched.
    pub fn kmeans(&self) -> &KMeans {
        &self.kmeans
    }

    fn members(&self, cluster: u32) -> &[u32] {
        &self.rows[self.offsets[cluster as usize]..self.offsets[cluster as usize + 1]]
    }

    /// The nearest cluster that has a row for this query.
    fn probe(&self, query: &Query<'_>) -> u32 {
        let has_row = |cluster: u32| {
            self.members(cluster)
                .iter()
                .any(|&row| !query.excluded.contains(&(row as usize)))
        };
        let nearest = self.kmeans.nearest_center(query.values);
        if has_row(nearest) {
            return nearest;
        }
        let order = self.kmeans.centers_by_distance(query.values);
        order
            .into_iter()
            .find(|&cluster| has_row(cluster))
            .unwrap_or(nearest)
    }
}

/// Rows by cluster, ascending within each, and `n_clusters + 1` offsets into them.
fn rows_by_cluster(data: &Matrix, kmeans: &KMeans) -> (Vec<u32>, Vec<usize>) {
    assert_eq!(
        kmeans.labels().len(),
        data.n_rows(),
        "rows behind the clusters"
    );
    let mut offsets = vec![0; kmeans.n_clusters() + 1];
    for &label in kmeans.labels() {
        offsets[label as usize + 1] += 1;
    }
    for cluster in 0..kmeans.n_clusters() {
        offsets[cluster + 1] += offsets[cluster];
    }
    let mut next = offsets.clone();
    let mut rows = vec![0; data.n_rows()];
    for (row, &label) in kmeans.labels().iter().enumerate() {
        rows[next[label as usize]] = row as u32;
        next[label as usize] += 1;
    }
    (rows, offsets)
}

impl NeighborIndex for Clusters {
    fn engine(&self) -> &'static str {
        "clusters"
    }

    fn is_exact(&self) -> bool {
        false
    }

    fn n_rows(&self) -> usize {
        self.data.n_rows()
    }

    fn n_features(&self) -> usize {
        self.data.n_features()
    }

    fn kmeans(&self) -> Option<&KMeans> {
        Some(&self.kmeans)
    }

    fn search(&self, request: &SearchRequest<'_>) -> Result<Neighbors, SearchError> {
        request.check(self.n_features())?;
        let query_at = |query: usize| Query {
            values: request.queries.row(query),
            excluded: request.excluded(query),
        };
        let clusters: Vec<u32> = (0..request.queries.n_rows())
            .into_par_iter()
            .map(|query| self.probe(&query_at(query)))
            .collect();
        // Queries of one cluster travel together, so that its rows are read once for all.
        let mut order: Vec<usize> = (0..clusters.len()).collect();
        order.sort_by_key(|&query| clusters[query]);
        let tasks: Vec<&[usize]> = order
            .chunk_by(|&a, &b| clusters[a] == clusters[b])
            .flat_map(|group| group.chunks(BATCH_QUERIES))
            .collect();
        let searcher = Searcher {
            data: &self.data,
            codes: &self.codes,
            max_norm: self.max_norm,
            simd: self.simd,
            parts: 1,
        };
        let answers: Vec<_> = tasks
            .par_iter()
            .flat_map_iter(|&task| {
                let queries: Vec<Query<'_>> = task.iter().map(|&query| query_at(query)).collect();
                let cluster = clusters[task[0]] as usize;
                let n = request.n_neighbors_of(self.n_rows());
                let lists = searcher.nearest(cluster, &queries, n);
                task.iter().copied().zip(lists)
            })
            .collect();
        let mut lists = vec![Vec::new(); clusters.len()];
        for (query, list) in answers {
            lists[query] = list;
        }
        Ok(Neighbors::from_lists(lists, Some(clusters)))
    }
}
