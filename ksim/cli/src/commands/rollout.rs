//! `ksim rollout`: a policy in an environment.

use std::num::NonZero;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use ksim_bench_harness::k_sim::KSimSummary;
use ksim_bench_harness::record::Summary;
use ksim_bench_harness::recording::{About, ActionPrecision};
use ksim_bench_harness::stats::{BootstrapOptions, Estimate};
use ksim_datasets::WriteOptions;
use serde_json::{Value, json};

use super::convert::{Target, format_of};
use crate::atomic;
use crate::context::Context;
use crate::episodes_table;
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::rolling::{self, Destination, Played, Ready};
use crate::rollout_args::{EnvironmentArgs, PlayArgs, Setup};
use crate::scoring::{MUCH_SATURATION, saturated};
use crate::table;

/// Name and version of the schema of `ksim rollout --format json`.
const SCHEMA: &str = "ksim.rollout/1";

/// Play a policy in an environment, record what happens and summarize it
///
/// `ksim score` reads the recorded file as it is. After Ctrl-C, the file holds the episodes that were complete.
#[derive(Debug, Clone, Args)]
pub(crate) struct RolloutArgs {
    #[command(flatten)]
    environment: EnvironmentArgs,
    /// With --dataset: the environment it was collected in, not the one that policies are judged in
    #[arg(
        long,
        requires = "dataset",
        conflicts_with = "env",
        help_heading = "Environment"
    )]
    collection_env: bool,
    #[command(flatten)]
    play: PlayArgs,
    /// Also score against the dataset of --dataset; for planners that is done anyway
    #[arg(long, requires = "dataset", conflicts_with = "no_k_sim")]
    k_sim: bool,
    /// Do not score the planner against the dataset
    #[arg(long)]
    no_k_sim: bool,
    /// Repetitions of all episodes, over which seeds go on
    #[arg(long, value_name = "R", default_value = "1", help_heading = "Rollout")]
    runs: NonZero<u32>,
    /// Write all steps: .parquet, .arrow, .hdf5 (D4RL), .mcap, or what --to says
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Format to write [default: by the suffix of OUT]
    #[arg(long, value_enum, value_name = "FORMAT", requires = "output")]
    to: Option<Target>,
    /// Replace what is already there
    #[arg(long)]
    overwrite: bool,
    /// Write a row of numbers per episode
    #[arg(long, value_name = "FILE.parquet")]
    episodes_output: Option<PathBuf>,
    /// How to print the summary
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
}

/// Plays, writes and prints.
pub(crate) fn run(args: &RolloutArgs, context: &Context) -> Result<CommandOutcome> {
    let setup = args.environment.setup(args.collection_env)?;
    let destination = destination(args)?;
    if let Some(path) = &args.episodes_output {
        atomic::check_target(path)?;
    }
    let n_runs = usize::try_from(args.runs.get())?;
    let mut ready = Ready::new(&setup, &args.play, n_runs, context)?;
    let is_scored = args.play.is_planned() && setup.dataset.is_some() && !args.no_k_sim;
    if is_scored || args.k_sim {
        ready = ready.with_k_sim(context)?;
    }
    let about = About {
        env_spec: rolling::env_spec(&setup.request)?,
        reference: setup.reference,
        ..About::default()
    };
    let _cooperative = atomic::Cooperative::begin();
    let played = ready.play(destination.as_ref(), about, context)?;
    if let Some(path) = &args.episodes_output
        && !played.records.is_empty()
    {
        episodes_table::write(path, &played.records)?;
    }
    report(&played, &setup, args)?;
    let k_sim = played.k_sim.as_deref().and_then(KSimSummary::new);
    if let Some(k_sim) = k_sim.filter(|k_sim| k_sim.saturated_share > MUCH_SATURATION) {
        let (share, mean) = (k_sim.saturated_share, k_sim.mean_scaled_distance);
        context.warn(&saturated(share, mean));
    }
    Ok(CommandOutcome::Done)
}

fn destination(args: &RolloutArgs) -> Result<Option<Destination<'_>>> {
    let Some(path) = &args.output else {
        return Ok(None);
    };
    let destination = Destination {
        path,
        format: match args.to {
            Some(target) => target.into(),
            None => format_of(path)?,
        },
        options: WriteOptions {
            overwrite: args.overwrite,
            ..WriteOptions::default()
        },
        precision: ActionPrecision::Double,
    };
    destination.check()?;
    Ok(Some(destination))
}

