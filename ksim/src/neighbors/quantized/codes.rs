//! Rows rounded to bytes, in the order and the layout that the first pass reads.

use std::fmt::{self, Debug};
use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::scale::{LARGEST, Scale};
use crate::buffer::Shared;
use crate::matrix::{CHUNK_ROWS, Matrix};

/// Rows that lie together, column by column.
pub(crate) const STRIP_ROWS: usize = 16;

/// Columns whose codes of one strip fill a cache line.
pub(super) const GROUP: usize = 4;

/// Bytes of one group in one strip.
pub(super) const GROUP_BYTES: usize = GROUP * STRIP_ROWS;

/// Strips in a block, at most: 4096 rows.
const BLOCK_STRIPS: usize = 256;

/// No row: fills the last strip of a block.
pub(crate) const NO_ROW: u32 = u32::MAX;

/// One row in so many is part of the sample that a search starts with.
pub(super) const SAMPLED: usize = 16;

/// Segments of at least so many rows have a sample; of [`TWICE`], also a sample of the sample.
const ONCE: usize = 1 << 11;
const TWICE: usize = 1 << 16;

/// The rounded rows of a matrix, all of them once.
///
/// Rows come in segments (one for all rows, or one per cluster); a segment in three levels: a
/// sample of its sample, the rest of its sample, the rest; a level in blocks of at most 4096 rows,
/// where those beyond the grid have blocks of their own; a block in strips of 16 rows. All of it
/// is plain flat arrays.
#[derive(Clone)]
pub(crate) struct Codes {
    pub(crate) scale: Scale,
    /// `[strip][group of 4 columns][pair of columns][row of the strip][column of the pair]`.
    pub(crate) strips: Shared<i8>,
    /// The row of the matrix at every place, 16 a strip; [`NO_ROW`] where there is none.
    pub(crate) order: Shared<u32>,
    /// First strip of every block, and the end.
    pub(crate) block_starts: Vec<u32>,
    /// Per block, at least the distance of any of its rows, clipped to the grid, from its codes.
    pub(crate) block_errors: Vec<f64>,
    /// Whether the rows of a block lie beyond the grid.
    pub(crate) block_clipped: Vec<bool>,
    /// First block of each of the three levels of every segment, and the end.
    pub(crate) levels: Vec<u32>,
}

impl Debug for Codes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Codes")
            .field("n_blocks", &self.block_errors.len())
            .field("n_segments", &(self.levels.len() / LEVELS))
            .finish_non_exhaustive()
    }
}

pub(super) const LEVELS: usize = 3;

/// One block, borrowed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block<'a> {
    pub(super) strips: &'a [i8],
    pub(super) rows: &'a [u32],
    pub(super) error: f64,
    pub(super) clipped: bool,
}

impl Codes {
    /// Rounds `data`, the rows of every segment in the order given.
    pub(crate) fn new(data: &Matrix, segments: &[&[u32]]) -> Self {
        let scale = Scale::measure(data);
        let beyond = rows_beyond(data, &scale);
        let mut plan = Plan::default();
        for rows in segments {
            for level in split(rows) {
                plan.levels.push(plan.clipped.len() as u32);
                for clipped in [false, true] {
                    let rows = level.iter().copied();
                    let rows: Vec<u32> = rows
                        .filter(|&row| beyond[row as usize] == clipped)
                        .collect();
                    plan.add(&rows, clipped);
                }
            }
        }
        plan.levels.push(plan.clipped.len() as u32);
        plan.starts.push((plan.order.len() / STRIP_ROWS) as u32);
        let strip_bytes = data.n_features().div_ceil(GROUP) * GROUP_BYTES;
        let mut strips = vec![0i8; plan.order.len() / STRIP_ROWS * strip_bytes];
        let mut parts = Vec::with_capacity(plan.clipped.len());
        let mut left = strips.as_mut_slice();
        for block in plan.starts.windows(2) {
            let n_strips = (block[1] - block[0]) as usize;
            let (part, rest) = left.split_at_mut(n_strips * strip_bytes);
            parts.push((
                &plan.order[block[0] as usize * STRIP_ROWS..][..n_strips * STRIP_ROWS],
                part,
            ));
            left = rest;
        }
        let block_errors = parts
            .into_par_iter()
            .map(|(rows, strips)| encode(data, &scale, rows, strips))
            .collect();
        Self {
            scale,
            strips: Arc::new(strips),
            order: Arc::new(plan.order),
            block_starts: plan.starts,
            block_errors,
            block_clipped: plan.clipped,
            levels: plan.levels,
        }
    }

    pub(super) fn n_groups(&self) -> usize {
        self.scale.center.len().div_ceil(GROUP)
    }

    /// The blocks of one level of a segment; level 0 is searched first.
    pub(super) fn level(&self, segment: usize, level: usize) -> Range<usize> {
        let at = segment * LEVELS + level;
        self.levels[at] as usize..self.levels[at + 1] as usize
    }

    /// All blocks of a segment.
    pub(crate) fn segment(&self, segment: usize) -> Range<usize> {
        self.level(segment, 0).start..self.level(segment, LEVELS - 1).end
    }

