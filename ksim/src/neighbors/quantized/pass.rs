//! The first pass proper: many queries over the strips of one block.

use super::codes::{Block, GROUP, GROUP_BYTES, NO_ROW, STRIP_ROWS};
use super::lanes::{Lanes, Operation, PAIR_BYTES, VECTORS};
use super::query::Prepared;

/// Sign patterns of a pair of columns.
const SIGNS: usize = 4;

/// Queries that begin with the same groups of columns.
#[derive(Debug)]
struct Bucket {
    /// The groups, ascending.
    groups: Vec<u16>,
    /// End of its queries in the order of the batch.
    end: usize,
}

/// One pair of columns of one query.
#[derive(Debug, Clone, Copy)]
struct Step {
    /// Both magnitudes, twice.
    query: u32,
    /// Which rows to multiply them with: `4 · pair + signs`.
    place: u32,
}

/// A batch of queries, laid out for the pass: what it reads lies in the order it is read.
#[derive(Debug)]
pub(super) struct Batch {
    /// Queries by bucket: their numbers.
    pub(super) order: Vec<u32>,
    buckets: Vec<Bucket>,
    /// The sign patterns in use of each pair of columns, one bit each.
    patterns: Vec<u8>,
    /// The pairs of the first stage, query after query in `order`.
    first: Vec<Step>,
    /// All pairs likewise.
    all: Vec<Step>,
    /// Per place in `order`, the start of its pairs in `all`; and the end.
    all_starts: Vec<u32>,
    /// Per place in `order`: the limits of the two stages.
    pub(super) limits: Vec<[i16; 2]>,
}

impl Batch {
    /// Sorts the queries into buckets by their first groups, as many as `n_first` says.
    pub(super) fn new(queries: &[Prepared], n_first: &[usize], n_groups: usize) -> Self {
        let mut keyed: Vec<(Vec<u16>, u32)> = queries
            .iter()
            .zip(n_first)
            .zip(0..)
            .map(|((query, &n), number)| {
                let mut groups = query.groups[..n].to_vec();
                groups.sort_unstable();
                (groups, number)
            })
            .collect();
        keyed.sort_unstable();
        let mut buckets: Vec<Bucket> = Vec::new();
        let mut order = Vec::with_capacity(queries.len());
        for (groups, number) in keyed {
            order.push(number);
            match buckets.last_mut() {
                Some(bucket) if bucket.groups == groups => bucket.end = order.len(),
                _ => buckets.push(Bucket {
                    groups,
                    end: order.len(),
                }),
            }
        }
        let mut patterns = vec![0; 2 * n_groups];
        for query in queries {
            for (at, &signs) in query.signs.iter().enumerate() {
                patterns[2 * usize::from(query.groups[at / 2]) + at % 2] |= 1 << signs;
            }
        }
        let mut batch = Self {
            limits: vec![[i16::MIN; 2]; order.len()],
            first: Vec::new(),
            all: Vec::new(),
            all_starts: Vec::with_capacity(order.len() + 1),
            order,
            buckets,
            patterns,
        };
        for &number in &batch.order {
            let query = &queries[number as usize];
            let steps = query.pairs.iter().zip(&query.signs).enumerate();
            let steps = steps.map(|(at, (&pair, &signs))| Step {
                query: pair,
                place: (2 * u32::from(query.groups[at / 2]) + (at % 2) as u32) * SIGNS as u32
                    + u32::from(signs),
            });
            batch.all_starts.push(batch.all.len() as u32);
            batch.all.extend(steps.clone());
            batch.first.extend(steps.take(2 * n_first[number as usize]));
        }
        batch.all_starts.push(batch.all.len() as u32);
        batch
    }

    /// Groups in the first stage of the query at a place of `order`.
    pub(super) fn first_groups(&self) -> impl Iterator<Item = usize> {
        let mut start = 0;
        self.buckets.iter().flat_map(move |bucket| {
            let n = bucket.end - start;
            start = bucket.end;
            std::iter::repeat_n(bucket.groups.len(), n)
        })
    }
}

