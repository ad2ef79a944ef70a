//! The first pass of `blocked` and `clusters`: sums of products of bytes, with a bound on what
//! rounding can do, so that only rows that can matter are ranked in f64.
//!
//! # Bound
//! Rows and queries are moved by a center, clipped to a cube and rounded to a grid of step s. Let x
//! be a row so moved, x̃ clipped, s·k rounded, and q, q̃, s·p the same of a query; E ≥ ‖x̃ − s·k‖ for
//! every row of a block, e = ‖q̃ − s·p‖. Suppose ‖x − q‖ ≤ τ.
//! Clipping projects onto a convex set, which brings no two points farther apart: ‖x̃ − q̃‖ ≤ τ. If x
//! lies within the cube itself, x̃ = x, and the angle at q̃ between q and x is not acute, so
//! ‖x − q̃‖² ≤ τ² − ‖q − q̃‖². Call the right-hand side r² (τ² for a block beyond the cube). Then
//! s‖k − p‖ ≤ r + e + E, that is, Σ(k − p)² ≤ T = ((r + e + E)/s)²; and so for the sum over any subset
//! of the columns. With Σ(k − p)² = Σp² − 2v, v = Σ(k·p − k²/2), a row that can matter has
//! v ≥ (Σp² − T)/2 over any subset.
//!
//! v is summed in 16 bits, saturating. It never saturates upwards: column by column
//! k·p − k²/2 ≤ p²/2, the −k²/2 are added first, and the subset is chosen so that Σp² ≤ 4 · 127². Where
//! it saturates downwards, it is too large afterwards, and a row is looked at for nothing. The same
//! holds where k²/2 is rounded down, for two columns at a time. e, E, r and T are computed in f64
//! and rounded up by more than that arithmetic can lose.
//!
//! # Search
//! Rows come in three levels, see [`Codes`]. In the smallest, one row in 256, an f32 pass finds the
//! m nearest; their distance is the first threshold for the next, one row in 16, and so gives
//! the m nearest of all sampled rows. If the sample is fair, Poisson's law says how many of the
//! sampled are among the n nearest: n/16 on average, and m is so large that they hardly ever are as
//! many. So the distance of the m-th is a threshold for the rest that is close to the final one,
//! far closer than the neighbors of the step before or those in the nearest blocks. It is a
//! guess: where fewer than n rows turn up within it (some 4 % of the queries), the search is made
//! again with a wider one, and the answer is exact in any case.
//!
//! Each query looks at those groups of columns first that tell most: its own largest deviations,
//! as many as it takes to expect rejection. Queries that begin with the same groups form a bucket,
//! share the −k²/2 of these, and pass over a tile of rows while it is in the first-level cache. A
//! query on its own reads the rows as they lie in memory, which is what it then waits for.

mod alone;
mod codes;
mod lanes;
mod pass;
mod query;
mod saved;
mod scale;

use std::ops::Range;

use rayon::prelude::*;

pub(crate) use codes::Codes;
pub use lanes::Simd;
pub use saved::RoundedRows;

use self::alone::{Alone, FEW_QUERIES, SweepAlone};
use self::codes::SAMPLED;
use self::pass::{Batch, Buffers, Sweep};
use self::query::Prepared;
use super::Neighbor;
use super::best::Best;
use super::scan::{self, Query};
use crate::matrix::Matrix;
use crate::tiles::RowSet;

/// Queries that travel together, at most.
pub(super) const BATCH_QUERIES: usize = 1024;

/// How much wider a guess is made that was too narrow, squared; and how often.
const WIDER: f64 = 1.3;
const ATTEMPTS: usize = 3;

/// What a search in rounded rows needs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Searcher<'a> {
    pub(super) data: &'a Matrix,
    pub(super) codes: &'a Codes,
    pub(super) max_norm: f64,
    pub(super) simd: Simd,
    /// Parts that the blocks of a level are shared out to.
    pub(super) parts: usize,
}

