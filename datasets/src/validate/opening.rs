//! What is known before the rows, and counts against them.

use std::error::Error;
use std::path::Path;

use super::report::{Coverage, Finding, Findings, Place, Severity, Tally};
use crate::error::DatasetError;
use crate::source::{DatasetInfo, Warning};

/// A dataset, or a part of it, that cannot be read.
pub(super) fn unreadable(path: &Path, error: &DatasetError) -> Finding {
    // The path is the place; the rest of the chain is what happened.
    let mut parts = Vec::new();
    let mut next: Option<&dyn Error> = Some(error.cause());
    while let Some(error) = next {
        parts.push(error.to_string());
        next = error.source();
    }
    let file = match error {
        DatasetError::InFile { path, .. } => path,
        _ => path,
    };
    let place = Place {
        file: Some(file.to_owned()),
        ..Place::default()
    };
    Finding::error("unreadable", parts.join(": ")).at(Tally::of(1, [place]))
}

/// What the reader warned of.
pub(super) fn warnings(info: &DatasetInfo, found: &mut Findings) {
    for warning in &info.warnings {
        let (severity, code) = grade(warning);
        found.push(Finding::new(severity, code, warning.to_string()));
    }
}

fn grade(warning: &Warning) -> (Severity, &'static str) {
    use Severity::{Error, Note, Warning as Odd};
    match warning {
        Warning::Lost { .. } => (Error, "lost-data"),
        Warning::CountMismatch { .. } => (Error, "count-mismatch"),
        Warning::UnreliableTimeouts => (Error, "unreliable-timeouts"),
        Warning::NoEpisodeColumn => (Odd, "no-episode-column"),
        Warning::NoEpisodeEnds { .. } => (Odd, "no-episode-ends"),
        Warning::EmptyEpisodes { .. } => (Odd, "empty-episodes"),
        Warning::NoFinalObservation { .. } => (Odd, "no-final-observation"),
        Warning::SpaceMismatch { .. } => (Odd, "space-mismatch"),
        Warning::ColumnLeftOut { column, .. }
            if column.starts_with("observation") || column.starts_with("action") =>
        {
            (Odd, "column-left-out")
        }
        Warning::ColumnLeftOut { .. } => (Note, "column-left-out"),
        Warning::PolicyByName { .. } => (Note, "policy-by-name"),
        Warning::NoSpace => (Note, "no-space"),
        _ => (Odd, "reader-warning"),
    }
}

/// Counts of the description against the rows, and a dataset without steps.
pub(super) fn counts(info: &DatasetInfo, coverage: &Coverage, found: &mut Findings) {
    let counts = [
        ("episodes", info.n_episodes, coverage.n_episodes),
        ("steps", info.n_steps, coverage.n_steps),
    ];
    for (what, recorded, actual) in counts {
        if let Some(recorded) = recorded.filter(|recorded| *recorded != actual) {
            found.push(Finding::error(
                "count-mismatch",
                format!("the dataset declares {recorded} {what}, its rows are {actual}"),
            ));
        }
    }
    if coverage.n_steps == 0 {
        found.push(Finding::error("no-steps", "the dataset has no steps"));
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::format::Format;

    #[test]
    fn an_error_names_its_file_once() {
        let error = DatasetError::corrupt("cut off").in_file(Path::new("a.hdf5"));
        let finding = unreadable(Path::new("folder"), &error);
        assert_eq!(finding.message, "corrupt file: cut off");
        assert_eq!(finding.places[0].to_string(), "a.hdf5");
    }

    #[test]
    fn warnings_are_graded_and_true_counts_are_silent() {
        let mut info = DatasetInfo::new("x".into(), Format::Parquet, PathBuf::new());
        info.warnings = vec![
            Warning::NoSpace,
            Warning::Lost {
                what: "a chunk".into(),
            },
        ];
        info.n_steps = Some(3);
        let coverage = |n_steps| Coverage {
            n_steps,
            ..Coverage::default()
        };
        let codes = |n_steps| {
            let mut found = Findings::default();
            warnings(&info, &mut found);
            counts(&info, &coverage(n_steps), &mut found);
            found
                .sorted()
                .iter()
                .map(|finding| finding.code)
                .collect::<Vec<_>>()
        };
        assert_eq!(codes(3), ["lost-data", "no-space"]);
        assert_eq!(codes(2), ["lost-data", "count-mismatch", "no-space"]);
        assert_eq!(
            codes(0),
            ["lost-data", "count-mismatch", "no-steps", "no-space"]
        );
    }
}
