//! Goals that change inside an episode, and maze2d's rewards.

use super::drive::Check;
use super::facts::{Facts, Family};
use super::report::{Finding, Findings, Tally, many};
use super::rows::Segment;
use crate::schema;

/// Distance at which D4RL's maze2d counts a goal as reached.
const REACHED: f64 = 0.5;
/// Steps that must tell one reading of the rewards from the other before it is called a fault.
const MIN_EVIDENCE: u64 = 3;

struct Goals {
    place: usize,
    name: String,
    family: Family,
    changes: Tally,
    maze: Option<Maze>,
}

/// Whether rewards go with the observation of their own row, or with the next one.
struct Maze {
    position: usize,
    reward: usize,
    /// Steps where only the own observation explains the reward.
    n_own: u64,
    /// Steps where only the next one does.
    n_next: u64,
}

pub(super) fn check(facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    let names = [
        schema::join_key(schema::INFO, "goal"),
        schema::join_key(schema::OBSERVATION, "desired_goal"),
    ];
    let place = names.iter().find_map(|name| facts.find(name))?;
    let maze = match facts.family {
        Family::Maze2d if facts.columns[place].width >= 2 => facts
            .position()
            .zip(facts.find(schema::REWARD))
            .map(|(position, reward)| Maze {
                position,
                reward,
                n_own: 0,
                n_next: 0,
            }),
        _ => None,
    };
    Some(Box::new(Goals {
        place,
        name: facts.columns[place].name.clone(),
        family: facts.family,
        changes: Tally::default(),
        maze,
    }))
}

impl Check for Goals {
    fn name(&self) -> &'static str {
        "goals"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        let goals = segment.column(self.place);
        for (before, row) in segment.pairs() {
            let Some((from, to)) = goals.row(before).zip(goals.row(row)) else {
                continue;
            };
            // By bits, so that a NaN goal is a goal.
            if from.iter().zip(to).any(|(a, b)| a.to_bits() != b.to_bits()) {
                self.changes.add(|| segment.place(row).of(&self.name));
            } else if let Some(maze) = &mut self.maze {
                maze.look_at(segment, (before, row), from);
            }
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        let (family, name) = (self.family, &self.name);
        found.push_at(self.changes, |n| {
            let message = format!("\"{name}\" changes at {} inside episodes", many(n, "step"));
            match family {
                Family::Maze2d => Finding::warning(
                    "goal-change",
                    format!(
                        "{message}: maze2d files have no episode ends; open it with the episode policy `goal-change`, or with a step limit"
                    ),
                ),
                _ => Finding::note("goal-change", message),
            }
        });
        if let Some(maze) = self.maze {
            maze.finish(found);
        }
    }
}

impl Maze {
    fn look_at(&mut self, segment: &Segment<'_>, (before, row): (usize, usize), goal: &[f64]) {
        let near = |row: usize| {
            let at = segment.column(self.position).row(row)?;
            Some((at[0] - goal[0]).hypot(at[1] - goal[1]) <= REACHED)
        };
        let reward = segment.column(self.reward).number(before);
        let (Some(own), Some(next), Some(reward)) = (near(before), near(row), reward) else {
            return;
        };
        if own == next || (reward != 0.0 && reward != 1.0) {
            return;
        }
        if own == (reward == 1.0) {
            self.n_own += 1;
        } else {
            self.n_next += 1;
        }
    }

    fn finish(self, found: &mut Findings) {
        let (own, next) = (self.n_own, self.n_next);
        if own >= MIN_EVIDENCE && own > 9 * next {
            found.push(Finding::warning(
                "reward-off-by-one",
                format!(
                    "rewards describe the observation of their own row and not the next one, as the environment's do ({own} of {} steps that tell): the known fault of maze2d v1 (D4RL#194)",
                    own + next
                ),
            ));
        } else if own + next < MIN_EVIDENCE {
            found.push(Finding::note(
                "reward-off-by-one",
                "this file does not tell whether its rewards describe the observation of their own row, the known fault of maze2d v1 (D4RL#194)",
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::validate::Severity;
    use crate::validate::synthetic::{Table, codes, findings};

    #[test]
    fn one_goal_for_each_episode_is_silent() {
        let goals = |row: usize| vec![(row / 20) as f64, 0.0];
        assert_eq!(codes(&Table::good().with_goals(goals), "goals"), [""; 0]);
        assert_eq!(codes(&Table::good(), "goals"), [""; 0]);
    }

    #[test]
    fn a_goal_that_changes_is_seen() {
        let table = Table::good().with_goals(|row| vec![f64::from(u8::from(row > 5)), 0.0]);
        let found = findings(&table, "goals");
        assert_eq!((found[0].code, found[0].count), ("goal-change", 1));
        assert_eq!(found[0].places[0].to_string(), "info.goal episode 0 step 6");
        let found = findings(&table.d4rl("maze2d-umaze-v1"), "goals");
        assert!(found[0].message.contains("`goal-change`"));
        assert_eq!(
            (found[1].code, found[1].severity),
            ("reward-off-by-one", Severity::Note)
        );
    }

    #[test]
    fn rewards_of_the_own_row_are_told_from_those_of_the_next() {
        // In and out of reach every ten rows, in each of the episodes.
        let x = |row: usize| if row / 10 % 2 == 1 { 2.0 } else { 9.0 };
        let table = |shift: usize| {
            let table = Table::of_lengths(&[60, 60]).with_goals(|_| vec![2.0, 0.0]);
            let table = (0..120).fold(table, |table, row| {
                table
                    .with_observation(row, 0, x(row))
                    .with_observation(row, 1, 0.0)
            });
            let rewards = (0..120).map(|row| f64::from(u8::from(x(row + shift) == 2.0)));
            table
                .with_rewards(rewards.collect())
                .d4rl("maze2d-umaze-v1")
        };
        assert_eq!(codes(&table(0), "goals"), ["reward-off-by-one"]);
        assert_eq!(codes(&table(1), "goals"), [""; 0]);
    }
}
