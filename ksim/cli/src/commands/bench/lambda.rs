//! `ksim bench lambda`: what the weight of curiosity does.

use std::num::NonZero;
use std::path::PathBuf;

use anyhow::{Context as _, Result, bail};
use clap::Args;
use ksim_bench_harness::report::{Entry, Report, SWEEP, json, markdown};
use ksim_bench_harness::run_dir::RunDir;
use ksim_bench_harness::suite::{EnvironmentEntry, PlannerEntry, Suite};
use serde_json::{Value, json as object};

use super::planners::played;
use crate::atomic;
use crate::context::Context;
use crate::lambda_figure::{self, lambda_name};
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::planner_args::PlanArgs;

/// Play one trained planner with several weights of curiosity and draw what they do
///
/// Success, return, K-Sim and novelty against λ: a table, and lambda.svg. All weights have the same seeds. What is done
/// is kept: after Ctrl-C, the same command goes on.
#[derive(Debug, Clone, Args)]
pub(crate) struct LambdaBenchArgs {
    /// A run of `ksim train curiosity-diffuser`
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Weights of curiosity, in the order in which they are drawn
    #[arg(
        long,
        value_name = "LAMBDA,…",
        value_delimiter = ',',
        default_value = "0,1e1,1e2,1e3,1e4,1e5,1e6",
        value_parser = weight
    )]
    lambdas: Vec<f64>,
    /// Id of the environment
    #[arg(long, value_name = "ID", required_unless_present = "dataset")]
    env: Option<String>,
    /// The dataset of the run: its environment, and what K-Sim compares with
    #[arg(long, value_name = "NAME|PATH")]
    dataset: Option<String>,
    /// Time limit of an episode in steps [default: the environment's]
    #[arg(long, value_name = "N")]
    max_steps: Option<NonZero<u32>>,
    /// Episodes of every weight
    #[arg(long, value_name = "N", default_value = "20")]
    episodes: NonZero<u32>,
    /// Seed of the first episode
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// The folder of the results
    #[arg(short, long, value_name = "RUN_DIR")]
    output: PathBuf,
    /// Environments that are stepped together; results do not depend on it, except with planners by libtorch [default: 8 per thread]
    #[arg(long, value_name = "N")]
    parallel: Option<NonZero<u16>>,
    /// How to print the table
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
    #[command(flatten)]
    plan: PlanArgs,
}

fn weight(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(weight) if weight.is_finite() && weight >= 0.0 => Ok(weight),
        _ => Err("expected a finite number of 0 or more".to_owned()),
    }
}

/// Plays, draws and prints.
pub(super) fn run(args: &LambdaBenchArgs, context: &Context) -> Result<CommandOutcome> {
    let suite = suite(args)?;
    suite.check()?;
    let run_dir = RunDir::open(&args.output)?;
    let _cooperative = atomic::Cooperative::begin();
    let Some(played) = played(&suite, &run_dir, args.parallel, context)? else {
        return Ok(CommandOutcome::Done);
    };
    let report = Report::new(&suite, &played);
    let text = markdown(&report) + &paper(&report.entries);
    run_dir.write_text("report.md", &text)?;
    let mut document = json(&report, &played);
    if let Value::Object(document) = &mut document {
        document.insert("lambdas".to_owned(), object!(args.lambdas));
    }
    let pretty = |document: &Value| -> Result<String> {
        let text = serde_json::to_string_pretty(document).context("cannot write the report")?;
        Ok(text + "\n")
    };
    // First: what cannot be drawn is there to be looked at.
    run_dir.write_text("report.json", &pretty(&document)?)?;
    let figure = run_dir.write_text("lambda.svg", &lambda_figure::of_report(&document)?)?;
    if let Value::Object(document) = &mut document {
        document.insert("figure".to_owned(), object!(figure.display().to_string()));
    }
    run_dir.write_text("report.json", &pretty(&document)?)?;
    match args.format {
        OutputFormat::Text => {
            output::text(&format!("{text}\nThe curves are in {}\n", figure.display()))?;
        }
        OutputFormat::Json => output::json(&document)?,
    }
    Ok(CommandOutcome::Done)
}

/// A suite with a planner for every weight.
fn suite(args: &LambdaBenchArgs) -> Result<Suite> {
    let Some(run) = args.run.to_str() else {
        bail!("{}: expected a path in UTF-8", args.run.display());
    };
    // Whatever the name of the folder, it is a path.
    let source = match args.run.is_absolute() {
        true => run.to_owned(),
        false => format!("./{run}"),
    };
    let count = |number: Option<NonZero<u32>>| -> Result<Option<usize>> {
        Ok(number
            .map(|number| usize::try_from(number.get()))
            .transpose()?)
    };
    let planner = |lambda: &f64| PlannerEntry {
        name: format!("λ={}", lambda_name(*lambda)),
        source: Some(source.clone()),
        curiosity: Some(*lambda),
        ..args.plan.entry()
    };
    let environment = args.env.as_ref().or(args.dataset.as_ref());
    Ok(Suite {
        name: format!("Sensitivity to λ of {run}"),
        episodes: usize::try_from(args.episodes.get())?,
        runs: 1,
        seed: args.seed,
        discount: 0.99,
        environments: vec![EnvironmentEntry {
            name: environment.cloned().unwrap_or_default(),
            env: args.env.clone(),
            dataset: args.dataset.clone(),
            max_steps: count(args.max_steps)?,
            ..EnvironmentEntry::default()
        }],
        planners: args.lambdas.iter().map(planner).collect(),
        folder: PathBuf::new(),
    })
}

/// What the paper has for the same task.
fn paper(entries: &[Entry]) -> String {
    let Some(task) = entries.iter().find_map(|entry| Some(entry.paper?.task)) else {
        return String::new();
    };
    let mut text = format!(
        "\n## The paper's sweep in {task}\n\nSuccess at the last step, as its figure has it, where the numbers are \
         known.\n\n| λ | success, % |\n|---|---|\n"
    );
    for point in SWEEP.iter().filter(|point| point.task == task) {
        let rate = 100.0 * point.success;
        text += &format!("| {} | {rate:.1} |\n", lambda_name(point.curiosity));
    }
    text
}
