//! Cutting a stream of row flags into episodes: pure logic, no files.

use super::policy::EpisodePolicy;
use crate::episode::EpisodeEnd;
use crate::error::{DatasetError, Result};

/// What a row says about the end of its episode.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RowFlags {
    /// `terminals` of the row.
    pub(crate) terminal: bool,
    /// `timeouts` of the row, if the file has them.
    pub(crate) timeout: Option<bool>,
    /// Whether goal or position moved between the row before and this one.
    pub(crate) moved: bool,
}

/// One episode: rows `start..start + n_steps` of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Cut {
    pub(crate) start: u64,
    pub(crate) n_steps: u64,
    /// Whether row `start + n_steps` is taken as the final observation.
    pub(crate) has_final_obs: bool,
    pub(crate) end: EpisodeEnd,
}

/// Takes the flags of row after row; gives the episodes at the end.
#[derive(Debug)]
pub(crate) struct Cutter {
    policy: EpisodePolicy,
    max_episode_steps: Option<u64>,
    terminate_on_end: bool,
    row: u64,
    start: u64,
    /// Step counter as the reference functions keep it.
    counter: u64,
    cuts: Vec<Cut>,
    last: RowFlags,
    /// Flags of the row before, held back because the last row of a file counts differently.
    held: Option<RowFlags>,
}

impl Cutter {
    /// Starts at row 0.
    ///
    /// # Errors
    /// [`DatasetError::PolicyNeeds`] if the policy needs time-outs or a step limit that are not there.
    pub(crate) fn new(
        policy: EpisodePolicy,
        has_timeouts: bool,
        max_episode_steps: Option<u64>,
        terminate_on_end: bool,
    ) -> Result<Self> {
        let needs = |needs| {
            Err(DatasetError::PolicyNeeds {
                policy: policy.name(),
                needs,
            })
        };
        match policy {
            EpisodePolicy::Timeouts if !has_timeouts => return needs("the key \"timeouts\""),
            EpisodePolicy::D4rlSequence | EpisodePolicy::D4rlQlearning
                if !has_timeouts && max_episode_steps.is_none() =>
            {
                return needs("the key \"timeouts\" or a step limit (max_episode_steps)");
            }
            _ => {}
        }
        if max_episode_steps == Some(0) {
            return needs("a step limit of at least 1");
        }
        Ok(Self {
            policy,
            max_episode_steps,
            terminate_on_end,
            row: 0,
            start: 0,
            counter: 0,
            cuts: Vec::new(),
            last: RowFlags::default(),
            held: None,
        })
    }

    /// Adds the next row.
    pub(crate) fn push(&mut self, flags: RowFlags) {
        if self.policy == EpisodePolicy::D4rlQlearning {
            if let Some(flags) = self.held.replace(flags) {
                self.push_qlearning(flags);
            }
            return;
        }
        if flags.moved && self.row > self.start {
            self.end_before(self.row, EpisodeEnd::Cut);
        }
        let end = match self.policy {
            EpisodePolicy::GoalChange | EpisodePolicy::PositionJump => None,
            EpisodePolicy::Timeouts => (flags.timeout == Some(true)).then(|| kind(flags)),
            EpisodePolicy::D4rlSequence => self.sequence_end(flags),
            EpisodePolicy::Clean | EpisodePolicy::D4rlQlearning => self.clean_end(flags),
        };
        self.row += 1;
        self.last = flags;
        if let Some(end) = end {
            self.end_before(self.row, end);
        }
    }

    /// The episodes, once all rows were added.
    pub(crate) fn finish(mut self) -> Vec<Cut> {
        match self.policy {
            // `sequence_dataset` never yields the rows after the last end.
            EpisodePolicy::D4rlSequence => {}
            // The held row is the last of the file, which `qlearning_dataset` never looks at.
            EpisodePolicy::D4rlQlearning => self.end_before(self.row, EpisodeEnd::Cut),
            _ => self.end_before(self.row, EpisodeEnd::Cut),
        }
        self.cuts
    }

    fn clean_end(&self, flags: RowFlags) -> Option<EpisodeEnd> {
        let over_limit = flags.timeout.is_none()
            && self
                .max_episode_steps
                .is_some_and(|limit| self.row + 1 - self.start >= limit);
        match flags {
            RowFlags { terminal: true, .. } => Some(EpisodeEnd::Terminated),
            RowFlags {
                timeout: Some(true),
                ..
            } => Some(EpisodeEnd::Truncated),
            _ => over_limit.then_some(EpisodeEnd::Truncated),
        }
    }

    fn is_final(&self, flags: RowFlags) -> bool {
        flags.timeout.unwrap_or_else(|| {
            self.max_episode_steps
                .is_some_and(|limit| self.counter == limit - 1)
        })
    }

