//! Steps over which a state moves further than it can.

use super::drive::Check;
use super::facts::{Facts, Family, Kind, Role};
use super::magnitudes::Magnitudes;
use super::report::{Finding, Findings, Severity, Tally, many};
use super::rows::Segment;

/// An antmaze ant moves by at most 0.5 in a step; resets move it by 8 and more. As the policy `position-jump`.
const POSITION_JUMP: f64 = 1.0;
/// If more steps jump than this, the columns are no positions.
const POSITION_SHARE: f64 = 0.05;
/// An outlier moves further than the median by this many standard deviations (from the median deviation,
/// as for a normal distribution). Contacts give heavy tails, hence so many.
const DEVIATIONS: f64 = 50.0;
const DEVIATION_TO_STD: f64 = 1.4826;
/// And by this many medians.
const MEDIANS: f64 = 20.0;
/// And at most this share of the steps does so; else it is how the quantity moves.
const OUTLIER_SHARE: f64 = 0.002;
/// Fewer steps than this have no typical step.
const MIN_STEPS: u64 = 100;

struct Leaf {
    place: usize,
    name: String,
    moves: Magnitudes,
}

struct Jumps {
    leaves: Vec<Leaf>,
    position: Option<Position>,
}

/// The x and y of an ant.
struct Position {
    place: usize,
    version: Option<u8>,
    jumps: Tally,
    n_steps: u64,
}

pub(super) fn check(facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    let leaves = facts.with_role(Role::Observation);
    let leaves: Vec<Leaf> = leaves
        .filter(|(_, column)| column.kind == Kind::Float && !column.wraps)
        .map(|(place, column)| Leaf {
            place,
            name: column.name.clone(),
            moves: Magnitudes::default(),
        })
        .collect();
    let position = match facts.family {
        Family::Antmaze(version) => facts.position().map(|place| Position {
            place,
            version,
            jumps: Tally::default(),
            n_steps: 0,
        }),
        _ => None,
    };
    (!leaves.is_empty()).then(|| Box::new(Jumps { leaves, position }) as Box<dyn Check>)
}

impl Check for Jumps {
    fn name(&self) -> &'static str {
        "jumps"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        for leaf in &mut self.leaves {
            let values = segment.column(leaf.place);
            for (before, row) in segment.pairs() {
                if let Some((from, to)) = values.row(before).zip(values.row(row)) {
                    leaf.moves
                        .add(distance(from, to), segment.episode, segment.step(row));
                }
            }
        }
        if let Some(position) = &mut self.position {
            position.visit(segment);
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        let mut is_explained = false;
        if let Some(position) = self.position {
            is_explained = position.jumps.count > 0;
            position.finish(found);
        }
        for leaf in self.leaves.iter().filter(|_| !is_explained) {
            outliers(leaf, found);
        }
    }
}

fn distance(from: &[f64], to: &[f64]) -> f64 {
    let squares = from.iter().zip(to).map(|(from, to)| (to - from).powi(2));
    squares.sum::<f64>().sqrt()
}

#[expect(clippy::cast_precision_loss, reason = "counts are far below 2^53")]
fn outliers(leaf: &Leaf, found: &mut Findings) {
    let moves = &leaf.moves;
    let median = moves.median();
    if moves.n() < MIN_STEPS || median <= 0.0 {
        return;
    }
    let spread = DEVIATION_TO_STD * moves.deviation(median);
    let limit = (median + DEVIATIONS * spread).max(MEDIANS * median);
    if moves.n_above(limit) as f64 > OUTLIER_SHARE * moves.n() as f64 {
        return;
    }
    found.push_at(moves.places_above(limit, &leaf.name), |n| {
        Finding::note(
            "outlier-step",
            format!(
                "\"{}\" moves up to {:.0} times as far as usual in one step (further than {limit:.3e} in {}): a reset inside an episode looks like this",
                leaf.name,
                moves.max() / median,
                many(n, "step")
            ),
        )
    });
}

impl Position {
    fn visit(&mut self, segment: &Segment<'_>) {
        let values = segment.column(self.place);
        for (before, row) in segment.pairs() {
            let Some((from, to)) = values.row(before).zip(values.row(row)) else {
                continue;
            };
            self.n_steps += 1;
            if distance(&from[..2], &to[..2]) > POSITION_JUMP {
                self.jumps.add(|| segment.place(row));
            }
        }
    }

    #[expect(clippy::cast_precision_loss, reason = "counts are far below 2^53")]
    fn finish(self, found: &mut Findings) {
        let share = self.jumps.count as f64 / self.n_steps.max(1) as f64;
        let fault = match self.version {
            Some(2) => "",
            Some(_) => ", the known fault of antmaze v0 and v1",
            None => ", as in antmaze v0 and v1",
        };
        found.push_at(self.jumps, |n| {
            let (severity, message) = if share <= POSITION_SHARE {
                let message = format!(
                    "x, y jump by more than {POSITION_JUMP} at {} inside episodes: these are resets{fault} (D4RL#77); open it with the episode policy `position-jump`",
                    many(n, "step")
                );
                (Severity::Error, message)
            } else {
                let message = format!(
                    "x, y move by more than {POSITION_JUMP} at {} ({:.0} %): the first two values are no positions of an ant",
                    many(n, "step"),
                    100.0 * share
                );
                (Severity::Warning, message)
            };
            Finding::new(severity, "position-jump", message)
        });
    }
}

#[cfg(test)]
mod tests {
    use crate::validate::Severity;
    use crate::validate::synthetic::{Table, codes, findings};

    #[test]
    fn steady_motion_is_silent() {
        let long = Table::of_lengths(&[600, 600]);
        assert_eq!(codes(&long, "jumps"), [""; 0]);
        assert_eq!(
            codes(&long.clone().d4rl("antmaze-umaze-v0"), "jumps"),
            [""; 0]
        );
    }

    #[test]
    fn one_reset_inside_an_episode_is_seen_and_borders_are_not() {
        let mut table = Table::of_lengths(&[600, 600]);
        for row in 300..600 {
            table = table.with_observation(row, 0, 90.0 + 0.1 * row as f64);
        }
        let found = findings(&table, "jumps");
        assert_eq!((found[0].code, found[0].count), ("outlier-step", 1));
        assert_eq!(
            found[0].places[0].to_string(),
            "observation episode 0 step 300"
        );
        let found = findings(&table.d4rl("antmaze-umaze-v0"), "jumps");
        assert_eq!(
            (found[0].code, found[0].severity),
            ("position-jump", Severity::Error)
        );
        assert!(found[0].message.contains("D4RL#77"));
        assert_eq!(found.len(), 1, "the jump is reported once");
    }

    #[test]
    fn a_table_without_positions_is_not_called_a_series_of_resets() {
        let mut table = Table::of_lengths(&[100, 100]).d4rl("antmaze-umaze-v2");
        for row in (0..200).step_by(2) {
            table = table.with_observation(row, 0, -9.0);
        }
        let found = findings(&table, "jumps");
        assert_eq!(
            (found[0].code, found[0].severity),
            ("position-jump", Severity::Warning)
        );
        assert!(found[0].message.contains("no positions"));
    }
}
