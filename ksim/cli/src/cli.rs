//! The root of the command line.

use anyhow::Result;
use clap::{Parser, Subcommand};

use crate::commands::{
    bench, convert, dataset, demo, env, export, index, planner, plot, report, rollout, score,
    train, watch,
};
use crate::context::{Context, GlobalArgs};
use crate::outcome::CommandOutcome;

/// K-Sim: how closely a policy's closed-loop behavior stays to its training data
///
/// Exit status: 0 done, 1 failed, 2 wrong usage, 3 done although a reader had to repair or leave out data.
#[derive(Debug, Parser)]
#[command(name = "ksim", version, propagate_version = true)]
pub(crate) struct Cli {
    #[command(flatten)]
    globals: GlobalArgs,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Score(Box<score::ScoreArgs>),
    Report(Box<report::ReportArgs>),
    Rollout(Box<rollout::RolloutArgs>),
    Train(Box<train::TrainArgs>),
    Planner(Box<planner::PlannerCommandArgs>),
    Env(env::EnvArgs),
    Plot(plot::PlotArgs),
    Watch(Box<watch::WatchArgs>),
    Export(export::ExportArgs),
    Convert(Box<convert::ConvertArgs>),
    Dataset(dataset::DatasetArgs),
    Index(index::IndexArgs),
    Bench(bench::BenchArgs),
    Demo(demo::DemoArgs),
}

impl Cli {
    /// Runs the command that was asked for.
    pub(crate) fn run(self) -> Result<CommandOutcome> {
        let context = Context::new(&self.globals)?;
        match self.command {
            Command::Score(args) => score::run(&args, &context),
            Command::Report(args) => report::run(&args, &context),
            Command::Rollout(args) => rollout::run(&args, &context),
            Command::Train(args) => train::run(&args, &context),
            Command::Planner(args) => planner::run(&args, &context),
            Command::Env(args) => env::run(&args),
            Command::Plot(args) => plot::run(&args, &context),
            Command::Watch(args) => watch::run(&args, &context),
            Command::Export(args) => export::run(&args, &context),
            Command::Convert(args) => convert::run(&args, &context),
            Command::Dataset(args) => dataset::run(&args, &context),
            Command::Index(args) => index::run(&args, &context),
            Command::Bench(args) => bench::run(&args, &context),
            Command::Demo(args) => demo::run(&args, &context),
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        super::Cli::command().debug_assert();
    }
}
