//! `ksim score`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use crate::context::Context;
use crate::data_args::{DataArgs, DatasetColumnArgs};
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::scoring::{self, Job};
use crate::settings::{MetricArgs, SearchArgs, Settings};
use crate::table;

/// Score rollouts against the dataset their policy was trained on
///
/// Prints K-Sim of every rollout file, or of every planner in it, with intervals and with what the numbers
/// were computed with. The search is exact unless --search clusters asks for the paper's approximation.
#[derive(Debug, Clone, Args)]
pub(crate) struct ScoreArgs {
    /// Rollouts: Parquet files with an observation and an action column, or any dataset
    #[arg(required = true, value_name = "ROLLOUTS")]
    rollouts: Vec<String>,
    /// The dataset to compare with: a file, a folder, or a name such as antmaze-large-play
    #[arg(long, value_name = "NAME|PATH")]
    dataset: String,
    /// Use this index of the dataset, from `ksim index build`, instead of reading it; the scores are the same
    #[arg(long, value_name = "FILE")]
    index: Option<PathBuf>,
    /// How to print the result
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
    /// Write every step's score and the dataset step it was matched with
    #[arg(long, value_name = "FILE.parquet")]
    per_step: Option<PathBuf>,
    #[command(flatten)]
    metric: MetricArgs,
    #[command(flatten)]
    search: SearchArgs,
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    dataset_columns: DatasetColumnArgs,
}

/// Scores and prints.
pub(crate) fn run(args: &ScoreArgs, context: &Context) -> Result<CommandOutcome> {
    let job = Job {
        dataset: args.dataset.clone(),
        index: args.index.clone(),
        dataset_options: args.data.dataset_open_options(&args.dataset_columns),
        rollouts: args.rollouts.clone(),
        rollout_options: args.data.open_options(),
        settings: Settings::resolve(&args.metric, &args.search)?,
        per_step: args.per_step.clone(),
    };
    let (document, outcome) = scoring::run(&job, context)?;
    match args.format {
        OutputFormat::Text => output::text(&table::score(&document))?,
        OutputFormat::Json => output::json(&document)?,
    }
    Ok(outcome)
}