    /// `sequence_dataset`: the counter is reset before it is raised, so it is 1 at the second row's place.
    fn sequence_end(&mut self, flags: RowFlags) -> Option<EpisodeEnd> {
        let ends = flags.terminal || self.is_final(flags);
        if ends {
            self.counter = 0;
        }
        self.counter += 1;
        ends.then(|| kind(flags))
    }

    /// `qlearning_dataset`: a final row is skipped before the counter is raised, a terminal one after.
    fn push_qlearning(&mut self, flags: RowFlags) {
        let is_final = self.is_final(flags);
        if !self.terminate_on_end && is_final {
            self.counter = 0;
            self.end_before(self.row, EpisodeEnd::Truncated);
            self.row += 1;
            self.start = self.row;
            return;
        }
        let ends = flags.terminal || is_final;
        if ends {
            self.counter = 0;
        }
        self.counter += 1;
        self.row += 1;
        if ends {
            self.end_before(self.row, kind(flags));
        }
    }

    fn end_before(&mut self, row: u64, end: EpisodeEnd) {
        if row > self.start {
            let has_final_obs = self.policy == EpisodePolicy::D4rlQlearning;
            self.cuts.push(Cut {
                start: self.start,
                n_steps: row - self.start,
                has_final_obs,
                end,
            });
        }
        self.start = row;
    }
}

fn kind(flags: RowFlags) -> EpisodeEnd {
    if flags.terminal {
        EpisodeEnd::Terminated
    } else {
        EpisodeEnd::Truncated
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flags(text: &str) -> Vec<RowFlags> {
        let row = |c| RowFlags {
            terminal: c == 't',
            timeout: Some(c == 'o'),
            moved: c == 'm',
        };
        text.chars().map(row).collect()
    }

    fn without_timeouts(text: &str) -> Vec<RowFlags> {
        flags(text)
            .into_iter()
            .map(|row| RowFlags {
                timeout: None,
                ..row
            })
            .collect()
    }

    fn cut(policy: EpisodePolicy, limit: Option<u64>, rows: &[RowFlags]) -> Vec<(u64, u64)> {
        let has_timeouts = rows.first().is_none_or(|row| row.timeout.is_some());
        let mut cutter = Cutter::new(policy, has_timeouts, limit, false).unwrap();
        rows.iter().for_each(|row| cutter.push(*row));
        cutter
            .finish()
            .iter()
            .map(|cut| (cut.start, cut.start + cut.n_steps))
            .collect()
    }

    #[test]
    fn clean_keeps_every_row() {
        assert_eq!(
            cut(EpisodePolicy::Clean, None, &flags("..t.o..")),
            [(0, 3), (3, 5), (5, 7)]
        );
        assert_eq!(cut(EpisodePolicy::Clean, None, &flags("")), []);
        assert_eq!(
            cut(EpisodePolicy::Clean, None, &flags("tt")),
            [(0, 1), (1, 2)]
        );
    }

    #[test]
    fn the_clean_counter_does_not_drift_but_the_reference_one_does() {
        let rows = without_timeouts("..........");
        assert_eq!(
            cut(EpisodePolicy::Clean, Some(4), &rows),
            [(0, 4), (4, 8), (8, 10)]
        );
        assert_eq!(
            cut(EpisodePolicy::D4rlSequence, Some(4), &rows),
            [(0, 4), (4, 7), (7, 10)]
        );
    }

    #[test]
    fn sequence_drops_the_tail_and_qlearning_the_timeout_and_last_rows() {
        assert_eq!(
            cut(EpisodePolicy::D4rlSequence, None, &flags("..t.o..")),
            [(0, 3), (3, 5)]
        );
        assert_eq!(
            cut(EpisodePolicy::D4rlQlearning, None, &flags("..t.o..")),
            [(0, 3), (3, 4), (5, 6)]
        );
    }

    #[test]
    fn moves_start_a_new_episode() {
        assert_eq!(
            cut(EpisodePolicy::GoalChange, None, &flags("..m.o.m")),
            [(0, 2), (2, 6), (6, 7)]
        );
        assert_eq!(
            cut(EpisodePolicy::PositionJump, None, &flags("m.")),
            [(0, 2)]
        );
    }

    #[test]
    fn policies_say_what_they_need() {
        for policy in [
            EpisodePolicy::Timeouts,
            EpisodePolicy::D4rlSequence,
            EpisodePolicy::D4rlQlearning,
        ] {
            let error = Cutter::new(policy, false, None, false).unwrap_err();
            assert!(error.to_string().contains("timeouts"), "{error}");
        }
        assert!(Cutter::new(EpisodePolicy::Clean, false, Some(0), false).is_err());
    }
}
