//! `ksim export`: scored rollouts for other people's viewers.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, Subcommand};

use crate::context::Context;
use crate::outcome::CommandOutcome;
use crate::output;
use crate::overlay;
use crate::scoring::{Job, Session};
use crate::scoring_args::ScoringArgs;

/// Write rollouts with their scores and matched demonstrations for a viewer
#[derive(Debug, Clone, Args)]
pub(crate) struct ExportArgs {
    #[command(subcommand)]
    command: ExportCommand,
}

#[derive(Debug, Clone, Subcommand)]
enum ExportCommand {
    Mcap(Box<McapArgs>),
}

/// Write an MCAP recording, which Foxglove and other viewers open
///
/// Everything that the rollouts record, and on the same timeline the scores of every step (topic /k_sim) and the
/// demonstration's step that it was matched with (topic /demonstration), as JSON messages with their schemas.
#[derive(Debug, Clone, Args)]
struct McapArgs {
    /// Rollouts: a Parquet file with an observation and an action column, or any dataset
    #[arg(value_name = "ROLLOUTS")]
    rollouts: String,
    /// The recording to write
    #[arg(short, long, value_name = "FILE.mcap")]
    output: PathBuf,
    /// Steps per second of the recording [default: as the rollouts say, else 50]
    #[arg(long, value_name = "HZ", value_parser = rate)]
    fps: Option<f64>,
    #[command(flatten)]
    scoring: ScoringArgs,
}

fn rate(text: &str) -> Result<f64> {
    match text.parse::<f64>() {
        Ok(rate) if rate.is_finite() && rate > 0.0 => Ok(rate),
        _ => bail!("expected a finite number above 0"),
    }
}

/// Runs the subcommand.
pub(crate) fn run(args: &ExportArgs, context: &Context) -> Result<CommandOutcome> {
    match &args.command {
        ExportCommand::Mcap(args) => mcap(args, context),
    }
}

fn mcap(args: &McapArgs, context: &Context) -> Result<CommandOutcome> {
    let job = Job {
        output: Some(args.output.clone()),
        ..args.scoring.job(std::slice::from_ref(&args.rollouts))?
    };
    let session = Session::open(&job, context)?;
    let mut rollouts = Vec::new();
    session.score(&job, context, &mut |scored| {
        rollouts.push(scored);
        Ok(())
    })?;
    let n_steps: usize = rollouts.iter().map(|one| one.report.steps.len()).sum();
    for loss in overlay::write(&args.output, &session, &rollouts, args.fps)? {
        context.note(&format!("{}: {loss}", args.output.display()));
    }
    output::text(&format!(
        "wrote {}: {n_steps} steps with their scores on /k_sim and their matches on /demonstration\n",
        args.output.display()
    ))?;
    Ok(session.outcome())
}