/// Prints the summary; nothing where there is no episode, which was said already.
fn report(played: &Played, setup: &Setup, args: &RolloutArgs) -> Result<()> {
    let Some(summary) = Summary::new(&played.records, &BootstrapOptions::default()) else {
        return Ok(());
    };
    match args.format {
        OutputFormat::Text => output::text(&text(played, &summary)),
        OutputFormat::Json => {
            let output = args.output.as_ref().map(|path| path.display().to_string());
            output::json(&document(played, setup, &summary, output))
        }
    }
}

/// The summary for people.
pub(super) fn text(played: &Played, summary: &Summary) -> String {
    let about = |key: &str| match &played.rollout[key] {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    let environment = &played.rollout["environment"];
    let mut rows = vec![
        (
            "environment",
            environment["id"].as_str().unwrap_or_default().to_owned(),
        ),
        (
            match played.rollout["planner"].is_null() {
                true => "policy",
                false => "planner",
            },
            about("policy"),
        ),
        ("seed", about("seed")),
        ("episodes", episodes(played, summary)),
        ("return", estimate(&summary.total_return, "episodes")),
    ];
    if let Some(score) = &summary.normalized_score {
        rows.push(("normalized score", estimate(score, "episodes")));
    }
    if let Some(iqm) = &summary.iqm_of_runs {
        rows.push(("IQM of runs", estimate(iqm, "runs")));
    }
    if let Some(success) = &summary.success {
        rows.push(("success at any step", rate(&success.ever)));
        rows.push(("success at the end", rate(&success.at_end)));
        if let Some(step) = success.mean_first_success_step {
            rows.push(("first success", format!("after {step:.1} steps on average")));
        }
    }
    if let Some(k_sim) = played.k_sim.as_deref().and_then(KSimSummary::new) {
        rows.extend(k_sim_rows(&k_sim));
    }
    rows.push((
        "length",
        format!(
            "{:.1} steps on average; {} ended by the task, {} by the time limit",
            summary.mean_length, summary.n_terminated, summary.n_truncated
        ),
    ));
    table::properties(&rows)
}

/// What the text says of K-Sim.
fn k_sim_rows(k_sim: &KSimSummary) -> [(&'static str, String); 2] {
    [
        (
            "K-Sim",
            format!(
                "{} over all steps; mean of the episodes {}",
                table::decimals(k_sim.k_sim),
                estimate(&k_sim.k_sim_episode_mean, "episodes")
            ),
        ),
        (
            "saturated steps",
            format!(
                "{:.1} %; mean d/√d, which does not saturate: {}",
                100.0 * k_sim.saturated_share,
                table::decimals(k_sim.mean_scaled_distance)
            ),
        ),
    ]
}

fn episodes(played: &Played, summary: &Summary) -> String {
    let n = played.records.len();
    let runs = match summary.n_runs {
        1 => String::new(),
        runs => format!(" in {runs} runs"),
    };
    match played.is_interrupted() {
        true => format!(
            "{n}{runs} (interrupted; {} were asked for)",
            played.n_requested
        ),
        false => format!("{n}{runs}"),
    }
}

/// A number with its interval; `over` is what was resampled.
fn estimate(estimate: &Estimate, over: &str) -> String {
    let value = table::decimals(estimate.value);
    match estimate.interval {
        Some([low, high]) => format!(
            "{value}  95 % interval [{}, {}] by bootstrap over {over}",
            table::decimals(low),
            table::decimals(high)
        ),
        None => value,
    }
}

fn rate(rate: &Estimate) -> String {
    let percent = |share: f64| format!("{:.1}", 100.0 * share);
    let value = percent(rate.value);
    match rate.interval {
        Some([low, high]) => format!(
            "{value} %  95 % interval [{}, {}] by Wilson",
            percent(low),
            percent(high)
        ),
        None => format!("{value} %"),
    }
}

/// The summary for programs: how it was made, its numbers, and those of every episode.
fn document(played: &Played, setup: &Setup, summary: &Summary, output: Option<String>) -> Value {
    let mut document = json!({
        "schema": SCHEMA,
        "version": env!("CARGO_PKG_VERSION"),
    });
    let more = json!({
        "reference": setup.reference.map(|(low, high)| [low, high]),
        "output": output,
        "summary": summary,
        "k_sim": played.k_sim.as_deref().and_then(KSimSummary::new),
        "k_sim_episodes": played.k_sim,
        "episodes": played.records.iter().map(episodes_table::json).collect::<Vec<_>>(),
    });
    if let (Value::Object(document), Value::Object(more)) = (&mut document, more) {
        let rollout = played.rollout.clone().into_iter();
        document.extend(rollout.filter(|(key, _)| key != "ksim_version"));
        document.extend(more);
    }
    document
}
