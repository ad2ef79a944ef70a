//! `ksim plot timeline`: K-Sim over the steps of episodes.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::PathBuf;

use anyhow::{Context as _, Result, bail};
use clap::Args;
use ksim_bench_harness::figure::lines::{Line, Panel, draw};

use super::line_count;
use super::paths::episodes;
use crate::context::Context;
use crate::figure_file;
use crate::outcome::CommandOutcome;
use crate::scoring::{Job, ScoredRollouts, Session};
use crate::scoring_args::ScoringArgs;
use crate::table;

/// Points of a line, at most: beyond, a point is the mean of several steps.
const POINTS: u64 = 200;

/// Draw K-Sim over the steps of episodes, and the share of saturated steps below it
///
/// A line per file or planner, over the recorded numbers of steps: the mean over those of its episodes that reach a
/// step. Of long episodes a point is the mean over a run of steps. With --episodes, a line per episode.
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
    if args.episodes.is_empty() {
        line_count::check(args.rollouts.len())?;
    }
    let job = Job {
        output: Some(args.output.clone()),
        ..args.scoring.job(&args.rollouts)?
    };
    let session = Session::open(&job, context)?;
    let n_lines = line_count::count(session.files(), &args.episodes)?;
    if n_lines == 0 {
        bail!("none of the rollouts has such an episode");
    }
    line_count::check(n_lines)?;
    let mut scored = Vec::new();
    let results = session.score(&job, context, &mut |one| {
        scored.push(one);
        Ok(())
    })?;
    let document = session.document(results, context);
    let mut sets: Vec<(String, Vec<Step>)> = Vec::new();
    for (label, one) in table::labels(&document.results).iter().zip(&scored) {
        let episodes = by_episode(one);
        if args.episodes.is_empty() {
            let steps = episodes.into_iter().flat_map(|(_, steps)| steps);
            sets.push((label.clone(), steps.collect()));
            continue;
        }
        let chosen = episodes.into_iter().filter(|(number, _)| {
            let mut ranges = args.episodes.iter();
            ranges.any(|range| range.contains(number))
        });
        sets.extend(chosen.map(|(number, steps)| (format!("{label} {number}"), steps)));
    }
    let runs = Runs::over(sets.iter().flat_map(|(_, steps)| steps));
    let panel = |title: &str, y_label, of: &dyn Fn(f64) -> f64| Panel {
        title: title.to_owned(),
        x_label: match runs.length {
            1 => "step".to_owned(),
            n => format!("step; a point is the mean over {n} steps"),
        },
        y_label,
        mark: None,
        lines: sets
            .iter()
            .map(|(name, steps)| line(name, steps, &runs, of))
            .collect(),
    };
    let mean = match args.episodes.is_empty() {
        true => "K-Sim, mean over the episodes that reach the step",
        false => "K-Sim",
    };
    let panels = [
        panel(mean, "K-Sim of the step", &|score| score),
        panel("Saturated steps", "share with K-Sim 1", &|score| {
            f64::from(u8::from(score == 1.0))
        }),
    ];
    let heading = format!("Compared with {}", document.dataset.public_name());
    let svg = draw(&heading, &panels).context("there is nothing to draw")?;
    figure_file::write(&args.output, &svg)?;
    Ok(session.outcome())
}

/// Recorded number and score of a step.
type Step = (i64, f64);

/// The steps of every episode that has some, with its number.
fn by_episode(scored: &ScoredRollouts) -> Vec<(i64, Vec<Step>)> {
    let episodes = scored.steps.trajectories.episodes().iter();
    let episodes = episodes.filter(|episode| !episode.rows.is_empty());
    let step = |row: usize, position: usize| {
        let number = scored.steps.number(row, position);
        (number, scored.report.steps[row].score)
    };
    episodes
        .map(|episode| {
            let rows = episode.rows.clone().enumerate();
            let steps = rows.map(|(position, row)| step(row, position));
            (episode.episode_index, steps.collect())
        })
        .collect()
}

/// Runs of consecutive numbers, each of which is a point: the same for all lines.
struct Runs {
    first: i64,
    /// How many numbers there are from the first to the last.
    span: u64,
    /// How many of them are in a run.
    length: u64,
}

impl Runs {
    fn over<'a>(steps: impl Iterator<Item = &'a Step>) -> Self {
        let ends = steps.fold(None, |ends: Option<(i64, i64)>, (number, _)| {
            let (first, last) = ends.unwrap_or((*number, *number));
            Some((first.min(*number), last.max(*number)))
        });
        let (first, last) = ends.unwrap_or((0, 0));
        let span = last.abs_diff(first).saturating_add(1);
        Self {
            first,
            span,
            length: span.div_ceil(POINTS),
        }
    }

    fn of(&self, number: i64) -> u64 {
        number.abs_diff(self.first) / self.length
    }

    fn middle(&self, run: u64) -> f64 {
        let start = run * self.length;
        let length = self.length.min(self.span - start);
        self.first as f64 + start as f64 + (length - 1) as f64 / 2.0
    }
}

/// Means over the steps of every run that has some.
fn line(name: &str, steps: &[Step], runs: &Runs, of: &dyn Fn(f64) -> f64) -> Line {
    let mut sums = BTreeMap::<u64, (f64, u32)>::new();
    for (number, score) in steps {
        let (sum, n) = sums.entry(runs.of(*number)).or_default();
        *sum += of(*score);
        *n += 1;
    }
    let points = sums.into_iter();
    Line {
        name: name.to_owned(),
        is_dashed: false,
        points: points
            .map(|(run, (sum, n))| [runs.middle(run), sum / f64::from(n)])
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(steps: &[Step]) -> Vec<[f64; 2]> {
        line("", steps, &Runs::over(steps.iter()), &|score| score).points
    }

    #[test]
    fn a_point_is_the_mean_of_all_episodes_that_reach_it() {
        let steps = [(0, 0.0), (1, 1.0), (2, 0.5), (0, 1.0)];
        assert_eq!(points(&steps), [[0.0, 0.5], [1.0, 1.0], [2.0, 0.5]]);
        let long: Vec<Step> = (0..501).map(|number| (number, 0.25)).collect();
        let long = points(&long);
        assert_eq!((long.len(), long[0]), (167, [1.0, 0.25]));
        assert_eq!(long[166], [499.0, 0.25]);
    }

    #[test]
    fn points_lie_at_recorded_numbers_however_far_apart() {
        assert_eq!(
            points(&[(100, 0.5), (104, 1.0)]),
            [[100.0, 0.5], [104.0, 1.0]]
        );
        let far = points(&[(i64::MIN, 0.0), (i64::MAX, 1.0)]);
        assert_eq!((far.len(), far[1][1]), (2, 1.0));
    }
}
