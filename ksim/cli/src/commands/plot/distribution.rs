//! `ksim plot distribution`: distances to the data.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Args;
use ksim::StepScore;
use ksim_bench_harness::figure::lines::{Line, Panel, draw};
use ksim_bench_harness::page::{HeldOut, Histogram};

use super::line_count;
use crate::context::Context;
use crate::figure_file;
use crate::outcome::CommandOutcome;
use crate::scoring::{Job, Session};
use crate::scoring_args::ScoringArgs;
use crate::table;

/// Draw the distribution of the distances between rollouts and the data, beside held-out demonstrations
///
/// Distances are d/√d, which does not saturate; a step up to γ scores 1. The last bin also holds what is farther. Held
/// out are some of the dataset's own episodes, each compared with all others.
#[derive(Debug, Clone, Args)]
pub(crate) struct DistributionArgs {
    /// Rollouts: Parquet files with an observation and an action column, or any dataset
    #[arg(required = true, value_name = "ROLLOUTS")]
    rollouts: Vec<String>,
    /// The figure to write: .svg, or .png or .pdf in a build with feature `figures`
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    scoring: ScoringArgs,
}

/// Scores, draws and writes.
pub(super) fn run(args: &DistributionArgs, context: &Context) -> Result<CommandOutcome> {
    figure_file::check(&args.output)?;
    line_count::check(args.rollouts.len())?;
    let job = Job {
        output: Some(args.output.clone()),
        ..args.scoring.job(&args.rollouts)?
    };
    let session = Session::open(&job, context)?;
    line_count::check(line_count::count(session.files(), &[])?)?;
    let reference = session.ksim().reference();
    let width = reference.states().n_features() + reference.actions().n_features();
    let root = (width as f64).sqrt();
    let scaled = |steps: &[StepScore]| -> Vec<f64> {
        steps.iter().map(|step| step.distance / root).collect()
    };
    let mut all = Vec::new();
    let results = session.score(&job, context, &mut |one| {
        all.push(scaled(&one.report.steps));
        Ok(())
    })?;
    let document = session.document(results, context);
    let mut names = table::labels(&document.results);
    let held = match HeldOut::score(session.ksim(), job.settings.seed) {
        Ok(held) => {
            all.push(scaled(&held.report.steps));
            names.push("held-out data".to_owned());
            true
        }
        Err(why) => {
            context.warn(&format!(
                "no demonstrations are held out to compare with: {why}"
            ));
            false
        }
    };
    let bins = Histogram::covering(all.iter().flatten().copied(), job.settings.gamma);
    let n = names.len();
    let lines = names.into_iter().zip(&all).enumerate();
    let lines = lines.map(|(place, (name, distances))| Line {
        name,
        is_dashed: held && place + 1 == n,
        points: outline(&bins, distances),
    });
    let panel = Panel {
        title: format!("K-Sim 1 up to d/√d = γ = {}", job.settings.gamma),
        x_label: x_label(&bins, all.iter().flatten().copied()),
        mark: Some((job.settings.gamma, "γ".to_owned())),
        y_label: "steps, %",
        lines: lines.collect(),
    };
    let heading = format!("Distances to {}", document.dataset.public_name());
    let svg = draw(&heading, &[panel]).context("there is nothing to draw")?;
    figure_file::write(&args.output, &svg)?;
    Ok(session.outcome())
}

/// What lies across; the last bin may be a peak of all that is farther.
fn x_label(bins: &Histogram, distances: impl Iterator<Item = f64>) -> String {
    let label = "distance to the matched step, d/√d";
    let last = bins.edges().last().copied().unwrap_or(f64::INFINITY);
    let n_beyond = distances.filter(|distance| *distance > last).count();
    match n_beyond {
        0 => label.to_owned(),
        _ => format!("{label}; the last bin holds all beyond {last}, too"),
    }
}

/// The outline of a histogram, in percent.
fn outline(bins: &Histogram, distances: &[f64]) -> Vec<[f64; 2]> {
    let counts = bins.counts(distances.iter().copied());
    let edges = bins.edges();
    let share = |count: u64| 100.0 * count as f64 / distances.len().max(1) as f64;
    let both = counts.iter().zip(edges.windows(2));
    both.flat_map(|(count, ends)| [[ends[0], share(*count)], [ends[1], share(*count)]])
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_last_bin_of_what_is_farther_says_so() {
        let near = [0.5; 1000];
        let bins = Histogram::covering(near.into_iter(), 0.5);
        assert!(!x_label(&bins, near.into_iter()).contains("beyond"));
        let far = near.into_iter().chain([9.0]);
        let bins = Histogram::covering(far.clone(), 0.5);
        assert!(x_label(&bins, far).ends_with("the last bin holds all beyond 1, too"));
    }
}
