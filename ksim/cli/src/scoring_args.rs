//! What every command that scores takes: the dataset, the metric, the search, and how files are read.

use std::path::PathBuf;

use clap::Args;

use crate::data_args::{DataArgs, DatasetColumnArgs};
use crate::scoring::Job;
use crate::settings::{MetricArgs, SearchArgs, Settings};

/// The reference and how to score against it.
#[derive(Debug, Clone, Args)]
pub(crate) struct ScoringArgs {
    /// The dataset to compare with: a file, a folder, or a name such as antmaze-large-play
    #[arg(long, value_name = "NAME|PATH")]
    dataset: String,
    /// Use this index of the dataset, from `ksim index build`, instead of reading it; the scores are the same
    #[arg(long, value_name = "FILE")]
    index: Option<PathBuf>,
    #[command(flatten)]
    metric: MetricArgs,
    #[command(flatten)]
    search: SearchArgs,
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    dataset_columns: DatasetColumnArgs,
}

impl ScoringArgs {
    /// A job for some rollouts.
    ///
    /// # Errors
    /// Flags that contradict each other: a wrong usage.
    pub(crate) fn job(&self, rollouts: &[String]) -> Result<Job, clap::Error> {
        Ok(Job {
            dataset: self.dataset.clone(),
            index: self.index.clone(),
            dataset_options: self.data.dataset_open_options(&self.dataset_columns),
            rollouts: rollouts.to_vec(),
            rollout_options: self.data.open_options(),
            settings: Settings::resolve(&self.metric, &self.search)?,
            per_step: None,
            output: None,
        })
    }
}
