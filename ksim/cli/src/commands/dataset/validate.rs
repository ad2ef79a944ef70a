//! `ksim dataset validate`: faults in a dataset.

use std::fmt::Write as _;
use std::num::NonZero;

use anyhow::Result;
use clap::{Args, ValueEnum};
use ksim_datasets::SearchRoots;
use ksim_datasets::validate::{self, Finding, Report, Severity};
use serde_json::{Value, json};

use crate::context::Context;
use crate::data_args::DataArgs;
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};

/// Name and version of the schema of `ksim dataset validate --format json`.
const SCHEMA: &str = "ksim.dataset-validate/1";

/// Look for faults: lengths, flags, NaN, duplicates, jumps, time stamps
///
/// Reads the whole dataset once. Errors are data that is wrong or cannot be used, warnings are probable
/// faults, notes are worth knowing and often as it should be.
#[derive(Debug, Clone, Args)]
#[command(after_help = "\
Exit codes: 0 nothing as bad as --fail-on, 1 something as bad or no such dataset, 2 usage.
docs/validate.md lists every code with its meaning.")]
pub(crate) struct ValidateArgs {
    /// A file, a folder, or a name such as antmaze-large-play
    #[arg(value_name = "NAME|PATH")]
    dataset: String,
    /// How to print what was found
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
    /// The least severity that makes the exit code 1
    #[arg(long, value_enum, default_value_t = FailOn::Error)]
    fail_on: FailOn,
    /// Print no more findings than this, worst first
    #[arg(long, value_name = "N", default_value = "50")]
    max_findings: NonZero<u32>,
    #[command(flatten)]
    data: DataArgs,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum FailOn {
    /// Errors
    Error,
    /// Errors and warnings
    Warning,
    /// Nothing: 0 whatever is found
    Never,
}

impl FailOn {
    fn is_met_by(self, report: &Report) -> bool {
        let limit = match self {
            Self::Error => Severity::Error,
            Self::Warning => Severity::Warning,
            Self::Never => return false,
        };
        // The worst severity is the smallest.
        report.worst().is_some_and(|worst| worst <= limit)
    }
}

/// Runs the command.
pub(crate) fn run(args: &ValidateArgs, context: &Context) -> Result<CommandOutcome> {
    let resolved = ksim_datasets::resolve(&args.dataset, &SearchRoots::from_env())?;
    let progress = context.spinner(format!("reading {}", resolved.path.display()));
    let report = validate::validate_path(&resolved.path, &args.data.open_options());
    drop(progress);
    let shown = usize::try_from(args.max_findings.get()).unwrap_or(usize::MAX);
    match args.format {
        OutputFormat::Text => output::text(&text(&report, shown))?,
        OutputFormat::Json => output::json(&document(&report, shown))?,
    }
    Ok(match args.fail_on.is_met_by(&report) {
        true => CommandOutcome::FaultsFound,
        false => CommandOutcome::Done,
    })
}

fn document(report: &Report, shown: usize) -> Value {
    let coverage = &report.coverage;
    let findings = report.findings.iter().take(shown).map(finding_json);
    json!({
        "schema": SCHEMA,
        "id": report.id,
        "format": report.format.map(ksim_datasets::Format::name),
        "path": report.path.display().to_string(),
        "complete": coverage.complete,
        "n_episodes": coverage.n_episodes,
        "n_steps": coverage.n_steps,
        "n_rows": coverage.n_rows,
        "columns": coverage.columns,
        "checks": coverage.checks,
        "n_errors": report.count(Severity::Error),
        "n_warnings": report.count(Severity::Warning),
        "n_notes": report.count(Severity::Note),
        "findings": findings.collect::<Vec<_>>(),
        "n_findings_left_out": report.findings.len().saturating_sub(shown),
    })
}

fn finding_json(finding: &Finding) -> Value {
    let places = finding.places.iter().map(|place| {
        json!({
            "column": place.column,
            "episode": place.episode,
            "step": place.step,
            "file": place.file.as_ref().map(|file| file.display().to_string()),
        })
    });
    json!({
        "severity": finding.severity.name(),
        "code": finding.code,
        "message": finding.message,
        "count": finding.count,
        "places": places.collect::<Vec<_>>(),
    })
}

fn text(report: &Report, shown: usize) -> String {
    let mut text = heading(report);
    for finding in report.findings.iter().take(shown) {
        // Nothing can go wrong when writing to a string.
        let _ = writeln!(
            text,
            "{:7}  {}: {}",
            finding.severity.name(),
            finding.code,
            finding.message
        );
        if let Some(places) = places(finding) {
            let _ = writeln!(text, "         {places}");
        }
    }
    let left_out = report.findings.len().saturating_sub(shown);
    if left_out > 0 {
        let _ = writeln!(text, "{left_out} more findings (--max-findings)");
    }
    text
}

/// What was looked at, and how it went.
fn heading(report: &Report) -> String {
    let coverage = &report.coverage;
    let plural = |n: usize, what: &str| match n {
        1 => format!("1 {what}"),
        n => format!("{n} {what}s"),
    };
    let counts = [
        (Severity::Error, "error"),
        (Severity::Warning, "warning"),
        (Severity::Note, "note"),
    ];
    let counts: Vec<String> = counts
        .into_iter()
        .map(|(severity, name)| (report.count(severity), name))
        .filter(|(n, _)| *n > 0)
        .map(|(n, name)| plural(n, name))
        .collect();
    let outcome = match counts.as_slice() {
        [] => "nothing found".to_owned(),
        counts => counts.join(", "),
    };
    let Some(format) = report.format else {
        return format!("{}: {outcome}\n", report.path.display());
    };
    let unread = if coverage.complete {
        ""
    } else {
        ", then reading failed"
    };
    format!(
        "{} ({format}): {} episodes, {} steps, {} columns, {} checks{unread}: {outcome}\n",
        report.id,
        coverage.n_episodes,
        coverage.n_steps,
        coverage.columns.len(),
        coverage.checks.len(),
    )
}

fn places(finding: &Finding) -> Option<String> {
    let known: Vec<String> = finding.places.iter().map(ToString::to_string).collect();
    if known.is_empty() {
        return None;
    }
    let more = finding.count.saturating_sub(known.len() as u64);
    Some(match more {
        0 => known.join("; "),
        1 => format!("{}; 1 more place", known.join("; ")),
        more => format!("{}; {more} more places", known.join("; ")),
    })
}
