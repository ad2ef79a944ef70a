//! Exact search for few columns: a k-d tree with rows copied into its leaves.
//!
//! Leaves are scanned by the very arithmetic of [`Matrix::squared_distance`], many rows at a time,
//! so that nothing is ranked twice. A node's box prunes exactly, too: rounding is monotonic, so the
//! rounded distance to a box, summed in the same order, never exceeds that to a row inside.

use std::fmt::{self, Debug};
use std::ops::Range;
use std::sync::Arc;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::best::Best;
use super::{Neighbor, NeighborIndex, Neighbors, SearchRequest};
use crate::error::SearchError;
use crate::matrix::{Matrix, squared_distance};

/// Rows in a leaf, at most.
const LEAF: usize = 32;

/// More than rounding can take from a radius that the triangle inequality gives.
const REACH_ROUNDING: f64 = 1.0 + 1e-9;

/// Queries searched one after the other by one task.
const RUN_QUERIES: usize = 256;

/// Nodes with fewer rows are built by the thread that has them.
const SEQUENTIAL_ROWS: usize = 1 << 14;

/// Exact search by a k-d tree: about `O(log n_rows)` per query in 1 to
/// [`MAX_FEATURES`](KdTree::MAX_FEATURES) columns, hopeless far above.
pub struct KdTree {
    tree: Box<dyn Tree>,
    n_rows: usize,
    n_features: usize,
}

impl Debug for KdTree {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-d tree of {} rows", self.n_features, self.n_rows)
    }
}

impl KdTree {
    /// The widest tree that is compiled.
    pub const MAX_FEATURES: usize = 8;

    /// Builds a tree over `data`.
    ///
    /// # Errors
    /// [`SearchError::TooWideForTree`] above [`MAX_FEATURES`](Self::MAX_FEATURES) columns.
    pub fn new(data: Arc<Matrix>) -> Result<Self, SearchError> {
        let tree: Box<dyn Tree> = match data.n_features() {
            1 => Box::new(Fixed::<1>::new(&data)),
            2 => Box::new(Fixed::<2>::new(&data)),
            3 => Box::new(Fixed::<3>::new(&data)),
            4 => Box::new(Fixed::<4>::new(&data)),
            5 => Box::new(Fixed::<5>::new(&data)),
            6 => Box::new(Fixed::<6>::new(&data)),
            7 => Box::new(Fixed::<7>::new(&data)),
            8 => Box::new(Fixed::<8>::new(&data)),
            found => {
                return Err(SearchError::TooWideForTree {
                    largest: Self::MAX_FEATURES,
                    found,
                });
            }
        };
        Ok(Self {
            tree,
            n_rows: data.n_rows(),
            n_features: data.n_features(),
        })
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
        self.n_rows
    }

    fn n_features(&self) -> usize {
        self.n_features
    }

    fn search(&self, request: &SearchRequest<'_>) -> Result<Neighbors, SearchError> {
        request.check(self.n_features())?;
        let n = request.n_neighbors_of(self.n_rows());
        let n_queries = request.queries.n_rows();
        let lists = (0..n_queries.div_ceil(RUN_QUERIES))
            .into_par_iter()
            .flat_map_iter(|run| {
                let start = run * RUN_QUERIES;
                let run = start..(start + RUN_QUERIES).min(n_queries);
                self.tree.search_run(request, run, n)
            })
            .collect();
        Ok(Neighbors::from_lists(lists, None))
    }
}

/// A tree of some width.
trait Tree: Send + Sync {
    /// The `n` nearest rows of some queries, one query after the other.
    fn search_run(
        &self,
        request: &SearchRequest<'_>,
        run: Range<usize>,
        n: usize,
    ) -> Vec<Vec<Neighbor>>;
}

/// What a leaf holds: column by column, beyond the last row values that no query is near.
struct Leaf<const K: usize> {
    columns: [[f64; LEAF]; K],
    rows: [u32; LEAF],
}

/// The smallest box around the rows of a node.
#[derive(Clone, Copy)]
struct Bounds<const K: usize> {
    low: [f64; K],
    high: [f64; K],
}

/// A balanced tree: the children of node i are 2i + 1 and 2i + 2, leaves come last.
struct Fixed<const K: usize> {
    bounds: Vec<Bounds<K>>,
    leaves: Vec<Leaf<K>>,
}