/// Finds the rows of a block that may lie within the limits of each query.
pub(super) struct Sweep<'a> {
    pub(super) block: Block<'a>,
    pub(super) batch: &'a Batch,
    pub(super) buffers: &'a mut Buffers,
    /// Per place in the batch's order.
    pub(super) candidates: &'a mut [Vec<u32>],
}

/// Room for a tile, kept between blocks.
#[derive(Debug, Default)]
pub(super) struct Buffers {
    /// `[pair of columns][signs][row][column of the pair]`.
    codes: Vec<i8>,
    /// `[group][row]`: −Σk²/2, rounded up.
    norms: Vec<i16>,
    /// The norms of all groups together.
    totals: Vec<i16>,
    /// Place in the batch's order, and which vectors need the second stage.
    hits: Vec<(u32, u32)>,
}

impl Operation for Sweep<'_> {
    type Output = ();

    #[inline(always)]
    fn with<L: Lanes>(self, lanes: L) {
        let n_groups = self.batch.patterns.len() / 2;
        let rows_of_tile = VECTORS * L::LANES;
        let buffers = self.buffers;
        buffers
            .codes
            .resize(2 * n_groups * SIGNS * 2 * rows_of_tile, 0);
        buffers.norms.resize(n_groups * rows_of_tile, 0);
        buffers.totals.resize(rows_of_tile, 0);
        buffers.hits.resize(self.batch.order.len() + 1, (0, 0));
        let strip_bytes = n_groups * GROUP_BYTES;
        let tile_bytes = strip_bytes * rows_of_tile / STRIP_ROWS;
        for (tile, strips) in self.block.strips.chunks(tile_bytes).enumerate() {
            fill(lanes, strips, strip_bytes, &self.batch.patterns, buffers);
            let n_hits = first_stage(lanes, self.batch, buffers);
            for hit in 0..n_hits {
                let (at, flags) = buffers.hits[hit];
                second_stage(lanes, self.batch, buffers, at as usize, flags, |row| {
                    let row = tile * rows_of_tile + row;
                    if let Some(&row) = self.block.rows.get(row).filter(|row| **row != NO_ROW) {
                        self.candidates[at as usize].push(row);
                    }
                });
            }
        }
    }
}

/// Copies the strips of one tile to where vectors of any width find them, in the signs in use.
#[inline(always)]
fn fill<L: Lanes>(
    lanes: L,
    strips: &[i8],
    strip_bytes: usize,
    patterns: &[u8],
    buffers: &mut Buffers,
) {
    let rows_of_tile = VECTORS * L::LANES;
    let pair_bytes = 2 * rows_of_tile;
    let n_strips = strips.len() / strip_bytes;
    for (pair, out) in buffers
        .codes
        .chunks_exact_mut(SIGNS * pair_bytes)
        .enumerate()
    {
        if patterns[pair] == 0 {
            continue;
        }
        for (signs, out) in out.chunks_exact_mut(pair_bytes).enumerate() {
            if patterns[pair] & (1 << signs) == 0 {
                continue;
            }
            let flips = [0, 0x00FF_00FF, 0xFF00_FF00, u32::MAX][signs];
            let (out, beyond) = out.split_at_mut(n_strips * PAIR_BYTES);
            let out = out.as_chunks_mut::<PAIR_BYTES>().0;
            for (out, strip) in out.iter_mut().zip(strips.chunks_exact(strip_bytes)) {
                lanes.flip(&strip.as_chunks().0[pair], flips, out);
            }
            beyond.fill(0);
        }
    }
    for (group, out) in buffers.norms.chunks_exact_mut(rows_of_tile).enumerate() {
        let (out, beyond) = out.split_at_mut(n_strips * STRIP_ROWS);
        let out = out.as_chunks_mut::<STRIP_ROWS>().0;
        for (out, strip) in out.iter_mut().zip(strips.chunks_exact(strip_bytes)) {
            lanes.norms(&strip.as_chunks().0.as_chunks().0[group], out);
        }
        // No row stands there: as far as can be.
        beyond.fill(i16::MIN);
    }
    buffers.totals.fill(0);
    for norms in buffers.norms.chunks_exact(rows_of_tile) {
        for (total, norm) in buffers.totals.iter_mut().zip(norms) {
            *total = total.saturating_add(*norm);
        }
    }
}

