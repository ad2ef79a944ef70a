//! `ksim dataset inspect`: what a recording holds.

use anyhow::{Result, bail};
use clap::Args;

use crate::context::Context;
use crate::outcome::CommandOutcome;

/// Show what an MCAP recording holds: topics, types, rates, gaps; and propose a mapping
#[derive(Debug, Clone, Args)]
pub(crate) struct InspectArgs {}

/// Runs the command.
pub(crate) fn run(_args: &InspectArgs, _context: &Context) -> Result<CommandOutcome> {
    bail!("not there yet")
}
