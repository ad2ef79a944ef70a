//! Exact search for few columns: kiddo's k-d tree, ranked by our own distance.

use std::fmt::Debug;
use std::num::NonZero;
use std::ops::Range;
use std::sync::Arc;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

use super::{Neighbor, NeighborIndex, Neighbors, SearchRequest, rank};
use crate::error::SearchError;
use crate::matrix::{Matrix, squared_distance};

/// Extra neighbors asked of the tree. If the last of them lies clearly beyond the n-th, the answer
/// holds every row that rounding or a tie could bring among the n nearest.
const SPARE: usize = 4;

/// How far beyond the n-th squared distance a row must lie to be out of reach of rounding: the
/// tree and [`Matrix::squared_distance`] sum in different orders, 1e-15 apart.
const CLEARLY_BEYOND: f64 = 1.0 + 1e-12;

/// The same for a radius that the triangle inequality gives.
const REACH_ROUNDING: f64 = 1.0 + 1e-9;

/// Queries searched one after the other by one task.
const RUN_QUERIES: usize = 256;

/// Exact search by a k-d tree: about `O(log n_rows)` per query in 1 to
/// [`MAX_FEATURES`](KdTree::MAX_FEATURES) columns, hopeless far above.
#[derive(Debug)]
pub struct KdTree {
    data: Arc<Matrix>,
    tree: Box<dyn Tree>,
}

impl KdTree {
    /// The widest tree that is compiled.
    pub const MAX_FEATURES: usize = 8;

    /// Builds a tree over `data`.
    ///
    /// # Errors
    /// [`SearchError::TooWideForTree`] above [`MAX_FEATURES`](Self::MAX_FEATURES) columns.
    pub fn new(data: Arc<Matrix>) -> Result<Self, SearchError> {
        let tree = match data.n_features() {
            1 => build::<1>(&data)?,
            2 => build::<2>(&data)?,
            3 => build::<3>(&data)?,
            4 => build::<4>(&data)?,
            5 => build::<5>(&data)?,
            6 => build::<6>(&data)?,
            7 => build::<7>(&data)?,
            8 => build::<8>(&data)?,
            found => {
                return Err(SearchError::TooWideForTree {
                    largest: Self::MAX_FEATURES,
                    found,
                });
            }
        };
        Ok(Self { data, tree })
    }

    /// The `n` nearest rows, which are known to lie within `reach` of the query.
    fn search_one(
        &self,
        query: &[f64],
        excluded: &Range<usize>,
        n: usize,
        reach: f64,
    ) -> Vec<Neighbor> {
        let allowed = |row: &u32| !excluded.contains(&(*row as usize));
        let wanted = n + excluded.len();
        let mut found = self.tree.nearest(query, wanted + SPARE, reach * reach);
        if found.len() > wanted {
            let (beyond, _) = found[found.len() - 1];
            let (limit, _) = found[wanted - 1];
            if beyond <= limit * CLEARLY_BEYOND {
                found = self.tree.within(query, limit * CLEARLY_BEYOND);
            }
        }
        rank(
            &self.data,
            query,
            found.into_iter().map(|(_, row)| row).filter(allowed),
            n,
        )
    }

    /// Queries one after the other. A rollout's steps lie close together: what was the farthest
    /// neighbor of one is, by the triangle inequality, a limit for the next.
    fn search_run(
        &self,
        request: &SearchRequest<'_>,
        run: Range<usize>,
        n: usize,
    ) -> Vec<Vec<Neighbor>> {
        let mut lists: Vec<Vec<Neighbor>> = Vec::with_capacity(run.len());
        let mut reach = f64::INFINITY;
        for query in run.clone() {
            let (point, excluded) = (request.queries.row(query), request.excluded(query));
            if query > run.start {
                let before = query - 1;
                let step = squared_distance(request.queries.row(before), point).sqrt();
                reach = match lists.last() {
                    Some(list) if list.len() == n && request.excluded(before) == excluded => {
                        (list[n - 1].distance + step) * REACH_ROUNDING
                    }
                    _ => f64::INFINITY,
                };
            }
            lists.push(self.search_one(point, &excluded, n, reach));
        }
        lists
    }
}

impl NeighborIndex for KdTree {
    fn engine(&self) -> &'static str {
        "kd-tree"
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
        let n = request.n_neighbors.min(self.n_rows().max(1));
        let n_queries = request.queries.n_rows();
        let lists = (0..n_queries.div_ceil(RUN_QUERIES))
            .into_par_iter()
            .flat_map_iter(|run| {
                let start = run * RUN_QUERIES;
                self.search_run(request, start..(start + RUN_QUERIES).min(n_queries), n)
            })
            .collect();
        Ok(Neighbors::from_lists(lists, None))
    }
}

/// A tree of some width; results are (squared distance, row), ascending.
trait Tree: Send + Sync + Debug {
    /// At most `n` rows, none beyond the squared distance `limit`, which may be infinite.
    fn nearest(&self, query: &[f64], n: usize, limit: f64) -> Vec<(f64, u32)>;
    fn within(&self, query: &[f64], squared: f64) -> Vec<(f64, u32)>;
}

struct Fixed<const K: usize>(ImmutableKdTree<f64, K>);

impl<const K: usize> Debug for Fixed<K> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{K}-d tree of {} rows", self.0.size())
    }
}

fn build<const K: usize>(data: &Matrix) -> Result<Box<dyn Tree>, SearchError> {
    let mut points = vec![[0.0; K]; data.n_rows()];
    for (row, point) in points.iter_mut().enumerate() {
        data.read_row(row, point);
    }
    let tree = ImmutableKdTree::new_from_slice(&points)
        .map_err(|error| SearchError::Tree(format!("{error:?}")))?;
    Ok(Box::new(Fixed(tree)))
}

impl<const K: usize> Fixed<K> {
    fn point(query: &[f64]) -> [f64; K] {
        std::array::from_fn(|column| query[column])
    }
}

impl<const K: usize> Tree for Fixed<K> {
    fn nearest(&self, query: &[f64], n: usize, limit: f64) -> Vec<(f64, u32)> {
        let Some(n) = NonZero::new(n) else {
            return Vec::new();
        };
        let point = Self::point(query);
        let nearest = self.0.query(&point).nearest_n::<SquaredEuclidean<f64>>(n);
        let found = if limit.is_finite() {
            nearest.within(limit).execute()
        } else {
            nearest.execute()
        };
        found
            .into_iter()
            .map(|found| (found.distance, found.item))
            .collect()
    }

    fn within(&self, query: &[f64], squared: f64) -> Vec<(f64, u32)> {
        self.0
            .query(&Self::point(query))
            .within::<SquaredEuclidean<f64>>(squared)
            .execute()
            .into_iter()
            .map(|found| (found.distance, found.item))
            .collect()
    }
}
