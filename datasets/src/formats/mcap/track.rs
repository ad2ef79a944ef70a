//! When the messages of a topic were, and which is which.

use std::ops::Range;

/// The messages of one topic of one file in the order of the mapping's clock.
///
/// The order is ascending time, and that of the file where times are equal. Memory: 8 bytes a message, and 4 more
/// if the file is not in order.
#[derive(Debug, Clone, Default)]
pub(crate) struct Track {
    /// Ascending, in ns.
    pub(crate) times: Vec<i64>,
    /// Place in `times` of each message in file order; `None` if that is the same.
    ranks: Option<Vec<u32>>,
}

/// Stands for a message that has no time.
const NO_RANK: u32 = u32::MAX;

impl Track {
    /// Sorts times, which are in file order; `None` is a message without a time.
    pub(crate) fn new(times: Vec<Option<i64>>) -> Self {
        let is_sorted = times.iter().all(Option::is_some) && times.is_sorted();
        if is_sorted {
            let times = times.into_iter().flatten().collect();
            return Self { times, ranks: None };
        }
        let mut order: Vec<(i64, usize)> = times
            .iter()
            .enumerate()
            .filter_map(|(place, time)| Some(((*time)?, place)))
            .collect();
        order.sort_unstable();
        let mut ranks = vec![NO_RANK; times.len()];
        for (rank, (_, place)) in order.iter().enumerate() {
            if let Some(slot) = ranks.get_mut(*place) {
                *slot = u32::try_from(rank).unwrap_or(NO_RANK);
            }
        }
        Self {
            times: order.into_iter().map(|(time, _)| time).collect(),
            ranks: Some(ranks),
        }
    }

    /// Place in [`Self::times`] of a message by its place in the file.
    pub(crate) fn rank(&self, in_file: usize) -> Option<usize> {
        match &self.ranks {
            None => (in_file < self.times.len()).then_some(in_file),
            Some(ranks) => {
                let rank = ranks.get(in_file).filter(|rank| **rank != NO_RANK)?;
                usize::try_from(*rank).ok()
            }
        }
    }

    /// The messages from `start` to `end`, both included.
    pub(crate) fn range(&self, start: i64, end: i64) -> Range<usize> {
        let first = self.times.partition_point(|&time| time < start);
        let after = self.times.partition_point(|&time| time <= end);
        first..after.max(first)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_times_keep_the_order_of_the_file() {
        let track = Track::new(vec![Some(5), Some(3), None, Some(5), Some(1)]);
        assert_eq!(track.times, [1, 3, 5, 5]);
        let ranks: Vec<_> = (0..6).map(|place| track.rank(place)).collect();
        assert_eq!(ranks, [Some(2), Some(1), None, Some(3), Some(0), None]);
        assert_eq!(track.range(3, 5), 1..4);
        assert_eq!(track.range(6, 9), 4..4);
        assert_eq!(track.range(4, 2), 2..2);
    }
}