#[derive(Clone, Copy)]
struct Point<const K: usize> {
    values: [f64; K],
    row: u32,
}

impl<const K: usize> Fixed<K> {
    fn new(data: &Matrix) -> Self {
        let mut points: Vec<Point<K>> = (0..data.n_rows())
            .into_par_iter()
            .map(|row| {
                let mut values = [0.0; K];
                data.read_row(row, &mut values);
                Point {
                    values,
                    row: row as u32,
                }
            })
            .collect();
        let n_leaves = points.len().div_ceil(LEAF).next_power_of_two();
        sort(&mut points, n_leaves);
        let starts: Vec<usize> = leaf_starts(points.len(), n_leaves);
        let leaves: Vec<Leaf<K>> = starts
            .par_windows(2)
            .map(|ends| Leaf::new(&points[ends[0]..ends[1]]))
            .collect();
        let mut bounds = vec![Bounds::of(&[]); n_leaves - 1];
        bounds.extend(
            starts
                .windows(2)
                .map(|ends| Bounds::of(&points[ends[0]..ends[1]])),
        );
        for node in (0..n_leaves - 1).rev() {
            bounds[node] = bounds[2 * node + 1].with(&bounds[2 * node + 2]);
        }
        Self { bounds, leaves }
    }

    /// Takes the rows within `best`'s threshold, nearest boxes first.
    #[inline(always)]
    fn search(
        &self,
        query: &[f64; K],
        excluded: &Range<usize>,
        best: &mut Best,
        stack: &mut Vec<(f64, usize)>,
    ) {
        stack.clear();
        stack.push((self.bounds[0].squared_distance(query), 0));
        while let Some((squared, mut node)) = stack.pop() {
            if squared > best.squared {
                continue;
            }
            while node + 1 < self.leaves.len() {
                let children = [2 * node + 1, 2 * node + 2];
                let [a, b] = children.map(|child| self.bounds[child].squared_distance(query));
                let (near, far, beyond) = if a <= b {
                    (children[0], children[1], b)
                } else {
                    (children[1], children[0], a)
                };
                if beyond <= best.squared {
                    stack.push((beyond, far));
                }
                node = near;
            }
            self.leaves[node + 1 - self.leaves.len()].scan(query, excluded, best);
        }
    }
}

/// Where leaves start when halves are halved.
fn leaf_starts(n_points: usize, n_leaves: usize) -> Vec<usize> {
    if n_leaves == 1 {
        return vec![0, n_points];
    }
    let half = n_points / 2;
    let mut starts = leaf_starts(half, n_leaves / 2);
    starts.pop();
    let second = leaf_starts(n_points - half, n_leaves / 2);
    starts.extend(second.into_iter().map(|start| half + start));
    starts
}

/// Puts the points of each of `n_leaves` leaves together, splitting the widest side of the box in
/// the middle.
fn sort<const K: usize>(points: &mut [Point<K>], n_leaves: usize) {
    if n_leaves == 1 {
        return;
    }
    let bounds = Bounds::of(points);
    let side = |column: usize| bounds.high[column] - bounds.low[column];
    let widest = (1..K).fold(0, |best, column| {
        if side(column) > side(best) {
            column
        } else {
            best
        }
    });
    let half = points.len() / 2;
    points.select_nth_unstable_by(half, |a, b| {
        a.values[widest]
            .total_cmp(&b.values[widest])
            .then(a.row.cmp(&b.row))
    });
    let parallel = points.len() > SEQUENTIAL_ROWS;
    let (first, second) = points.split_at_mut(half);
    if parallel {
        rayon::join(|| sort(first, n_leaves / 2), || sort(second, n_leaves / 2));
    } else {
        sort(first, n_leaves / 2);
        sort(second, n_leaves / 2);
    }
}

impl<const K: usize> Bounds<K> {
    fn of(points: &[Point<K>]) -> Self {
        let mut bounds = Self {
            low: [f64::INFINITY; K],
            high: [f64::NEG_INFINITY; K],
        };
        for point in points {
            for column in 0..K {
                bounds.low[column] = bounds.low[column].min(point.values[column]);
                bounds.high[column] = bounds.high[column].max(point.values[column]);
            }
        }
        bounds
    }

