//! `ksim plot`: figures.

mod episodes;
mod paths;
mod step_scores;

use anyhow::Result;
use clap::{Args, Subcommand};

use crate::context::Context;
use crate::outcome::CommandOutcome;

/// Draw figures of rollouts, as SVG
#[derive(Debug, Clone, Args)]
pub(crate) struct PlotArgs {
    #[command(subcommand)]
    command: PlotCommand,
}

#[derive(Debug, Clone, Subcommand)]
enum PlotCommand {
    Paths(Box<paths::PathsArgs>),
}

/// Runs the subcommand.
pub(crate) fn run(args: &PlotArgs, context: &Context) -> Result<CommandOutcome> {
    match &args.command {
        PlotCommand::Paths(args) => paths::run(args, context),
    }
}
