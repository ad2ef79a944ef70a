//! What was found.

use std::fmt;
use std::path::PathBuf;

use crate::format::Format;

/// Places kept of each finding; the others are counted.
const MAX_PLACES: usize = 5;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Severity {
    /// The data is wrong or part of it cannot be used.
    Error,
    /// Probably a fault; results may depend on it.
    Warning,
    /// Worth knowing, often as it should be.
    Note,
}

impl Severity {
    /// Stable name: `error`, `warning` or `note`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Error => "error",
            Self::Warning => "warning",
            Self::Note => "note",
        }
    }
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Where in a dataset.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Place {
    /// Column, with the number of the value where one is meant: `observation[3]`.
    pub column: Option<String>,
    /// Episode number.
    pub episode: Option<i64>,
    /// Step number inside the episode.
    pub step: Option<i64>,
    /// File or folder, where it is not the dataset as a whole.
    pub file: Option<PathBuf>,
}

impl Place {
    /// A step of an episode.
    pub(super) fn step(episode: i64, step: i64) -> Self {
        Self {
            episode: Some(episode),
            step: Some(step),
            ..Self::default()
        }
    }

    /// An episode.
    pub(super) fn episode(episode: i64) -> Self {
        Self {
            episode: Some(episode),
            ..Self::default()
        }
    }

    /// A column.
    pub(super) fn column(name: impl Into<String>) -> Self {
        Self {
            column: Some(name.into()),
            ..Self::default()
        }
    }

    /// The same place, in a column.
    pub(super) fn of(mut self, column: impl Into<String>) -> Self {
        self.column = Some(column.into());
        self
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parts = [
            self.file.as_ref().map(|file| file.display().to_string()),
            self.column.clone(),
            self.episode.map(|episode| format!("episode {episode}")),
            self.step.map(|step| format!("step {step}")),
        ];
        let parts: Vec<String> = parts.into_iter().flatten().collect();
        f.write_str(&parts.join(" "))
    }
}

/// One fault, in all places where it occurs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// Stable name of this kind of fault, such as `not-finite`.
    pub code: &'static str,
    /// What is wrong, for people.
    pub message: String,
    /// The first places (of outliers, the largest ones).
    pub places: Vec<Place>,
    /// In how many places it occurs; 0 where it concerns the whole dataset.
    pub count: u64,
}

impl Finding {
    pub(super) fn new(severity: Severity, code: &'static str, message: impl Into<String>) -> Self {
        Self {
            severity,
            code,
            message: message.into(),
            places: Vec::new(),
            count: 0,
        }
    }

    pub(super) fn error(code: &'static str, message: impl Into<String>) -> Self {
        Self::new(Severity::Error, code, message)
    }

    pub(super) fn warning(code: &'static str, message: impl Into<String>) -> Self {
        Self::new(Severity::Warning, code, message)
    }

    pub(super) fn note(code: &'static str, message: impl Into<String>) -> Self {
        Self::new(Severity::Note, code, message)
    }

    pub(super) fn at(mut self, tally: Tally) -> Self {
        self.count = tally.count;
        self.places = tally.places;
        self
    }
}

/// How much was looked at.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Coverage {
    /// Episodes read.
    pub n_episodes: u64,
    /// Steps read; final-observation rows are not counted.
    pub n_steps: u64,
    /// Rows read.
    pub n_rows: u64,
    /// Names of the columns read.
    pub columns: Vec<String>,
    /// Names of the checks that applied to this dataset.
    pub checks: Vec<&'static str>,
    /// Whether everything was read.
    pub complete: bool,
}

/// The outcome of [`super::validate`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Report {
    /// Id of the dataset.
    pub id: String,
    /// Its format; `None` if it does not open.
    pub format: Option<Format>,
    /// The file or folder.
    pub path: PathBuf,
    /// How much was looked at.
    pub coverage: Coverage,
    /// What was found, worst first, then in the order of the checks.
    pub findings: Vec<Finding>,
}

impl Report {
    /// Number of findings of a severity.
    pub fn count(&self, severity: Severity) -> usize {
        let of = |finding: &&Finding| finding.severity == severity;
        self.findings.iter().filter(of).count()
    }

    /// The severity of the worst finding.
    pub fn worst(&self) -> Option<Severity> {
        self.findings.iter().map(|finding| finding.severity).min()
    }
}

/// Counts places and keeps the first few.
#[derive(Debug, Clone, Default)]
pub(super) struct Tally {
    pub(super) count: u64,
    places: Vec<Place>,
}

impl Tally {
    pub(super) fn add(&mut self, place: impl FnOnce() -> Place) {
        self.count += 1;
        if self.places.len() < MAX_PLACES {
            self.places.push(place());
        }
    }

    /// A tally of so many places, of which these are known.
    pub(super) fn of(count: u64, places: impl IntoIterator<Item = Place>) -> Self {
        Self {
            count,
            places: places.into_iter().take(MAX_PLACES).collect(),
        }
    }
}

/// `1 step`, `2 steps`.
pub(super) fn many(n: u64, what: &str) -> String {
    match n {
        1 => format!("1 {what}"),
        n => format!("{n} {what}s"),
    }
}

/// Where checks put what they found.
#[derive(Debug, Default)]
pub(super) struct Findings(Vec<Finding>);

impl Findings {
    pub(super) fn push(&mut self, finding: Finding) {
        self.0.push(finding);
    }

    /// Adds the finding if there is any place for it.
    pub(super) fn push_at(&mut self, tally: Tally, finding: impl FnOnce(u64) -> Finding) {
        if tally.count > 0 {
            self.0.push(finding(tally.count).at(tally));
        }
    }

    /// Worst first; equally bad ones stay in the order of the checks.
    pub(super) fn sorted(mut self) -> Vec<Finding> {
        self.0.sort_by_key(|finding| finding.severity);
        self.0
    }
}
