//! `ksim dataset inspect` in a build without the feature `mcap`.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::Args;

use crate::context::Context;
use crate::outcome::CommandOutcome;

/// Show what an MCAP recording holds (this build cannot: it lacks the feature `mcap`)
#[derive(Debug, Clone, Args)]
pub(crate) struct InspectArgs {
    /// An MCAP file, or a folder of them
    #[arg(value_name = "FILE.mcap|FOLDER")]
    recording: PathBuf,
}

/// Runs the command.
pub(crate) fn run(args: &InspectArgs, _context: &Context) -> Result<CommandOutcome> {
    bail!(
        "{}: reading MCAP needs feature `mcap`, which this build lacks",
        args.recording.display()
    )
}