impl Searcher<'_> {
    /// The `n` nearest rows of a segment for each query.
    pub(super) fn nearest(
        &self,
        segment: usize,
        queries: &[Query<'_>],
        n: usize,
    ) -> Vec<Vec<Neighbor>> {
        let first = self.codes.rows(self.codes.level(segment, 0));
        let rest = self.codes.level(segment, 0).end..self.codes.segment(segment).end;
        let sampled = sample_neighbors(n);
        if rest.is_empty() || sampled.max(n / 4) > first.len() {
            let rows = self.codes.rows(self.codes.segment(segment));
            return scan::nearest(self.data, RowSet::Listed(&rows), queries, n, self.max_norm);
        }
        let prepared: Vec<Prepared> = queries
            .iter()
            .map(|query| Prepared::new(query.values, &self.codes.scale))
            .collect();
        let nearest = scan::nearest(
            self.data,
            RowSet::Listed(&first),
            queries,
            sampled,
            self.max_norm,
        );
        let mut best: Vec<Best> = nearest
            .into_iter()
            .zip(queries)
            .map(|(nearest, query)| {
                let mut best = Best::new(sampled, f64::INFINITY);
                for neighbor in nearest {
                    let row = neighbor.row as usize;
                    best.push(self.data.squared_distance(row, query.values), neighbor.row);
                }
                best.tighten();
                best
            })
            .collect();
        self.sweep(self.codes.level(segment, 1), queries, &prepared, &mut best);
        // From here on the threshold is a guess, unless as many were wanted of the sample.
        let guesses: Vec<f64> = best.iter().map(|best| best.squared).collect();
        best.iter_mut().for_each(|best| best.want(n));
        self.sweep(self.codes.level(segment, 2), queries, &prepared, &mut best);
        let mut short: Vec<usize> = (0..queries.len())
            .filter(|&query| {
                sampled < n && !(best[query].len() >= n && best[query].squared < guesses[query])
            })
            .collect();
        // Without a guess every row was looked at: where there are too few, there are no more.
        short.retain(|&query| guesses[query] < f64::INFINITY);
        let mut wider = 1.0;
        for attempt in 1..=ATTEMPTS {
            if short.is_empty() {
                break;
            }
            wider *= WIDER;
            let limit = |query: usize| {
                if attempt == ATTEMPTS {
                    f64::INFINITY
                } else {
                    guesses[query] * wider
                }
            };
            let again: Vec<Query<'_>> = short.iter().map(|&query| queries[query].clone()).collect();
            let prepared: Vec<Prepared> = again
                .iter()
                .map(|query| Prepared::new(query.values, &self.codes.scale))
                .collect();
            let mut found: Vec<Best> = short
                .iter()
                .map(|&query| Best::new(n, limit(query)))
                .collect();
            self.sweep(self.codes.segment(segment), &again, &prepared, &mut found);
            let enough: Vec<bool> = found.iter().map(|found| found.len() >= n).collect();
            for (&query, found) in short.iter().zip(found) {
                best[query] = found;
            }
            short = short
                .iter()
                .zip(enough)
                .filter(|(_, enough)| !enough)
                .map(|(&query, _)| query)
                .collect();
        }
        best.into_iter().map(Best::into_neighbors).collect()
    }

    /// Takes the rows of some blocks into account.
    fn sweep(
        &self,
        blocks: Range<usize>,
        queries: &[Query<'_>],
        prepared: &[Prepared],
        best: &mut [Best],
    ) {
        if blocks.is_empty() || queries.is_empty() {
            return;
        }
        let n_first: Vec<usize> = prepared
            .iter()
            .zip(&*best)
            .map(|(query, best)| {
                let block = self.codes.block(blocks.start);
                query.first_groups(query.reach(
                    best.squared,
                    block.error,
                    block.clipped,
                    self.codes.scale.step,
                ))
            })
            .collect();
        let part = blocks.len().div_ceil(self.parts).max(1);
        let sweep = |blocks: Range<usize>, best: &mut [Best]| {
            if queries.len() > FEW_QUERIES {
                let batch = Batch::new(prepared, &n_first, self.codes.n_groups());
                self.sweep_part(blocks, queries, prepared, batch, best);
                return;
            }
            for (at, best) in best.iter_mut().enumerate() {
                self.sweep_alone(
                    blocks.clone(),
                    &queries[at],
                    (&prepared[at], n_first[at]),
                    best,
                );
            }
        };
        if part >= blocks.len() {
            sweep(blocks, best);
            return;
        }
        let parts: Vec<Range<usize>> = blocks
            .clone()
            .step_by(part)
            .map(|start| start..(start + part).min(blocks.end))
            .collect();
        let found: Vec<Vec<Best>> = parts
            .into_par_iter()
            .map(|blocks| {
                let mut best: Vec<Best> = best.iter().map(Best::empty).collect();
                sweep(blocks, &mut best);
                best
            })
            .collect();
        for found in found {
            best.iter_mut()
                .zip(found)
                .for_each(|(best, found)| best.merge(found));
        }
        best.iter_mut().for_each(Best::tighten);
    }

    /// One query over some blocks; of its columns it looks at so many groups first.
    fn sweep_alone(
        &self,
        blocks: Range<usize>,
        query: &Query<'_>,
        (prepared, n_first): (&Prepared, usize),
        best: &mut Best,
    ) {
        let alone = Alone::new(prepared, n_first);
        let mut candidates = Vec::new();
        for block in blocks {
            let block = self.codes.block(block);
            let reach = prepared.reach(
                best.squared,
                block.error,
                block.clipped,
                self.codes.scale.step,
            );
            self.simd.run(SweepAlone {
                block,
                query: &alone,
                limits: [
                    prepared.limit(n_first, reach),
                    prepared.limit(prepared.groups.len(), reach),
                ],
                candidates: &mut candidates,
            });
            self.take(&mut candidates, query, best);
        }
    }

    /// Ranks what the first pass left of a block.
    fn take(&self, candidates: &mut Vec<u32>, query: &Query<'_>, best: &mut Best) {
        candidates.retain(|row| !query.excluded.contains(&(*row as usize)));
        let rows = candidates.iter().copied();
        self.data
            .each_squared_distance(rows, query.values, |at, squared| {
                best.push(squared, candidates[at]);
            });
        candidates.clear();
        best.tighten();
    }

    fn sweep_part(
        &self,
        blocks: Range<usize>,
        queries: &[Query<'_>],
        prepared: &[Prepared],
        mut batch: Batch,
        best: &mut [Best],
    ) {
        let mut buffers = Buffers::default();
        let mut candidates: Vec<Vec<u32>> = vec![Vec::new(); queries.len()];
        let n_first: Vec<usize> = batch.first_groups().collect();
        let mut known: Vec<f64> = vec![f64::NAN; queries.len()];
        let mut of_block = (f64::NAN, false);
        for block in blocks {
            let block = self.codes.block(block);
            let same = of_block == (block.error, block.clipped);
            of_block = (block.error, block.clipped);
            for (at, &number) in batch.order.iter().enumerate() {
                let (query, best) = (&prepared[number as usize], &best[number as usize]);
                if same && known[at] == best.squared {
                    continue;
                }
                known[at] = best.squared;
                let reach = query.reach(
                    best.squared,
                    block.error,
                    block.clipped,
                    self.codes.scale.step,
                );
                batch.limits[at] = [
                    query.limit(n_first[at], reach),
                    query.limit(query.groups.len(), reach),
                ];
            }
            self.simd.run(Sweep {
                block,
                batch: &batch,
                buffers: &mut buffers,
                candidates: &mut candidates,
            });
            for (candidates, &number) in candidates.iter_mut().zip(&batch.order) {
                if candidates.is_empty() {
                    continue;
                }
                let (query, best) = (&queries[number as usize], &mut best[number as usize]);
                self.take(candidates, query, best);
            }
        }
    }
}

/// How many neighbors to look for in the sample: more of the `n` nearest than it is likely to
/// hold.
fn sample_neighbors(n: usize) -> usize {
    let share = n as f64 / SAMPLED as f64;
    ((share + 2.0 * share.sqrt()).ceil() as usize).clamp(1, n)
}