/// Every query's first groups; returns how many hits there are.
#[inline(always)]
fn first_stage<L: Lanes>(lanes: L, batch: &Batch, buffers: &mut Buffers) -> usize {
    let rows_of_tile = VECTORS * L::LANES;
    let pair_bytes = 2 * rows_of_tile;
    let (mut n_hits, mut from) = (0, 0);
    let mut steps = batch.first.as_slice();
    for bucket in &batch.buckets {
        let mut start = [lanes.splat(0); VECTORS];
        for &group in &bucket.groups {
            let norms = &buffers.norms[usize::from(group) * rows_of_tile..][..rows_of_tile];
            for (start, norms) in start.iter_mut().zip(norms.chunks_exact(L::LANES)) {
                *start = lanes.add(*start, lanes.load(norms));
            }
        }
        let n_steps = 2 * bucket.groups.len();
        let queries = from..bucket.end;
        let (of_bucket, rest) = steps.split_at(n_steps * queries.len());
        steps = rest;
        for (at, steps) in queries.zip(of_bucket.chunks_exact(n_steps)) {
            let mut sums = start;
            for step in steps {
                let place = step.place as usize * pair_bytes;
                lanes.dots(
                    &mut sums,
                    step.query,
                    &buffers.codes[place..place + pair_bytes],
                );
            }
            let flags = lanes.any_at_least(&sums, lanes.splat(batch.limits[at][0]));
            // Without a branch to guess wrong.
            buffers.hits[n_hits] = (at as u32, flags);
            n_hits += usize::from(flags != 0);
        }
        from = bucket.end;
    }
    n_hits
}

/// All groups of one query, for the vectors that the first stage left; calls `found` with the
/// rows of the tile that remain.
#[inline(always)]
fn second_stage<L: Lanes>(
    lanes: L,
    batch: &Batch,
    buffers: &Buffers,
    at: usize,
    flags: u32,
    mut found: impl FnMut(usize),
) {
    let rows_of_tile = VECTORS * L::LANES;
    let pair_bytes = 2 * rows_of_tile;
    let steps = &batch.all[batch.all_starts[at] as usize..batch.all_starts[at + 1] as usize];
    let uses_all = steps.len() == batch.patterns.len();
    let limit = lanes.splat(batch.limits[at][1]);
    let mut vectors = (flags | flags >> 1) & 0x5555;
    while vectors != 0 {
        let vector = vectors.trailing_zeros() as usize / 2;
        vectors &= vectors - 1;
        let lanes_of_vector = vector * L::LANES..(vector + 1) * L::LANES;
        let mut sum = if uses_all {
            lanes.load(&buffers.totals[lanes_of_vector])
        } else {
            let groups = steps.iter().step_by(GROUP / 2);
            groups.fold(lanes.splat(0), |sum, step| {
                let group = step.place as usize / (SIGNS * GROUP / 2) * rows_of_tile;
                lanes.add(
                    sum,
                    lanes.load(&buffers.norms[group..][lanes_of_vector.clone()]),
                )
            })
        };
        let codes = &buffers.codes[vector * 2 * L::LANES..];
        for step in steps {
            sum = lanes.dot(sum, step.query, &codes[step.place as usize * pair_bytes..]);
        }
        let mut rows = lanes.at_least(sum, limit);
        while rows != 0 {
            found(vector * L::LANES + rows.trailing_zeros() as usize);
            rows &= rows - 1;
        }
    }
}
