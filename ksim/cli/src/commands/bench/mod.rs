//! `ksim bench`: measures the engines and, on tasks, the planners.

mod lambda;
mod planners;
mod search;
mod search_table;

use anyhow::Result;
use clap::{Args, Subcommand};

use crate::context::Context;
use crate::outcome::CommandOutcome;

/// Measure how fast and how exact the engines are, and how planners do on tasks
#[derive(Debug, Clone, Args)]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    command: BenchCommand,
}

#[derive(Debug, Clone, Subcommand)]
enum BenchCommand {
    Search(Box<search::SearchBenchArgs>),
    Planners(planners::PlannersBenchArgs),
    Lambda(Box<lambda::LambdaBenchArgs>),
}

/// Runs the subcommand.
pub(crate) fn run(args: &BenchArgs, context: &Context) -> Result<CommandOutcome> {
    match &args.command {
        BenchCommand::Search(args) => search::run(args, context),
        BenchCommand::Planners(args) => planners::run(args, context),
        BenchCommand::Lambda(args) => lambda::run(args, context),
    }
}
