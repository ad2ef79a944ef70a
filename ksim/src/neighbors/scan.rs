//! A first pass over few rows, without an index: single-precision distances of many queries to many
//! rows, with a bound on their error, so that only rows that can matter are ranked in f64.
//!
//! With x̂ and q̂ the values rounded to f32 and u = 2⁻²⁴, the difference vector is off by at most
//! e = u(‖x‖ + ‖q‖) in L2, and its squared length D̂, summed over w columns in f32, by at most a
//! factor 1 ± g, g = γ(w + 4), see [`gamma`]. Hence a row at true distance d has
//! D̂ ≤ (d + e)²(1 + g), and d ≤ √(D̂(1 + 2g)) + e while g ≤ 1/2, which 2¹⁸ columns are far
//! below. If t is the n-th smallest D̂ so far, n rows lie within the latter of t, so no row
//! beyond `Bound::widen(t)`, the former applied to the latter, can be among the n nearest. Where
//! squares underflow, each is off by at most 2⁻¹⁴⁹, which e takes in as √w·2⁻⁷⁴. Both bounds are
//! widened once more to cover the rounding of the bounds themselves.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};

use super::{Neighbor, rank};
use crate::matrix::{Matrix, gamma, underflow};
use crate::tiles::{RUN_ROWS, RowSet, TILE_ROWS, new_tile, pack, squared_distances};

/// One query on its way over the rows.
#[derive(Debug, Clone)]
pub(super) struct Query<'a> {
    pub(super) values: &'a [f64],
    pub(super) excluded: Range<usize>,
}

/// The `n` nearest rows of `rows` for each query.
pub(super) fn nearest(
    data: &Matrix,
    rows: RowSet<'_>,
    queries: &[Query<'_>],
    n: usize,
    max_norm: f64,
) -> Vec<Vec<Neighbor>> {
    let mut states: Vec<State<'_>> = queries
        .iter()
        .map(|query| State::new(data, query, n, max_norm))
        .collect();
    Arch::new().dispatch(Scan {
        data,
        rows,
        queries: &mut states,
    });
    states
        .into_iter()
        .zip(queries)
        .map(|(state, query)| {
            let survivors = state.into_survivors().into_iter().map(|(_, row)| row);
            rank(data, query.values, survivors, n)
        })
        .collect()
}

/// Error bound of the f32 distances of one query.
#[derive(Debug, Clone, Copy)]
struct Bound {
    /// e of the module's text.
    rounding: f64,
    /// 1 + 2g, with room for the rounding of this very arithmetic.
    factor: f64,
}

impl Bound {
    fn new(query: &[f64], max_norm: f64) -> Self {
        let unit = f64::from(f32::EPSILON) / 2.0;
        let norm = query.iter().map(|v| v * v).sum::<f64>().sqrt();
        Self {
            rounding: unit * (max_norm + norm) * 1.001 + underflow(query.len()),
            factor: 1.0 + 2.0 * gamma(query.len() + 8),
        }
    }

    /// The largest f32 squared distance that a row no farther than the one behind `squared` can
    /// show.
    fn widen(&self, squared: f32) -> f32 {
        self.shown((f64::from(squared) * self.factor).sqrt() + self.rounding)
    }

    /// The largest f32 squared distance that a row within `distance` can show.
    fn shown(&self, distance: f64) -> f32 {
        (((distance + self.rounding).powi(2) * self.factor) as f32).next_up()
    }
}

#[derive(Debug)]
struct State<'a> {
    data: &'a Matrix,
    query: &'a Query<'a>,
    /// The query in f32.
    values: Vec<f32>,
    n: usize,
    bound: Bound,
    /// Rows with a larger f32 squared distance cannot matter.
    threshold: f32,
    survivors: Vec<(f32, u32)>,
}

impl<'a> State<'a> {
    fn new(data: &'a Matrix, query: &'a Query<'a>, n: usize, max_norm: f64) -> Self {
        Self {
            data,
            query,
            values: query.values.iter().map(|&v| v as f32).collect(),
            n,
            bound: Bound::new(query.values, max_norm),
            threshold: f32::INFINITY,
            survivors: Vec::new(),
        }
    }

    /// Takes a row, in any order.
    fn push(&mut self, squared: f32, row: u32) {
        if self.query.excluded.contains(&(row as usize)) {
            return;
        }
        self.survivors.push((squared, row));
        let full = 4 * self.n + TILE_ROWS;
        if self.survivors.len() >= full {
            self.compact();
            // Ties, or distances beyond what f32 can tell apart: only f64 makes room, and it must,
            // or every further row would go through all of them again.
            if self.survivors.len() > full / 2 {
                self.compact_exactly();
            }
        }
    }

    /// Lowers the threshold to what the n-th best so far allows, and drops what lies beyond.
    fn compact(&mut self) {
        if self.survivors.len() <= self.n {
            return;
        }
        let by_distance = |a: &(f32, u32), b: &(f32, u32)| a.0.total_cmp(&b.0);
        let (_, nth, _) = self
            .survivors
            .select_nth_unstable_by(self.n - 1, by_distance);
        self.threshold = self.threshold.min(self.bound.widen(nth.0));
        let threshold = self.threshold;
        self.survivors.retain(|(squared, _)| *squared <= threshold);
    }

    /// Keeps the n best by exact distance. A row to come that ties with the n-th passes the
    /// threshold, and the ranking at the end decides.
    fn compact_exactly(&mut self) {
        let rows = self.survivors.iter().map(|&(_, row)| row);
        let best = rank(self.data, self.query.values, rows, self.n);
        if let Some(last) = best.last() {
            self.threshold = self.threshold.min(self.bound.shown(last.distance));
        }
        self.survivors.clear();
        let squared = |neighbor: &Neighbor| (neighbor.distance * neighbor.distance) as f32;
        self.survivors.extend(
            best.iter()
                .map(|neighbor| (squared(neighbor), neighbor.row)),
        );
    }

    fn into_survivors(mut self) -> Vec<(f32, u32)> {
        self.compact();
        self.survivors
    }
}

/// The vectorised part: tiles of rows, packed column by column, against every query.
struct Scan<'a, 'b> {
    data: &'a Matrix,
    rows: RowSet<'a>,
    queries: &'a mut [State<'b>],
}

impl WithSimd for Scan<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let mut tile = new_tile(self.data.n_features());
        let mut squared = [0.0f32; TILE_ROWS];
        let mut start = 0;
        while start < self.rows.len() {
            let count = TILE_ROWS.min(self.rows.len() - start);
            pack(self.data, self.rows, start, count, &mut tile);
            for query in self.queries.iter_mut() {
                let threshold = query.threshold;
                let mut runs =
                    squared_distances(simd, &tile, &query.values, threshold, &mut squared);
                while runs != 0 {
                    let from = runs.trailing_zeros() as usize * RUN_ROWS;
                    runs &= runs - 1;
                    let end = (from + RUN_ROWS).min(count);
                    for (at, &value) in squared.iter().enumerate().take(end).skip(from) {
                        if value <= query.threshold {
                            query.push(value, self.rows.row(start + at));
                        }
                    }
                }
            }
            start += count;
        }
    }
}
