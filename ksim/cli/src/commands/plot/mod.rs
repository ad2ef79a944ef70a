//! `ksim plot`: figures.

mod distribution;
mod episodes;
mod lambda;
mod line_count;
mod paths;
mod step_scores;
mod tables;
mod timeline;

use anyhow::Result;
use clap::{Args, Subcommand};

use crate::context::Context;
use crate::outcome::CommandOutcome;

/// Draw figures of rollouts, and write their table for a paper
#[derive(Debug, Clone, Args)]
pub(crate) struct PlotArgs {
    #[command(subcommand)]
    command: PlotCommand,
}

#[derive(Debug, Clone, Subcommand)]
enum PlotCommand {
    Timeline(Box<timeline::TimelineArgs>),
    Paths(Box<paths::PathsArgs>),
    Distribution(Box<distribution::DistributionArgs>),
    Lambda(lambda::LambdaArgs),
    Tables(Box<tables::TablesArgs>),
}

/// Runs the subcommand.
pub(crate) fn run(args: &PlotArgs, context: &Context) -> Result<CommandOutcome> {
    match &args.command {
        PlotCommand::Timeline(args) => timeline::run(args, context),
        PlotCommand::Paths(args) => paths::run(args, context),
        PlotCommand::Distribution(args) => distribution::run(args, context),
        PlotCommand::Lambda(args) => lambda::run(args),
        PlotCommand::Tables(args) => tables::run(args, context),
    }
}
