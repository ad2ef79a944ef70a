//! Numbers of episodes and steps.

use std::collections::BTreeSet;

use super::drive::{Check, Episode};
use super::facts::Facts;
use super::report::{Finding, Findings, Place, Tally};
use super::rows::Segment;

#[derive(Default)]
struct Numbers {
    seen: BTreeSet<i64>,
    twice: Tally,
    gaps: Tally,
    backwards: Tally,
    last: Option<i64>,
    step_gaps: Tally,
    late_starts: Tally,
}

pub(super) fn check(_facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    Some(Box::new(Numbers::default()))
}

impl Check for Numbers {
    fn name(&self) -> &'static str {
        "numbers"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        let first = segment.rows().start;
        if !segment.continues && segment.step(first) != 0 {
            self.late_starts.add(|| segment.place(first));
        }
        for (before, row) in segment.pairs() {
            // Wrapping, as a column of a foreign file may hold anything.
            if segment.step(row).wrapping_sub(segment.step(before)) != 1 {
                self.step_gaps.add(|| segment.place(row));
            }
        }
    }

    fn end_episode(&mut self, episode: &Episode) {
        let place = || Place::episode(episode.index);
        if !self.seen.insert(episode.index) {
            self.twice.add(place);
        }
        match self.last.replace(episode.index) {
            Some(last) if episode.index < last => self.backwards.add(place),
            Some(last) if episode.index.wrapping_sub(last) > 1 => self.gaps.add(place),
            _ => {}
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        found.push_at(self.twice, |_| {
            Finding::error("episode-number-twice", "two episodes have the same number")
        });
        found.push_at(self.step_gaps, |_| {
            Finding::warning(
                "step-gap",
                "step numbers are not consecutive: steps are missing, and the step before is not the one before",
            )
        });
        found.push_at(self.late_starts, |_| {
            Finding::note("late-start", "episodes do not start at step 0")
        });
        found.push_at(self.gaps, |_| {
            Finding::note(
                "episode-number-gap",
                "episode numbers are missing before these",
            )
        });
        found.push_at(self.backwards, |_| {
            Finding::note("episode-order", "episode numbers do not ascend")
        });
    }
}

#[cfg(test)]
mod tests {
    use crate::validate::synthetic::{Table, codes};

    #[test]
    fn consecutive_numbers_are_silent() {
        assert_eq!(codes(&Table::good(), "numbers"), [""; 0]);
    }

    #[test]
    fn gaps_and_repeats_are_seen() {
        let number = |numbers: [i64; 3]| codes(&Table::good().numbered(numbers), "numbers");
        assert_eq!(number([0, 1, 5]), ["episode-number-gap"]);
        assert_eq!(number([0, 2, 1]), ["episode-number-gap", "episode-order"]);
        assert_eq!(number([0, 1, 0]), ["episode-number-twice", "episode-order"]);
        assert_eq!(codes(&Table::good().skip_step(5), "numbers"), ["step-gap"]);
        assert_eq!(
            codes(&Table::good().skip_step(0), "numbers"),
            ["late-start"]
        );
    }
}
