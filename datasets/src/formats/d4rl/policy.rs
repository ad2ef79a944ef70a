//! Where an episode of a D4RL file ends.

use std::fmt;
use std::str::FromStr;

use crate::error::DatasetError;
use crate::source::Warning;

/// How the rows of a D4RL file are cut into episodes. The files only hold flags, and several families hold
/// wrong ones, so the rule is the user's choice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum EpisodePolicy {
    /// An episode ends at a terminal or a time-out; what is left at the end is kept as `cut`. Without
    /// `timeouts` a step limit, if given, ends an episode after exactly that many steps.
    Clean,
    /// Ends at time-outs only. For antmaze v2, whose `terminals` flicker near the goal.
    Timeouts,
    /// Ends where `infos/goal` changes. For maze2d, whose episodes have no ends.
    GoalChange,
    /// Ends where the position (first two observation columns) jumps by more than 1. For antmaze v0 and v1,
    /// whose time-outs are out of phase with the resets.
    PositionJump,
    /// The rows and cuts of D4RL's `sequence_dataset`: the tail without an end flag is dropped, and without
    /// `timeouts` the step counter starts at 1, not 0, in every episode but the first.
    D4rlSequence,
    /// The rows of D4RL's `qlearning_dataset`, in `float32`: the last row of the file is dropped, time-out
    /// rows are dropped unless `terminate_on_end`. An episode's final observation is the next row of the
    /// file, as that function takes it, even where that row starts the next episode (at a terminal).
    D4rlQlearning,
}

impl EpisodePolicy {
    /// All policies, in the order of their description.
    pub const ALL: [Self; 6] = [
        Self::Clean,
        Self::Timeouts,
        Self::GoalChange,
        Self::PositionJump,
        Self::D4rlSequence,
        Self::D4rlQlearning,
    ];

    /// Stable name, as on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Clean => "clean",
            Self::Timeouts => "timeouts",
            Self::GoalChange => "goal-change",
            Self::PositionJump => "position-jump",
            Self::D4rlSequence => "d4rl-sequence",
            Self::D4rlQlearning => "d4rl-qlearning",
        }
    }

    /// The policy for a file of this name, with the warning that says so. Only names of the antmaze family
    /// (`Ant_maze_..._sparse[_fixed].hdf5`, `antmaze-*-v{0,1,2}`) get another policy than [`Self::Clean`].
    pub fn default_for(file_name: &str) -> (Self, Option<Warning>) {
        let name = file_name.to_ascii_lowercase().replace('_', "");
        let is_antmaze = name.starts_with("antmaze");
        let chosen = |policy: Self, reason| {
            (
                policy,
                Some(Warning::PolicyByName {
                    policy: policy.name(),
                    reason,
                }),
            )
        };
        if is_antmaze && (name.contains("-v2") || name.contains("fixed")) {
            return chosen(
                Self::Timeouts,
                "antmaze v2 raises `terminals` on every row near the goal",
            );
        }
        if is_antmaze && (name.contains("-v0") || name.contains("-v1") || name.contains("sparse")) {
            return chosen(
                Self::PositionJump,
                "antmaze v0 and v1 have time-outs out of phase with the resets",
            );
        }
        (Self::Clean, None)
    }
}

impl fmt::Display for EpisodePolicy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for EpisodePolicy {
    type Err = DatasetError;

    fn from_str(name: &str) -> Result<Self, DatasetError> {
        Self::ALL
            .into_iter()
            .find(|policy| policy.name() == name)
            .ok_or_else(|| {
                let expected = Self::ALL.map(Self::name).join(", ");
                DatasetError::UnknownPolicy {
                    name: name.to_owned(),
                    expected,
                }
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_back() {
        for policy in EpisodePolicy::ALL {
            assert_eq!(policy.to_string().parse::<EpisodePolicy>().unwrap(), policy);
        }
        assert!("Clean".parse::<EpisodePolicy>().is_err());
    }

    #[test]
    fn only_antmaze_gets_another_default() {
        let of = |name| EpisodePolicy::default_for(name).0;
        assert_eq!(
            of("Ant_maze_u-maze_noisy_multistart_False_multigoal_False_sparse_fixed.hdf5"),
            EpisodePolicy::Timeouts
        );
        assert_eq!(of("antmaze-large-play-v2.hdf5"), EpisodePolicy::Timeouts);
        assert_eq!(
            of("Ant_maze_umaze_noisy_multistart_False_multigoal_False_sparse.hdf5"),
            EpisodePolicy::PositionJump
        );
        assert_eq!(of("hopper_medium-v2.hdf5"), EpisodePolicy::Clean);
        assert_eq!(of("ant_medium-v2.hdf5"), EpisodePolicy::Clean);
        assert_eq!(of("antmaze_custom.hdf5"), EpisodePolicy::Clean);
    }
}
