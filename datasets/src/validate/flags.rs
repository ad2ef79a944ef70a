//! Flags that end episodes, and rewards that do not go with them.

use super::drive::{Check, Episode};
use super::facts::{Facts, Family};
use super::report::{Finding, Findings, Place, Severity, Tally, many};
use super::rows::Segment;
use crate::schema;

struct Flags {
    terminated: Option<usize>,
    truncated: Option<usize>,
    reward: Option<usize>,
    family: Family,
    /// Whether ends were inferred, so that flags are not expected at them.
    inferred: bool,
    is_joined: bool,
    /// The last step so far: its flags and its place.
    last: Option<(bool, bool, Place)>,
    both: Tally,
    early_terminated: Tally,
    early_truncated: Tally,
    open: Tally,
    last_open: bool,
    n_episodes: u64,
    rewards: Rewards,
}

/// Rewards against `terminated`.
#[derive(Default)]
struct Rewards {
    /// Whether all rewards are 0 or 1.
    not_binary: bool,
    n_ones: u64,
    one_without_end: Tally,
    end_without_one: Tally,
}

pub(super) fn check(facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    let terminated = facts.find(schema::TERMINATED);
    let truncated = facts.find(schema::TRUNCATED);
    terminated.or(truncated)?;
    Some(Box::new(Flags {
        terminated,
        truncated,
        reward: facts.find(schema::REWARD),
        family: facts.family,
        inferred: facts.info.boundaries_inferred,
        is_joined: facts.is_named("medium-expert"),
        last: None,
        both: Tally::default(),
        early_terminated: Tally::default(),
        early_truncated: Tally::default(),
        open: Tally::default(),
        last_open: false,
        n_episodes: 0,
        rewards: Rewards::default(),
    }))
}

impl Check for Flags {
    fn name(&self) -> &'static str {
        "flags"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        for row in segment.step_rows() {
            if let Some((terminated, truncated, place)) = self.last.take() {
                if terminated {
                    self.early_terminated.add(|| place);
                } else if truncated {
                    self.early_truncated.add(|| place);
                }
            }
            let flag = |place: Option<usize>| {
                place
                    .and_then(|place| segment.column(place).flag(row))
                    .unwrap_or(false)
            };
            let (terminated, truncated) = (flag(self.terminated), flag(self.truncated));
            if terminated && truncated {
                self.both.add(|| segment.place(row));
            }
            let reward = self
                .reward
                .and_then(|place| segment.column(place).number(row));
            if let (Some(reward), Some(_)) = (reward, self.terminated) {
                self.rewards.add(reward, terminated, || segment.place(row));
            }
            self.last = Some((terminated, truncated, segment.place(row)));
        }
    }

    fn end_episode(&mut self, episode: &Episode) {
        self.n_episodes += 1;
        self.last_open = match self.last.take() {
            Some((terminated, truncated, _)) => !terminated && !truncated,
            None => false,
        };
        if self.last_open {
            self.open
                .add(|| Place::step(episode.index, episode.last_step));
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        let family = self.family;
        found.push_at(self.early_terminated, |n| early_terminated(n, family));
        found.push_at(self.early_truncated, |n| {
            Finding::warning(
                "truncated-inside-episode",
                format!(
                    "`truncated` is set at {}, before the end of an episode",
                    many(n, "step")
                ),
            )
        });
        found.push_at(self.both, |n| {
            Finding::note(
                "both-flags",
                format!(
                    "both flags are set at {}: they count as terminated",
                    many(n, "step")
                ),
            )
        });
        let only_last = self.last_open && self.open.count == 1;
        let (all, inferred, is_joined) = (self.n_episodes, self.inferred, self.is_joined);
        found.push_at(self.open, |n| {
            let share = format!("{n} of {}", many(all, "episode"));
            let message = match () {
                () if inferred => format!("{share} without an end flag, as their ends were inferred"),
                () if only_last => "the last episode has no end flag: it was cut when the recording stopped".to_owned(),
                () if is_joined && n <= 2 => {
                    format!("{share} without an end flag; two sets were joined, and the border episode of the first may be cut")
                }
                () => format!("{share} without an end flag"),
            };
            let expected = inferred || only_last || (is_joined && n <= 2);
            let severity = if expected { Severity::Note } else { Severity::Warning };
            Finding::new(severity, "no-end-flag", message)
        });
        self.rewards.finish(family, found);
    }
}

