//! Which samples the rows of a scan need.

use std::collections::VecDeque;

use super::align::{Pick, pick};
use super::mapping::{Column, Role};
use super::plan::Episode;
use super::track::Track;

/// Samples of a column that rows still need.
pub(super) struct Store {
    pub(super) column: usize,
    pub(super) samples: Window,
    /// For each rank one more than the last row that needs it; 0 if none does.
    pub(super) last_use: Vec<u32>,
}

/// One output column.
pub(super) struct Feed {
    /// Its place in the schema of the scan.
    pub(super) field: usize,
    pub(super) column: usize,
    pub(super) store: usize,
    pub(super) picks: Vec<Option<Pick>>,
    /// Rows from the first for which all samples are there.
    pub(super) ready: usize,
}

/// A sample that was read; `None` is a null.
pub(super) type Sample = Option<Vec<u8>>;

/// Samples by rank. Ranks that are held lie close together in recordings that are about in order.
#[derive(Default)]
pub(super) struct Window {
    first: usize,
    samples: VecDeque<Option<Sample>>,
}

impl Window {
    /// The sample of a rank, if it was read and not let go.
    pub(super) fn get(&self, rank: usize) -> Option<&Sample> {
        self.samples.get(rank.checked_sub(self.first)?)?.as_ref()
    }

    pub(super) fn insert(&mut self, rank: usize, sample: Sample) {
        if self.samples.is_empty() {
            self.first = rank;
        }
        while rank < self.first {
            self.samples.push_front(None);
            self.first -= 1;
        }
        let place = rank - self.first;
        if place >= self.samples.len() {
            self.samples.resize_with(place + 1, || None);
        }
        if let Some(slot) = self.samples.get_mut(place) {
            *slot = Some(sample);
        }
    }
}

impl Store {
    /// Lets go of the samples that no row from `end` on needs; gives their bytes.
    pub(super) fn release(&mut self, end: usize) -> usize {
        let window = &mut self.samples;
        let mut freed = 0;
        for (slot, rank) in window.samples.iter_mut().zip(window.first..) {
            let is_needed = self
                .last_use
                .get(rank)
                .is_some_and(|last| *last as usize > end);
            if !is_needed {
                freed += slot.take().flatten().map_or(0, |bytes| bytes.len());
            }
        }
        while window.samples.front().is_some_and(Option::is_none) {
            window.samples.pop_front();
            window.first += 1;
        }
        freed
    }

    /// Notes which samples the rows of a feed need.
    pub(super) fn need(&mut self, picks: &[Option<Pick>]) {
        for (row, pick) in picks.iter().enumerate() {
            for rank in pick.iter().flat_map(ranks) {
                if let Some(last) = self.last_use.get_mut(rank) {
                    *last = (*last).max(u32::try_from(row + 1).unwrap_or(u32::MAX));
                }
            }
        }
    }
}

/// The samples of a pick.
pub(super) fn ranks(pick: &Pick) -> impl Iterator<Item = usize> + use<> {
    std::iter::once(pick.first).chain(pick.second.map(|(second, _)| second))
}

/// Picks of a column for the rows of an episode; with `shift` those of the rows after.
pub(super) fn add_picks(
    episode: &Episode,
    (column, role, shift): (&Column, Role, usize),
    track: &Track,
    picks: &mut Vec<Option<Pick>>,
) {
    let range = track.range(episode.start, episode.end);
    let offset = range.start;
    let times = track.times.get(range).unwrap_or_default();
    let is_step = !matches!(role, Role::Observation | Role::Info);
    for row in 0..episode.rows.len() {
        let is_final = episode.has_final && row + 1 == episode.rows.len();
        let at = episode
            .rows
            .get(row + shift)
            .filter(|_| !(is_final && is_step));
        let found = at.and_then(|at| pick(times, *at, column.align, column.reach));
        picks.push(found.map(|pick| {
            Pick {
                first: pick.first + offset,
                second: pick
                    .second
                    .map(|(second, weight)| (second + offset, weight)),
            }
        }));
    }
}

/// Episode, step and time of each row of an episode.
pub(super) fn numbers(
    number: i64,
    episode: &Episode,
) -> impl Iterator<Item = (i64, i64, Option<i64>)> + '_ {
    let start = episode.rows.first().copied().unwrap_or(0);
    episode.rows.iter().zip(0i64..).map(move |(time, step)| {
        let place = usize::try_from(step).unwrap_or(usize::MAX);
        let recorded = episode
            .recorded
            .as_ref()
            .and_then(|recorded| recorded.get(place));
        match recorded {
            Some((step, t_ns)) => (number, *step, *t_ns),
            None => (number, step, time.checked_sub(start)),
        }
    })
}
