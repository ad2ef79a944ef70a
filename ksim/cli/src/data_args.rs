//! How datasets and rollouts are found and opened: options that several commands share.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use clap::builder::PossibleValuesParser;
use clap::builder::TypedValueParser as _;
use ksim_datasets::{
    ColumnNames, DatasetSource, EpisodePolicy, OpenOptions, Resolved, SearchRoots,
};

/// How to read files that leave something open.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Reading")]
pub(crate) struct DataArgs {
    /// How a D4RL file is cut into episodes [default: by the file's name]
    #[arg(long, value_name = "POLICY", value_parser = policy_parser())]
    episode_policy: Option<EpisodePolicy>,
    /// Step limit of the environment, for D4RL files without time-outs
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    max_episode_steps: Option<u64>,
    /// Try to read a Minari dataset of an unknown version
    #[arg(long)]
    force: bool,
    /// Read what is whole of a damaged MCAP, LeRobot, Arrow IPC or robomimic dataset, and say what is lost
    #[arg(long)]
    recover: bool,
    /// Which fields of an MCAP recording are observation and action (see `ksim dataset inspect`)
    #[arg(long, value_name = "FILE.toml")]
    mapping: Option<PathBuf>,
    #[command(flatten)]
    columns: ColumnArgs,
}

/// Columns of Parquet files with names of their own.
#[derive(Debug, Clone, Default, Args)]
struct ColumnArgs {
    /// Observation columns of Parquet files, joined in this order [default: by the usual names]
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    observation_columns: Vec<String>,
    /// Action columns of Parquet files
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    action_columns: Vec<String>,
    /// Column of the episode number in Parquet files
    #[arg(long, value_name = "NAME")]
    episode_column: Option<String>,
    /// Column of the step number in Parquet files
    #[arg(long, value_name = "NAME")]
    step_column: Option<String>,
    /// Column of the reward in Parquet files
    #[arg(long, value_name = "NAME")]
    reward_column: Option<String>,
    /// Column of the termination flag in Parquet files
    #[arg(long, value_name = "NAME")]
    terminated_column: Option<String>,
    /// Column of the truncation flag in Parquet files
    #[arg(long, value_name = "NAME")]
    truncated_column: Option<String>,
}

/// Where `--dataset` differs from the rollouts in its column names.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Reading")]
pub(crate) struct DatasetColumnArgs {
    /// The same for the dataset, where its columns have other names than the rollouts'
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    dataset_observation_columns: Vec<String>,
    /// The same for the dataset
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    dataset_action_columns: Vec<String>,
    /// The same for the dataset
    #[arg(long, value_name = "NAME")]
    dataset_episode_column: Option<String>,
    /// The same for the dataset
    #[arg(long, value_name = "NAME")]
    dataset_step_column: Option<String>,
    /// The mapping of the dataset, where it is an MCAP recording with another mapping than the rollouts'
    #[arg(long, value_name = "FILE.toml")]
    dataset_mapping: Option<PathBuf>,
}

fn policy_parser() -> impl clap::builder::TypedValueParser<Value = EpisodePolicy> {
    PossibleValuesParser::new(EpisodePolicy::ALL.map(EpisodePolicy::name))
        .try_map(|name| name.parse::<EpisodePolicy>())
}

impl DataArgs {
    /// Options for a file given on the command line.
    pub(crate) fn open_options(&self) -> OpenOptions {
        let columns = self.columns.clone();
        OpenOptions {
            columns: ColumnNames {
                observation: columns.observation_columns,
                action: columns.action_columns,
                episode: columns.episode_column,
                step: columns.step_column,
                reward: columns.reward_column,
                terminated: columns.terminated_column,
                truncated: columns.truncated_column,
            },
            episode_policy: self.episode_policy,
            max_episode_steps: self.max_episode_steps,
            terminate_on_end: false,
            force: self.force,
            mapping: self.mapping.clone(),
            recover: self.recover,
        }
    }

    /// Options for the dataset, whose own column names win.
    pub(crate) fn dataset_open_options(&self, own: &DatasetColumnArgs) -> OpenOptions {
        let mut options = self.open_options();
        let own = own.clone();
        let columns = &mut options.columns;
        if !own.dataset_observation_columns.is_empty() {
            columns.observation = own.dataset_observation_columns;
        }
        if !own.dataset_action_columns.is_empty() {
            columns.action = own.dataset_action_columns;
        }
        columns.episode = own.dataset_episode_column.or(columns.episode.take());
        columns.step = own.dataset_step_column.or(columns.step.take());
        options.mapping = own.dataset_mapping.or(options.mapping);
        options
    }
}

/// Finds a dataset or rollouts by name or path, and opens them.
pub(crate) fn open(
    name: &str,
    options: &OpenOptions,
) -> Result<(Resolved, Box<dyn DatasetSource>)> {
    let resolved = ksim_datasets::resolve(name, &SearchRoots::from_env())?;
    let source = ksim_datasets::open(&resolved.path, options)?;
    Ok((resolved, source))
}
