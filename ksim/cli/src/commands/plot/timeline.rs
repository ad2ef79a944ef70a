//! `ksim plot timeline`: K-Sim over the steps of episodes.

use std::ops::Range;
use std::path::PathBuf;

use anyhow::{Context as _, Result, bail};
use clap::Args;
use ksim_bench_harness::figure::lines::{Line, Panel, draw};

use super::paths::episodes;
use crate::context::Context;
use crate::figure_file;
use crate::outcome::CommandOutcome;
use crate::scoring::{Job, ScoredRollouts, Session};
use crate::scoring_args::ScoringArgs;
use crate::table;

/// Points of a line, at most: beyond, a point is the mean of several steps.
const POINTS: usize = 200;
/// Lines that can be told apart.
const LINES: usize = 6;

/// Draw K-Sim over the steps of episodes, and the share of saturated steps below it
///
/// A line per file or planner: the mean over its episodes. With --episodes, a line per episode.
#[derive(Debug, Clone, Args)]
pub(crate) struct TimelineArgs {
    /// Rollouts: Parquet files with an observation and an action column, or any dataset
    #[arg(required = true, value_name = "ROLLOUTS")]
    rollouts: Vec<String>,
    /// The figure to write: .svg, or .png or .pdf in a build with feature `figures`
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Draw these episodes each: numbers, 3-7 with both ends, 3..8 without the last
    #[arg(long, value_name = "0,3-7", value_delimiter = ',', value_parser = episodes)]
    episodes: Vec<Range<i64>>,
    #[command(flatten)]
    scoring: ScoringArgs,
}

/// Scores, draws and writes.
pub(super) fn run(args: &TimelineArgs, context: &Context) -> Result<CommandOutcome> {
    figure_file::check(&args.output)?;
    let job = Job {
        output: Some(args.output.clone()),
        ..args.scoring.job(&args.rollouts)?
    };
    let session = Session::open(&job, context)?;
    let mut scored = Vec::new();
    let results = session.score(&job, context, &mut |one| {
        scored.push(one);
        Ok(())
    })?;
    let document = session.document(results, context);
    let mut sets: Vec<(String, Vec<Vec<f64>>)> = Vec::new();
    for (label, one) in table::labels(&document.results).iter().zip(&scored) {
        let episodes = by_episode(one);
        if args.episodes.is_empty() {
            sets.push((
                label.clone(),
                episodes.into_iter().map(|(_, s)| s).collect(),
            ));
            continue;
        }
        let chosen = episodes.into_iter().filter(|(number, _)| {
            let mut ranges = args.episodes.iter();
            ranges.any(|range| range.contains(number))
        });
        sets.extend(chosen.map(|(number, scores)| (format!("{label} {number}"), vec![scores])));
    }
    if sets.is_empty() {
        bail!("none of the rollouts has such an episode");
    }
    if sets.len() > LINES {
        bail!(
            "{} lines are too many to be told apart, at most {LINES}: choose by --episodes or draw fewer files",
            sets.len()
        );
    }
    let panel = |title: &str, y_label, of: &dyn Fn(f64) -> f64| Panel {
        title: title.to_owned(),
        x_label: "step".to_owned(),
        y_label,
        lines: sets
            .iter()
            .map(|(name, episodes)| line(name, episodes, of))
            .collect(),
    };
    let mean = match args.episodes.is_empty() {
        true => "K-Sim, mean over episodes",
        false => "K-Sim",
    };
    let panels = [
        panel(mean, "K-Sim of the step", &|score| score),
        panel("Saturated steps", "share with K-Sim 1", &|score| {
            f64::from(u8::from(score == 1.0))
        }),
    ];
    let heading = format!("Compared with {}", document.dataset.name);
    let svg = draw(&heading, &panels).context("there is nothing to draw")?;
    figure_file::write(&args.output, &svg)?;
    Ok(session.outcome())
}

/// Scores of every episode that has steps, with its number.
fn by_episode(scored: &ScoredRollouts) -> Vec<(i64, Vec<f64>)> {
    let episodes = scored.steps.trajectories.episodes().iter();
    let episodes = episodes.filter(|episode| !episode.rows.is_empty());
    episodes
        .map(|episode| {
            let steps = &scored.report.steps[episode.rows.clone()];
            (
                episode.episode_index,
                steps.iter().map(|step| step.score).collect(),
            )
        })
        .collect()
}

/// Means over episodes and runs of steps.
fn line(name: &str, episodes: &[Vec<f64>], of: &dyn Fn(f64) -> f64) -> Line {
    let longest = episodes.iter().map(Vec::len).max().unwrap_or(0);
    let run = longest.div_ceil(POINTS).max(1);
    let point = |start: usize| {
        let steps = episodes
            .iter()
            .flat_map(|scores| scores.iter().skip(start).take(run));
        let (sum, n) = steps.fold((0.0, 0u32), |(sum, n), score| (sum + of(*score), n + 1));
        let middle = start as f64 + (run.min(longest - start) - 1) as f64 / 2.0;
        [middle, sum / f64::from(n)]
    };
    Line {
        name: name.to_owned(),
        is_dashed: false,
        points: (0..longest).step_by(run).map(point).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_is_the_mean_of_all_episodes_that_reach_it() {
        let episodes = [vec![0.0, 1.0, 0.5], vec![1.0]];
        assert_eq!(
            line("", &episodes, &|s| s).points,
            [[0.0, 0.5], [1.0, 1.0], [2.0, 0.5]]
        );
        let long = line("", &[vec![0.25; 501]], &|s| s);
        assert_eq!((long.points.len(), long.points[0]), (167, [1.0, 0.25]));
        assert_eq!(long.points[166], [499.0, 0.25]);
    }
}
