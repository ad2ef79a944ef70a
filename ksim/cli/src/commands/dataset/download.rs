//! `ksim dataset download`: fetching by name.

use anyhow::{Result, bail};
use clap::Args;

use crate::context::Context;
use crate::outcome::CommandOutcome;

/// Fetch a dataset by name into the folder where its own tools look for it
#[derive(Debug, Clone, Args)]
pub(crate) struct DownloadArgs {}

/// Runs the command.
pub(crate) fn run(_args: &DownloadArgs, _context: &Context) -> Result<CommandOutcome> {
    bail!("not there yet")
}
