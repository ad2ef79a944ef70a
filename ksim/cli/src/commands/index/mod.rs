//! `ksim index`: saved indexes.

mod build;
mod info;

use anyhow::Result;
use clap::{Args, Subcommand};

use crate::context::Context;
use crate::outcome::CommandOutcome;

/// Save what scoring computes from a dataset, so that it is computed once
#[derive(Debug, Clone, Args)]
pub(crate) struct IndexArgs {
    #[command(subcommand)]
    command: IndexCommand,
}

#[derive(Debug, Clone, Subcommand)]
enum IndexCommand {
    Build(Box<build::BuildArgs>),
    Info(info::InfoArgs),
}

/// Runs the subcommand.
pub(crate) fn run(args: &IndexArgs, context: &Context) -> Result<CommandOutcome> {
    match &args.command {
        IndexCommand::Build(args) => build::run(args, context),
        IndexCommand::Info(args) => info::run(args),
    }
}
