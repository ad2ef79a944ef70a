//! The first pass for a query on its own: straight over the strips, since a tile laid out for many
//! queries costs more than one query does.

use super::codes::{Block, NO_ROW, STRIP_ROWS};
use super::lanes::{Lanes, Operation, PAIR_BYTES, StripStep};
use super::query::Prepared;
use crate::prefetch::prefetch;

/// So many queries are asked one by one. More are cheaper together.
pub(super) const FEW_QUERIES: usize = 3;

/// A query laid out for the pass.
#[derive(Debug)]
pub(super) struct Alone {
    /// The most telling pairs of columns, in the order of the strip.
    first: Vec<StripStep>,
    /// All pairs likewise.
    all: Vec<StripStep>,
}

/// How many strips ahead of its use memory is asked for: it answers in about the time that the
/// strips between take.
const AHEAD: usize = 8;

impl Alone {
    pub(super) fn new(query: &Prepared, n_first_groups: usize) -> Self {
        let pairs = query.pairs.iter().zip(&query.signs).enumerate();
        let steps = pairs.map(|(at, (&magnitudes, &negative))| {
            let pair = 2 * usize::from(query.groups[at / 2]) + at % 2;
            StripStep::new(pair, magnitudes, negative)
        });
        let all: Vec<StripStep> = steps.collect();
        let in_order = |mut steps: Vec<StripStep>| {
            steps.sort_unstable_by_key(|step| step.pair);
            steps
        };
        Self {
            first: in_order(all[..2 * n_first_groups].to_vec()),
            all: in_order(all),
        }
    }
}

/// Finds the rows of a block that may lie within the limits of one query.
pub(super) struct SweepAlone<'a> {
    pub(super) block: Block<'a>,
    pub(super) query: &'a Alone,
    /// Limits of the two stages.
    pub(super) limits: [i16; 2],
    pub(super) candidates: &'a mut Vec<u32>,
}

impl Operation for SweepAlone<'_> {
    type Output = ();

    #[inline(always)]
    fn with<L: Lanes>(self, lanes: L) {
        let Self { block, query, .. } = self;
        let n_strips = block.rows.len() / STRIP_ROWS;
        let strip_pairs = block.strips.len() / PAIR_BYTES / n_strips.max(1);
        let strips = block.strips.as_chunks::<PAIR_BYTES>().0;
        let numbered = strips.chunks_exact(strip_pairs).enumerate();
        for ((number, strip), rows) in numbered.zip(block.rows.chunks_exact(STRIP_ROWS)) {
            // A group of two pairs is a cache line.
            for step in query.first.iter().step_by(2) {
                prefetch(strips, (number + AHEAD) * strip_pairs + step.pair);
            }
            if lanes.strip_at_least(strip, &query.first, self.limits[0]) == 0 {
                continue;
            }
            let mut passed = lanes.strip_at_least(strip, &query.all, self.limits[1]);
            while passed != 0 {
                let row = rows[passed.trailing_zeros() as usize];
                if row != NO_ROW {
                    self.candidates.push(row);
                }
                passed &= passed - 1;
            }
        }
    }
}
