//! How a command ended, and its exit code.

use std::process::ExitCode;

use ksim_datasets::{DatasetInfo, Warning};

/// The end of a command that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CommandOutcome {
    /// Done: exit code 0.
    Done,
    /// Done, but a reader repaired or left out data: exit code 3.
    DoneWithDataLoss,
    /// Done, and found what it was to look for: exit code 1.
    FaultsFound,
}

impl CommandOutcome {
    /// [`DoneWithDataLoss`](Self::DoneWithDataLoss) if any of the datasets was repaired on reading.
    pub(crate) fn of<'a>(datasets: impl IntoIterator<Item = &'a DatasetInfo>) -> Self {
        let repaired = datasets
            .into_iter()
            .any(|info| info.warnings.iter().any(is_data_loss));
        if repaired {
            Self::DoneWithDataLoss
        } else {
            Self::Done
        }
    }
}

impl From<CommandOutcome> for ExitCode {
    fn from(outcome: CommandOutcome) -> Self {
        match outcome {
            CommandOutcome::Done => Self::SUCCESS,
            CommandOutcome::DoneWithDataLoss => Self::from(3),
            CommandOutcome::FaultsFound => Self::FAILURE,
        }
    }
}

/// Whether states, actions or episode borders may not be what the file's author meant. A chosen default
/// or a column that no command reads is worth a word, but no exit code.
fn is_data_loss(warning: &Warning) -> bool {
    match warning {
        Warning::CountMismatch { .. }
        | Warning::EmptyEpisodes { .. }
        | Warning::NoEpisodeEnds { .. }
        | Warning::Lost { .. }
        | Warning::SpaceMismatch { .. }
        | Warning::UnreliableTimeouts => true,
        Warning::ColumnLeftOut { column, .. } => {
            column.starts_with("observation") || column.starts_with("action")
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_default_is_no_data_loss_but_a_lost_observation_is() {
        assert!(!is_data_loss(&Warning::NoEpisodeColumn));
        assert!(is_data_loss(&Warning::EmptyEpisodes { n_episodes: 1 }));
        let left_out = |column: &str| Warning::ColumnLeftOut {
            column: column.into(),
            reason: "",
        };
        assert!(is_data_loss(&left_out("observation.image")));
        assert!(!is_data_loss(&left_out("info.note")));
    }
}