    fn with(&self, other: &Self) -> Self {
        Self {
            low: std::array::from_fn(|column| self.low[column].min(other.low[column])),
            high: std::array::from_fn(|column| self.high[column].max(other.high[column])),
        }
    }

    /// Infinite for a box without rows.
    #[inline(always)]
    fn squared_distance(&self, query: &[f64; K]) -> f64 {
        let mut partial = [0.0; 4];
        for column in 0..K {
            let below = self.low[column] - query[column];
            let above = query[column] - self.high[column];
            let beyond = below.max(above).max(0.0);
            partial[column % 4] += beyond * beyond;
        }
        (partial[0] + partial[2]) + (partial[1] + partial[3])
    }
}

impl<const K: usize> Leaf<K> {
    fn new(points: &[Point<K>]) -> Self {
        let mut leaf = Self {
            columns: [[f64::INFINITY; LEAF]; K],
            rows: [0; LEAF],
        };
        for (at, point) in points.iter().enumerate() {
            for (column, value) in leaf.columns.iter_mut().zip(point.values) {
                column[at] = value;
            }
            leaf.rows[at] = point.row;
        }
        leaf
    }

    #[inline(always)]
    fn scan(&self, query: &[f64; K], excluded: &Range<usize>, best: &mut Best) {
        let mut partial = [[0.0f64; LEAF]; 4];
        for (column, (values, query)) in self.columns.iter().zip(query).enumerate() {
            for (partial, value) in partial[column % 4].iter_mut().zip(values) {
                let difference = value - query;
                *partial += difference * difference;
            }
        }
        let limit = best.squared.min(f64::MAX);
        let (mut squared, mut within) = ([0.0; LEAF], 0u32);
        let [a, b, c, d] = &partial;
        for (at, squared) in squared.iter_mut().enumerate() {
            *squared = (a[at] + c[at]) + (b[at] + d[at]);
        }
        for (at, squared) in squared.iter().enumerate() {
            within |= u32::from(*squared <= limit) << at;
        }
        while within != 0 {
            let at = within.trailing_zeros() as usize;
            within &= within - 1;
            if !excluded.contains(&(self.rows[at] as usize)) {
                best.push(squared[at], self.rows[at]);
            }
        }
        best.tighten_if_more_by(LEAF / 2);
    }
}

/// The searches of one run, compiled for the machine's vector unit.
struct Run<'a, const K: usize> {
    tree: &'a Fixed<K>,
    request: &'a SearchRequest<'a>,
    run: Range<usize>,
    n: usize,
}

impl<const K: usize> WithSimd for Run<'_, K> {
    type Output = Vec<Vec<Neighbor>>;

    /// A rollout's steps lie close together: what was the farthest neighbor of one is, by the
    /// triangle inequality, a limit for the next.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Vec<Vec<Neighbor>> {
        let Self {
            request, run, n, ..
        } = self;
        let mut lists: Vec<Vec<Neighbor>> = Vec::with_capacity(run.len());
        let mut stack = Vec::new();
        for query in run.clone() {
            let (values, excluded) = (request.queries.row(query), request.excluded(query));
            let mut reach = f64::INFINITY;
            if query > run.start && request.excluded(query - 1) == excluded {
                let step = squared_distance(request.queries.row(query - 1), values).sqrt();
                if let Some(last) = lists.last().and_then(|list| list.get(n - 1)) {
                    reach = (last.distance + step) * REACH_ROUNDING;
                }
            }
            // Squares of the smallest numbers underflow, their roots do not tell.
            let squared = (reach * reach).max(f64::MIN_POSITIVE);
            let mut best = Best::new(n, squared);
            let point = std::array::from_fn(|column| values[column]);
            self.tree.search(&point, &excluded, &mut best, &mut stack);
            lists.push(best.into_neighbors());
        }
        lists
    }
}

impl<const K: usize> Tree for Fixed<K> {
    fn search_run(
        &self,
        request: &SearchRequest<'_>,
        run: Range<usize>,
        n: usize,
    ) -> Vec<Vec<Neighbor>> {
        Arch::new().dispatch(Run {
            tree: self,
            request,
            run,
            n,
        })
    }
}
