//! `ksim dataset validate`: faults in a dataset.

use anyhow::{Result, bail};
use clap::Args;

use crate::context::Context;
use crate::outcome::CommandOutcome;

/// Look for faults: lengths, flags, NaN, duplicates, jumps, time stamps
#[derive(Debug, Clone, Args)]
pub(crate) struct ValidateArgs {}

/// Runs the command.
pub(crate) fn run(_args: &ValidateArgs, _context: &Context) -> Result<CommandOutcome> {
    bail!("not there yet")
}
