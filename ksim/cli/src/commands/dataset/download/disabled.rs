//! A build without downloads.

use anyhow::{Result, bail};

use super::DownloadArgs;
use crate::context::Context;
use crate::outcome::CommandOutcome;

/// Says what is missing.
pub(in super::super) fn run(_args: &DownloadArgs, _context: &Context) -> Result<CommandOutcome> {
    bail!("`dataset download` needs feature `download`, which this build lacks")
}
