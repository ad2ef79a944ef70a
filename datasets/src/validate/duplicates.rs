//! Episodes and observations that occur more than once.

use std::collections::BTreeMap;

use sha2::{Digest, Sha256};

use super::drive::{Check, Episode};
use super::facts::{Facts, Kind, Role};
use super::report::{Finding, Findings, Place, Tally, many};
use super::rows::Segment;

/// So many observations in a row that are equal to the last bit, while the actions differ, are a sensor that
/// stopped. A robot at rest has noise, and a simulation moves.
const FROZEN_ROWS: u64 = 10;

/// Half of a SHA-256: 2^64 episodes would have to be compared for a chance meeting.
type Key = [u8; 16];

struct Duplicates {
    observations: Vec<usize>,
    actions: Vec<usize>,
    has_floats: bool,
    hasher: Sha256,
    buffer: Vec<u8>,
    seen: BTreeMap<Key, i64>,
    copies: Tally,
    first_pair: Option<(i64, i64)>,
    /// Equal observations up to the last row, how many of them came with other actions, and where it began.
    run: (u64, bool, Option<Place>),
    frozen: Tally,
    longest: u64,
}

pub(super) fn check(facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    let places = |role| {
        facts
            .with_role(role)
            .map(|(place, _)| place)
            .collect::<Vec<_>>()
    };
    let (observations, actions) = (places(Role::Observation), places(Role::Action));
    (!observations.is_empty()).then(|| {
        Box::new(Duplicates {
            has_floats: facts
                .with_role(Role::Observation)
                .any(|(_, column)| column.kind == Kind::Float),
            observations,
            actions,
            hasher: Sha256::new(),
            buffer: Vec::new(),
            seen: BTreeMap::new(),
            copies: Tally::default(),
            first_pair: None,
            run: (0, false, None),
            frozen: Tally::default(),
            longest: 0,
        }) as Box<dyn Check>
    })
}

impl Check for Duplicates {
    fn name(&self) -> &'static str {
        "duplicates"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        for row in segment.rows() {
            self.buffer.clear();
            for &place in self.observations.iter().chain(&self.actions) {
                append(segment, place, row, &mut self.buffer);
            }
            self.hasher.update(&self.buffer);
        }
        if !self.has_floats {
            // A discrete state often stays, at a wall for instance.
            return;
        }
        for (before, row) in segment.pairs() {
            let same = |places: &[usize]| {
                places
                    .iter()
                    .all(|&place| is_same(segment, place, before, row))
            };
            if !segment.is_step(row) || !same(&self.observations) {
                self.end_run();
                continue;
            }
            self.run.0 += 1;
            self.run.1 |= !same(&self.actions);
            self.run.2.get_or_insert_with(|| segment.place(before));
        }
    }

    fn end_episode(&mut self, episode: &Episode) {
        self.end_run();
        let digest = self.hasher.finalize_reset();
        let mut key = Key::default();
        key.copy_from_slice(&digest[..16]);
        // A single step may well occur twice.
        if episode.n_steps < 2 {
            return;
        }
        match self.seen.get(&key) {
            None => {
                self.seen.insert(key, episode.index);
            }
            Some(&first) => {
                self.copies.add(|| Place::episode(episode.index));
                self.first_pair.get_or_insert((first, episode.index));
            }
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        let (first, copy) = self.first_pair.unwrap_or_default();
        found.push_at(self.copies, |n| {
            Finding::warning(
                "duplicate-episode",
                format!(
                    "{} with the observations and actions of an earlier one to the last bit ({copy} is {first})",
                    many(n, "episode")
                ),
            )
        });
        let longest = self.longest;
        found.push_at(self.frozen, |n| {
            Finding::warning(
                "frozen-observation",
                format!(
                    "the observation stays the same to the last bit while the actions differ, {} for {FROZEN_ROWS} rows or more, at most for {longest}",
                    many(n, "time")
                ),
            )
        });
    }
}

impl Duplicates {
    fn end_run(&mut self) {
        let (n_equal, acts, place) = std::mem::take(&mut self.run);
        let n_rows = n_equal + 1;
        if let (Some(place), true) = (place, acts && n_rows >= FROZEN_ROWS) {
            self.longest = self.longest.max(n_rows);
            self.frozen.add(|| place);
        }
    }
}

/// Adds the value of a row, with a mark for null.
fn append(segment: &Segment<'_>, place: usize, row: usize, buffer: &mut Vec<u8>) {
    let column = segment.column(place);
    if let Some(numbers) = column.row(row).filter(|numbers| !numbers.is_empty()) {
        buffer.push(1);
        buffer.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
    } else if let Some(bytes) = column.bytes(row) {
        buffer.push(2);
        buffer.extend((bytes.len() as u64).to_le_bytes());
        buffer.extend_from_slice(bytes);
    } else {
        buffer.push(0);
    }
}

fn is_same(segment: &Segment<'_>, place: usize, a: usize, b: usize) -> bool {
    let column = segment.column(place);
    match (column.row(a), column.row(b)) {
        (Some(a), Some(b)) => a
            .iter()
            .map(|v| v.to_bits())
            .eq(b.iter().map(|v| v.to_bits())),
        _ => column.bytes(a) == column.bytes(b) && column.is_null(a) == column.is_null(b),
    }
}

#[cfg(test)]
mod tests {
    use crate::validate::synthetic::{Table, codes, findings};

    #[test]
    fn different_episodes_are_silent() {
        assert_eq!(codes(&Table::good(), "duplicates"), [""; 0]);
        // The same observation and the same action: a robot that waits.
        let waits = (3..18).fold(Table::good(), |table, row| {
            table
                .with_observation(row, 0, 1.0)
                .with_observation(row, 1, 1.0)
                .with_action(row, 0, 0.5)
                .with_action(row, 1, 0.5)
        });
        assert_eq!(codes(&waits, "duplicates"), [""; 0]);
    }

    #[test]
    fn copies_are_seen() {
        let found = findings(&Table::good().with_copy(0, 2), "duplicates");
        assert_eq!((found[0].code, found[0].count), ("duplicate-episode", 1));
        assert!(
            found[0].message.contains("(2 is 0)"),
            "{}",
            found[0].message
        );
    }

    #[test]
    fn a_sensor_that_stops_is_seen_but_a_short_stop_is_not() {
        let frozen = |n: usize| {
            (3..3 + n).fold(Table::good(), |table, row| {
                table
                    .with_observation(row, 0, 1.0)
                    .with_observation(row, 1, 1.0)
            })
        };
        assert_eq!(codes(&frozen(9), "duplicates"), [""; 0]);
        let found = findings(&frozen(10), "duplicates");
        assert_eq!((found[0].code, found[0].count), ("frozen-observation", 1));
        assert_eq!(found[0].places[0].to_string(), "episode 0 step 3");
    }
}
