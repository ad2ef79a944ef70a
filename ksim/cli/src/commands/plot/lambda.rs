//! `ksim plot lambda`: what the weight of curiosity does, anew.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Args;

use crate::atomic;
use crate::figure_file;
use crate::lambda_figure;
use crate::outcome::CommandOutcome;

/// Draw the curves of a benchmark of `ksim bench lambda`
#[derive(Debug, Clone, Args)]
pub(crate) struct LambdaArgs {
    /// The folder that `ksim bench lambda` wrote
    #[arg(value_name = "RUN_DIR")]
    run_dir: PathBuf,
    /// The figure to write: .svg, or .png or .pdf in a build with feature `figures`
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

/// Reads, draws and writes.
pub(super) fn run(args: &LambdaArgs) -> Result<CommandOutcome> {
    figure_file::check(&args.output)?;
    let path = args.run_dir.join("report.json");
    let place = || path.display().to_string();
    let text = std::fs::read_to_string(&path).with_context(place)?;
    atomic::check_not_an_input(&args.output, [path.as_path()])?;
    let report = serde_json::from_str(&text).with_context(place)?;
    let svg = lambda_figure::of_report(&report).with_context(place)?;
    figure_file::write(&args.output, &svg)?;
    Ok(CommandOutcome::Done)
}