    pub(super) fn block(&self, block: usize) -> Block<'_> {
        let strips = self.block_starts[block] as usize..self.block_starts[block + 1] as usize;
        let bytes = self.n_groups() * GROUP_BYTES;
        Block {
            strips: &(*self.strips).as_ref()[strips.start * bytes..strips.end * bytes],
            rows: &(*self.order).as_ref()[strips.start * STRIP_ROWS..strips.end * STRIP_ROWS],
            error: self.block_errors[block],
            clipped: self.block_clipped[block],
        }
    }

    /// The rows of some blocks, in their order.
    pub(crate) fn rows(&self, blocks: Range<usize>) -> Vec<u32> {
        blocks
            .flat_map(|block| self.block(block).rows)
            .copied()
            .filter(|&row| row != NO_ROW)
            .collect()
    }
}

/// Where every row will stand.
#[derive(Default)]
struct Plan {
    order: Vec<u32>,
    starts: Vec<u32>,
    clipped: Vec<bool>,
    levels: Vec<u32>,
}

impl Plan {
    fn add(&mut self, rows: &[u32], clipped: bool) {
        for block in rows.chunks(BLOCK_STRIPS * STRIP_ROWS) {
            self.starts.push((self.order.len() / STRIP_ROWS) as u32);
            self.clipped.push(clipped);
            self.order.extend_from_slice(block);
            let whole = self.order.len().next_multiple_of(STRIP_ROWS);
            self.order.resize(whole, NO_ROW);
        }
    }
}

/// Whether some value of a row lies beyond the grid.
fn rows_beyond(data: &Matrix, scale: &Scale) -> Vec<bool> {
    let limit = scale.limit();
    let mut beyond = vec![false; data.n_rows()];
    beyond
        .par_chunks_mut(CHUNK_ROWS)
        .enumerate()
        .for_each(|(chunk, beyond)| {
            let mut values = vec![0.0; data.n_features()];
            for (at, beyond) in beyond.iter_mut().enumerate() {
                data.read_row(chunk * CHUNK_ROWS + at, &mut values);
                *beyond = values
                    .iter()
                    .zip(&scale.center)
                    .fold(false, |beyond, (v, c)| beyond | ((v - c).abs() > limit));
            }
        });
    beyond
}

/// The three levels of a segment. A sampled row stands at an irregular place among its neighbors,
/// so that no period of the data hides from the sample.
fn split(rows: &[u32]) -> [Vec<u32>; LEVELS] {
    let mut levels = [Vec::new(), Vec::new(), Vec::new()];
    if rows.len() < ONCE {
        levels[0].extend_from_slice(rows);
        return levels;
    }
    let n_rows = rows.len();
    for (run, rows) in rows.chunks(SAMPLED).enumerate() {
        let chosen = scatter(run as u64) as usize % SAMPLED;
        let first = n_rows < TWICE
            || scatter((run / SAMPLED) as u64 + (1 << 40)) as usize % SAMPLED == run % SAMPLED;
        for (at, &row) in rows.iter().enumerate() {
            let level = if at == chosen { usize::from(!first) } else { 2 };
            levels[level].push(row);
        }
    }
    levels
}

/// The finalizer of SplitMix64 (Steele et al. 2014).
fn scatter(value: u64) -> u64 {
    let mut z = value.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Fills the strips of one block; returns its error.
fn encode(data: &Matrix, scale: &Scale, rows: &[u32], strips: &mut [i8]) -> f64 {
    /// Adding and subtracting it rounds to an integer, whatever the instruction set.
    const ROUND: f64 = 1.5 * (1u64 << 52) as f64;
    let (limit, inverse) = (scale.limit(), 1.0 / scale.step);
    let strip_bytes = strips.len() / (rows.len() / STRIP_ROWS);
    let mut values = vec![0.0; data.n_features()];
    let mut most = 0.0f64;
    for (strip, rows) in strips
        .chunks_exact_mut(strip_bytes)
        .zip(rows.chunks_exact(STRIP_ROWS))
    {
        for (lane, &row) in rows.iter().enumerate().filter(|(_, row)| **row != NO_ROW) {
            data.read_row(row as usize, &mut values);
            let mut squared = 0.0;
            for (column, (value, center)) in values.iter().zip(&scale.center).enumerate() {
                let value = (value - center).clamp(-limit, limit);
                let code = ((value * inverse + ROUND) - ROUND).clamp(-LARGEST, LARGEST);
                squared += (value - code * scale.step).powi(2);
                strip[place(column, lane)] = code as i8;
            }
            most = most.max(squared);
        }
    }
    // Up to the next eighth of a step: blocks of equal error share their thresholds.
    let error = most.sqrt() * (1.0 + 1e-9);
    let eighth = scale.step / 8.0;
    ((error / eighth).ceil() * eighth).max(error)
}

/// Where a code stands in its strip.
fn place(column: usize, lane: usize) -> usize {
    (column / 2 * STRIP_ROWS + lane) * 2 + column % 2
}
