//! The `ksim` command: plays policies in environments, scores rollouts against a dataset, and shows what a dataset
//! holds.

mod atomic;
mod centers;
mod cli;
mod commands;
mod context;
mod data_args;
mod document;
mod episodes_table;
mod figure_file;
mod indexed;
mod lambda_figure;
mod load;
mod mazes;
mod novelty;
mod openmp;
mod outcome;
mod output;
mod overlay;
mod pairing;
mod per_step;
mod planner_args;
mod positions;
mod reporting;
mod rolling;
mod rollout_args;
mod scoring;
mod scoring_args;
mod settings;
mod sparkline;
mod table;
mod watching;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    openmp::wait_passively();
    let cli = cli::Cli::parse();
    match cli.run() {
        Ok(outcome) => outcome.into(),
        Err(error) => output::failure(&error),
    }
}