fn early_terminated(n: u64, family: Family) -> Finding {
    let message = format!(
        "`terminated` is set at {}, before the end of an episode",
        many(n, "step")
    );
    match family {
        Family::Antmaze(_) => Finding::note(
            "terminated-inside-episode",
            format!(
                "{message}: antmaze v2 sets it on every row near the goal (D4RL#199); as a mask for Q-learning it is right"
            ),
        ),
        _ => Finding::warning("terminated-inside-episode", message),
    }
}

impl Rewards {
    fn add(&mut self, reward: f64, terminated: bool, place: impl Fn() -> Place) {
        if reward == 1.0 {
            self.n_ones += 1;
            if !terminated {
                self.one_without_end.add(&place);
            }
        } else if reward == 0.0 {
            if terminated {
                self.end_without_one.add(&place);
            }
        } else {
            self.not_binary = true;
        }
    }

    /// Only tasks whose rewards are 0 and 1 say with a reward that the goal is reached.
    fn finish(self, family: Family, found: &mut Findings) {
        if self.not_binary || self.n_ones == 0 {
            return;
        }
        // A task that goes on after the goal never terminates.
        let continues = self.one_without_end.count == self.n_ones;
        let reference = match family {
            Family::Antmaze(Some(_)) => " (as in some antmaze files, D4RL#199)",
            _ if continues => ": the task goes on after the goal",
            _ => "",
        };
        found.push_at(self.one_without_end, |n| {
            Finding::note(
                "reward-without-terminal",
                format!(
                    "reward 1 without `terminated` at {}{reference}",
                    many(n, "step")
                ),
            )
        });
        found.push_at(self.end_without_one, |n| {
            Finding::note(
                "terminal-without-reward",
                format!(
                    "`terminated` with reward 0 at {}, in a task with rewards 0 and 1",
                    many(n, "step")
                ),
            )
        });
    }
}

#[cfg(test)]
mod tests {
    use crate::validate::Severity;
    use crate::validate::synthetic::{Table, codes, findings};

    #[test]
    fn an_end_flag_at_every_end_is_silent() {
        assert_eq!(codes(&Table::good(), "flags"), [""; 0]);
        assert_eq!(
            codes(&Table::good().with_final(&[0, 1, 2]), "flags"),
            [""; 0]
        );
        assert_eq!(codes(&Table::good().without_flags(), "flags"), [""; 0]);
    }

    #[test]
    fn misplaced_flags_are_seen() {
        let flag = |row, terminated, truncated| {
            codes(
                &Table::good().with_flags(row, terminated, truncated),
                "flags",
            )
        };
        assert_eq!(flag(5, true, false), ["terminated-inside-episode"]);
        assert_eq!(flag(5, false, true), ["truncated-inside-episode"]);
        assert_eq!(flag(19, true, true), ["both-flags"]);
        assert_eq!(flag(19, false, false), ["no-end-flag"]);
    }

    #[test]
    fn a_cut_is_graded_by_what_is_expected() {
        let grade = |id: &str, row| {
            let table = Table::good().d4rl(id).with_flags(row, false, false);
            findings(&table, "flags")[0].severity
        };
        assert_eq!(grade("hopper_medium-v2", 39), Severity::Warning);
        assert_eq!(grade("hopper_medium_expert-v2", 39), Severity::Note);
        assert_eq!(grade("hopper_medium-v2", 59), Severity::Note);
    }

    #[test]
    fn a_goal_reward_goes_with_a_terminal() {
        let sparse = |ones: &[usize]| {
            let rewards = (0..60).map(|row| f64::from(u8::from(ones.contains(&row))));
            codes(&Table::good().with_rewards(rewards.collect()), "flags")
        };
        assert_eq!(sparse(&[19, 39, 59]), [""; 0]);
        assert_eq!(sparse(&[18, 19, 39, 59]), ["reward-without-terminal"]);
        assert_eq!(sparse(&[19, 59]), ["terminal-without-reward"]);
    }
}
