//! `ksim dataset download`: fetching by name.

#[cfg(not(feature = "download"))]
mod disabled;
#[cfg(feature = "download")]
mod enabled;

use clap::Args;

#[cfg(not(feature = "download"))]
pub(super) use disabled::run;
#[cfg(feature = "download")]
pub(super) use enabled::run;

use crate::output::OutputFormat;

/// Fetch datasets by name into the folders where their own tools look for them
///
/// A Minari id (D4RL/antmaze/large-play-v1), a short name of one (antmaze-large-play), or a D4RL name
/// (hopper-medium-v2); `ksim dataset list --known` shows them. Minari datasets come from the Hugging Face hub
/// (or HF_ENDPOINT) and go to MINARI_DATASETS_PATH or ~/.minari/datasets, D4RL files to D4RL_DATASET_DIR or
/// ~/.d4rl/datasets. A download that broke off goes on where it stopped. What has a published checksum must have
/// it; nothing appears before it is complete.
#[derive(Debug, Clone, Args)]
#[cfg_attr(
    not(feature = "download"),
    allow(dead_code, reason = "the command only says what it lacks")
)]
pub(crate) struct DownloadArgs {
    /// What to fetch
    #[arg(required = true, value_name = "NAME")]
    names: Vec<String>,
    /// A mirror: its address in place of the store's own
    #[arg(long, value_name = "URL")]
    base_url: Option<String>,
    /// Fetch again, and replace what is there
    #[arg(long)]
    force: bool,
    /// Only show what would be fetched, how large it is, and where it would go
    #[arg(long)]
    dry_run: bool,
    /// How to print the result
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
}
