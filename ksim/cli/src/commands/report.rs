//! `ksim report`.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Args;
use ksim_bench_harness::page;
use ksim_envs::registry::{self, EnvironmentRequest};

use crate::atomic;
use crate::context::Context;
use crate::mazes::maze_of;
use crate::outcome::CommandOutcome;
use crate::output;
use crate::reporting::{self, Request};
use crate::scoring::{Job, Session};
use crate::scoring_args::ScoringArgs;

/// Score rollouts and write what came of it as a page to look at
///
/// The page is one HTML file that loads nothing: it works offline and can be sent to anyone. It shows the numbers of
/// `ksim score`, every episode step by step beside the demonstrations it was matched with, and the worst steps.
#[derive(Debug, Clone, Args)]
pub(crate) struct ReportArgs {
    /// Rollouts: Parquet files with an observation and an action column, or any dataset
    #[arg(required = true, value_name = "ROLLOUTS")]
    rollouts: Vec<String>,
    /// The page to write
    #[arg(short, long, value_name = "FILE.html")]
    output: PathBuf,
    /// What the page is called [default: the names of rollouts and dataset]
    #[arg(long, value_name = "TEXT")]
    title: Option<String>,
    /// Draw paths in the maze of this environment [default: in that of the dataset, if it has one]
    ///
    /// Positions are in observation.achieved_goal or info.qpos of dataset and rollouts.
    #[arg(long, value_name = "ID")]
    env: Option<String>,
    #[command(flatten)]
    scoring: ScoringArgs,
}

/// Scores and writes the page.
pub(crate) fn run(args: &ReportArgs, context: &Context) -> Result<CommandOutcome> {
    let job = Job {
        output: Some(args.output.clone()),
        ..args.scoring.job(&args.rollouts)?
    };
    let asked_for = match &args.env {
        Some(id) => Some(maze_of(&EnvironmentRequest::of_id(id))?),
        None => None,
    };
    let needs_positions = asked_for.is_some();
    let session = Session::open_checked(&job, context, &|dataset, files| {
        reporting::check(dataset, files, (&job, needs_positions))
    })?;
    let of_dataset = || {
        let found = registry::for_dataset(session.dataset().info()).ok()?;
        maze_of(&found.request).ok()
    };
    let request = Request {
        job: &job,
        session: &session,
        maze: asked_for.or_else(of_dataset),
        needs_positions,
        context,
    };
    let mut page = reporting::page(&request)?;
    if let Some(title) = &args.title {
        page.title.clone_from(title);
    }
    let html = page::html(&page).context("cannot write the page's data as JSON")?;
    atomic::write(&args.output, html.as_bytes())?;
    output::text(&format!(
        "wrote {} ({:.1} MB): open it in a browser\n",
        args.output.display(),
        html.len() as f64 / 1e6
    ))?;
    Ok(session.outcome())
}
