//! Lengths of episodes, and rows that are steps only in part.

use super::drive::{Check, Episode};
use super::facts::{Facts, Family};
use super::report::{Finding, Findings, Place, Severity, Tally, many};
use super::rows::Segment;

/// From this share of one-step episodes on, the cuts are doubted and not the episodes.
const ODD_SHARE: f64 = 0.05;

struct Lengths {
    family: Family,
    limit: Option<(u64, &'static str)>,
    /// Places of the columns that a step must have.
    required: Vec<(usize, String)>,
    n_episodes: u64,
    n_with_final: u64,
    without_final: Tally,
    empty: Tally,
    one_step: Tally,
    too_long: Tally,
    longest: u64,
    incomplete: Tally,
    early_final: Tally,
    /// A row without a step that was the last so far.
    pending_final: Option<Place>,
}

pub(super) fn check(facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    let required = facts.columns.iter().enumerate();
    Some(Box::new(Lengths {
        family: facts.family,
        limit: facts.step_limit,
        required: required
            .filter(|(_, column)| column.marks_steps)
            .map(|(place, column)| (place, column.name.clone()))
            .collect(),
        n_episodes: 0,
        n_with_final: 0,
        without_final: Tally::default(),
        empty: Tally::default(),
        one_step: Tally::default(),
        too_long: Tally::default(),
        longest: 0,
        incomplete: Tally::default(),
        early_final: Tally::default(),
        pending_final: None,
    }))
}

impl Check for Lengths {
    fn name(&self) -> &'static str {
        "lengths"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        for row in segment.rows() {
            if let Some(place) = self.pending_final.take() {
                self.early_final.add(|| place);
            }
            if !segment.is_step(row) {
                self.pending_final = Some(segment.place(row));
                continue;
            }
            for (place, name) in &self.required {
                if segment.column(*place).is_null(row) {
                    self.incomplete.add(|| segment.place(row).of(name));
                }
            }
        }
    }

    fn end_episode(&mut self, episode: &Episode) {
        let place = || Place::episode(episode.index);
        self.n_episodes += 1;
        if self.pending_final.take().is_some() {
            self.n_with_final += 1;
        } else {
            self.without_final.add(place);
        }
        match episode.n_steps {
            0 => self.empty.add(place),
            1 => self.one_step.add(place),
            _ => {}
        }
        if self.limit.is_some_and(|(limit, _)| episode.n_steps > limit) {
            self.too_long.add(place);
            self.longest = self.longest.max(episode.n_steps);
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        found.push_at(self.early_final, |_| {
            Finding::error(
                "null-inside-episode",
                "a row without action, reward and flags is not the last of its episode",
            )
        });
        found.push_at(self.incomplete, |_| {
            Finding::error(
                "incomplete-step",
                "a step lacks a value that other columns have",
            )
        });
        found.push_at(self.empty, |n| {
            Finding::warning(
                "empty-episodes",
                format!("{} without a step", many(n, "episode")),
            )
        });
        if self.n_with_final > 0 {
            let all = self.n_episodes;
            found.push_at(self.without_final, |n| {
                Finding::warning(
                    "mixed-final-observations",
                    format!("{n} of {all} episodes lack the observation after their last step, the others have it"),
                )
            });
        }
        let (family, all) = (self.family, self.n_episodes);
        found.push_at(self.one_step, |n| one_step(n, all, family));
        if let Some((limit, by)) = self.limit {
            let longest = self.longest;
            found.push_at(self.too_long, |n| too_long(n, longest, (limit, by), family));
        }
    }
}

#[expect(clippy::cast_precision_loss, reason = "counts are far below 2^53")]
fn one_step(n: u64, all: u64, family: Family) -> Finding {
    let is_odd = n > 1 && n as f64 > ODD_SHARE * all as f64;
    let severity = if is_odd {
        Severity::Warning
    } else {
        Severity::Note
    };
    let why = match family {
        Family::Antmaze(None | Some(2)) if is_odd => {
            "; antmaze v2 raises `terminals` on every row near the goal (D4RL#199): open it with the episode policy `timeouts`"
        }
        _ => "",
    };
    Finding::new(
        severity,
        "one-step-episodes",
        format!("{n} of {} with a single step{why}", many(all, "episode")),
    )
}

fn too_long(n: u64, longest: u64, (limit, by): (u64, &str), family: Family) -> Finding {
    let message = format!(
        "{} longer than the {limit} steps of {by}, the longest has {longest}",
        many(n, "episode")
    );
    match family {
        Family::Antmaze(_) if longest == limit + 1 => Finding::note(
            "longer-than-limit",
            format!("{message}; D4RL's antmaze generator counts one step too many"),
        ),
        _ => Finding::warning("longer-than-limit", message),
    }
}

#[cfg(test)]
mod tests {
    use crate::validate::synthetic::{Table, codes};

    #[test]
    fn good_lengths_are_silent() {
        assert_eq!(codes(&Table::good(), "lengths"), [""; 0]);
        assert_eq!(
            codes(&Table::good().with_final(&[0, 1, 2]), "lengths"),
            [""; 0]
        );
    }

    #[test]
    fn each_odd_length_is_seen() {
        let one_step = Table::of_lengths(&[9, 1, 8, 1]);
        assert_eq!(codes(&one_step, "lengths"), ["one-step-episodes"]);
        let mixed = Table::good().with_final(&[1]);
        assert_eq!(codes(&mixed, "lengths"), ["mixed-final-observations"]);
        let long = Table::good().with_step_limit(19);
        assert_eq!(codes(&long, "lengths"), ["longer-than-limit"]);
        assert_eq!(
            codes(&Table::good().with_step_limit(20), "lengths"),
            [""; 0]
        );
    }

    #[test]
    fn holes_are_errors() {
        let hole = Table::good().without_action(5);
        assert_eq!(codes(&hole, "lengths"), ["incomplete-step"]);
        let early = Table::good().without_step(5);
        assert_eq!(codes(&early, "lengths"), ["null-inside-episode"]);
        let empty = Table::of_lengths(&[9, 1, 8]).with_empty_episode(1);
        assert!(codes(&empty, "lengths").contains(&"empty-episodes"));
    }
}
