//! `ksim plot paths`: the way of an agent through a maze.

use std::ops::Range;
use std::path::PathBuf;

use anyhow::{Context as _, Result, bail};
use clap::{Args, ValueEnum};
use ksim_bench_harness::figure::paths::{EpisodePath, Layout, Measure, draw_by};
use ksim_datasets::{DatasetInfo, EpisodeRecord, OpenOptions};
use ksim_envs::maze::Maze;
use ksim_envs::registry::{self, EnvironmentRequest};

use super::episodes::read;
use super::step_scores::StepScores;
use crate::atomic;
use crate::commands::convert::episode_range;
use crate::context::Context;
use crate::data_args::{self, DataArgs};
use crate::figure_file;
use crate::mazes::maze_of;
use crate::novelty::novelties;
use crate::outcome::CommandOutcome;
use crate::pairing::Listed;
use crate::positions;
use crate::rollout_args::of_dataset;

/// Episodes that are drawn where none are chosen, at most.
const MAX_EPISODES: usize = 12;

/// Draw the paths of episodes in their maze
///
/// Paths are colored by step, by the K-Sim of each step if --per-step gives what `ksim score --per-step` wrote, or by
/// the novelty of a planner's plans.
/// Rollouts of ksim and Minari datasets know their maze; for other files say --env or --dataset.
#[derive(Debug, Clone, Args)]
pub(crate) struct PathsArgs {
    /// Rollouts, or any dataset, with positions in observation.achieved_goal or info.qpos, or in a single vector
    /// like that of --dataset
    #[arg(value_name = "ROLLOUTS")]
    rollouts: String,
    /// The figure to write: .svg, or .png or .pdf in a build with feature `figures`
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Episodes to draw: numbers, 3-7 with both ends, 3..8 without the last [default: the first 12]
    #[arg(long, value_name = "0,3-7", value_delimiter = ',', value_parser = episodes)]
    episodes: Vec<Range<i64>>,
    /// A panel for every episode, or all in one
    #[arg(long, value_enum, default_value_t = LayoutArg::Panels)]
    layout: LayoutArg,
    /// Color by these scores
    #[arg(long, value_name = "FILE.parquet", conflicts_with = "color")]
    per_step: Option<PathBuf>,
    /// Color by step, or by how novel the plan under way was to its planner
    #[arg(long, value_enum, default_value_t = ColorArg::Step)]
    color: ColorArg,
    /// The maze of this environment, whatever --dataset was collected in
    #[arg(long, value_name = "ID")]
    env: Option<String>,
    /// The maze that this dataset was collected in; its observations say where positions lie in a single vector
    #[arg(long, value_name = "NAME|PATH")]
    dataset: Option<String>,
    #[command(flatten)]
    data: DataArgs,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum LayoutArg {
    Panels,
    Together,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ColorArg {
    /// The number of the step
    Step,
    /// What `ksim rollout --planner` recorded as info.novelty
    Novelty,
}

impl From<LayoutArg> for Layout {
    fn from(layout: LayoutArg) -> Self {
        match layout {
            LayoutArg::Panels => Self::Panels,
            LayoutArg::Together => Self::Together,
        }
    }
}

/// Numbers, and ranges in both spellings.
pub(super) fn episodes(text: &str) -> Result<Range<i64>> {
    match text.split_once('-') {
        Some((first, last)) if !first.is_empty() => {
            let one = |text: &str| text.parse::<i64>().with_context(|| format!("\"{text}\""));
            let (first, last) = (one(first)?, one(last)?);
            if first > last {
                bail!("an empty range");
            }
            Ok(first..last.checked_add(1).context("too large")?)
        }
        _ => episode_range(text),
    }
}

/// Draws and writes.
pub(super) fn run(args: &PathsArgs, context: &Context) -> Result<CommandOutcome> {
    atomic::check_target(&args.output)?;
    let options = args.data.open_options();
    let (resolved, source) = data_args::open(&args.rollouts, &options)?;
    let inputs = [Some(resolved.path.as_path()), args.per_step.as_deref()];
    atomic::check_not_an_input(&args.output, inputs.into_iter().flatten())?;
    figure_file::check(&args.output)?;
    let info = source.info();
    let maze = maze(args, info)?;
    let all = source.episodes()?;
    let n_all = all.len();
    let chosen = choose(all, &args.episodes)?;
    let mut heading = heading(info);
    if chosen.len() < n_all && args.episodes.is_empty() {
        let first = format!("the first {} of {n_all} episodes", chosen.len());
        context.warn(&format!("{first} are drawn; --episodes chooses others"));
        heading = format!("{heading}: {first}");
    }
    // A dataset that only tells the maze need not be on this machine.
    let dataset = match &args.dataset {
        Some(name) if !positions::has_own(&*source) => {
            Some(data_args::open(name, &OpenOptions::default())?)
        }
        _ => None,
    };
    let listed = Listed::new(&options, &OpenOptions::default());
    let paired = dataset.as_ref().map(|(_, dataset)| (&**dataset, listed));
    let mut paths: Vec<EpisodePath> = read(&*source, &chosen, paired)?;
    if let Some(file) = &args.per_step {
        let scores = StepScores::read(file)?;
        for (path, episode) in paths.iter_mut().zip(&chosen) {
            path.scores = Some(scores.of(episode.episode_index, file)?);
        }
    }
    let mut measure = Measure::KSim;
    if args.color == ColorArg::Novelty {
        measure = Measure::Novelty;
        for (path, novelties) in paths.iter_mut().zip(novelties(&*source, &chosen)?) {
            path.scores = Some(novelties);
        }
    }
    let svg = draw_by(&heading, &maze, &paths, args.layout.into(), measure)
        .with_context(|| info.path.display().to_string())?;
    figure_file::write(&args.output, &svg)?;
    Ok(CommandOutcome::of([info]))
}

/// What the figure shows, as far as the file says.
fn heading(info: &DatasetInfo) -> String {
    match info
        .metadata
        .get("policy")
        .and_then(|policy| policy.as_str())
    {
        Some(policy) => format!("{} in {}", policy, info.id),
        None => info.id.clone(),
    }
}

/// The episodes asked for, in the order of the file; the first few if none are.
fn choose(all: Vec<EpisodeRecord>, wanted: &[Range<i64>]) -> Result<Vec<EpisodeRecord>> {
    if wanted.is_empty() {
        return Ok(all.into_iter().take(MAX_EPISODES).collect());
    }
    for range in wanted {
        if !all
            .iter()
            .any(|episode| range.contains(&episode.episode_index))
        {
            bail!(
                "no episode in {}..{}; there are {}",
                range.start,
                range.end,
                all.len()
            );
        }
    }
    let is_wanted = |episode: &EpisodeRecord| {
        wanted
            .iter()
            .any(|range| range.contains(&episode.episode_index))
    };
    Ok(all.into_iter().filter(is_wanted).collect())
}

fn maze(args: &PathsArgs, info: &DatasetInfo) -> Result<Maze> {
    let request = match (&args.env, &args.dataset) {
        (Some(id), _) => EnvironmentRequest::of_id(id),
        (None, Some(name)) => of_dataset(name)?.request,
        (None, None) => {
            let found = registry::for_dataset(info);
            found
                .context("the maze is not known: say --env ID or --dataset NAME")?
                .request
        }
    };
    maze_of(&request)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_written_both_ways() {
        assert_eq!(episodes("3-7").unwrap(), episodes("3..8").unwrap());
        assert_eq!(episodes("4").unwrap(), 4..5);
        for wrong in ["7-3", "3-", "-", "a-b", "3..3"] {
            assert!(episodes(wrong).is_err(), "{wrong}");
        }
    }
}
