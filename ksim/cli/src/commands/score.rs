//! `ksim score`.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use ksim::EpisodeScore;

use crate::context::Context;
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::scoring::{Job, ScoredRollouts, Session};
use crate::scoring_args::ScoringArgs;
use crate::sparkline::{self, When};
use crate::table;

/// Score rollouts against the dataset their policy was trained on
///
/// Prints K-Sim of every rollout file, or of every planner in it, with intervals and with what the numbers
/// were computed with. The search is exact unless --search clusters asks for the paper's approximation.
#[derive(Debug, Clone, Args)]
pub(crate) struct ScoreArgs {
    /// Rollouts: Parquet files with an observation and an action column, or any dataset
    #[arg(required = true, value_name = "ROLLOUTS")]
    rollouts: Vec<String>,
    /// How to print the result
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
    /// Write every step's score and the dataset step it was matched with
    #[arg(long, value_name = "FILE.parquet")]
    per_step: Option<PathBuf>,
    /// Below the table, K-Sim over the steps of every episode as a line of blocks; a block is the lowest of its steps
    #[arg(
        long,
        value_enum,
        value_name = "WHEN",
        num_args = 0..=1,
        require_equals = true,
        default_value_t = When::Never,
        default_missing_value = "auto"
    )]
    sparkline: When,
    #[command(flatten)]
    scoring: ScoringArgs,
}

/// Scores and prints.
pub(crate) fn run(args: &ScoreArgs, context: &Context) -> Result<CommandOutcome> {
    let started = Instant::now();
    let job = Job {
        per_step: args.per_step.clone(),
        ..args.scoring.job(&args.rollouts)?
    };
    let session = Session::open(&job, context)?;
    let draws = args.format == OutputFormat::Text && args.sparkline.is_now();
    let mut lines = Vec::new();
    let results = session.score(&job, context, &mut |scored| {
        if draws {
            lines.push(episodes(&scored));
        }
        Ok(())
    })?;
    let mut document = session.document(results, context);
    document.elapsed_s = started.elapsed().as_secs_f64();
    match args.format {
        OutputFormat::Text => {
            let mut text = table::score(&document);
            let labels = table::labels(&document.results);
            for (label, lines) in labels.iter().zip(lines) {
                text += &format!("\n{label}\n{lines}");
            }
            output::text(&text)?;
        }
        OutputFormat::Json => output::json(&document)?,
    }
    Ok(session.outcome())
}

/// A line per episode.
fn episodes(scored: &ScoredRollouts) -> String {
    let mut start = 0;
    let line = |episode: &EpisodeScore| {
        let steps = &scored.report.steps[start..start + episode.n_steps];
        start += episode.n_steps;
        let scores = steps.iter().map(|step| step.score);
        let blocks = sparkline::line(scores, sparkline::WIDTH);
        format!(
            "{:>8}  {:.4}  {blocks}\n",
            episode.episode_index, episode.k_sim
        )
    };
    scored.report.episodes.iter().map(line).collect()
}
