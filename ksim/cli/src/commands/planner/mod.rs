//! `ksim planner`: which planners there are, what a run is, a run of imported files, and a planner as a process.

mod import;

use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use clap::{Args, Subcommand};
use ksim_bench_harness::planner_source::{PlannerSource, SOURCES};
use ksim_envs::registry::{self, EnvironmentRequest};
use ksim_planners::process::{Setting, serve};
use ksim_planners::{PlannerError, Registry, family_of};
use serde_json::{Value, json};

use crate::context::Context;
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::planner_args::PlanningArgs;
use crate::table;

/// List planners, describe a run, import one, or serve a planner to another program
#[derive(Debug, Clone, Args)]
pub(crate) struct PlannerCommandArgs {
    #[command(subcommand)]
    command: PlannerCommand,
}

#[derive(Debug, Clone, Subcommand)]
enum PlannerCommand {
    /// Which planners can be trained, with their presets, and which need no training
    List(ListArgs),
    /// What a run is: its planner, settings, dataset and files
    Info(InfoArgs),
    Import(import::ImportArgs),
    /// Answer requests for plans on stdin, as docs/planner-processes.md says
    Serve(ServeArgs),
}

#[derive(Debug, Clone, Args)]
struct ListArgs {
    /// How to print the list
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
}

#[derive(Debug, Clone, Args)]
struct InfoArgs {
    /// The run folder
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// How to print it
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
}

#[derive(Debug, Clone, Args)]
struct ServeArgs {
    /// The planner, as --planner of `ksim rollout` takes it
    #[arg(value_name = "RUN|SPEC")]
    planner: String,
    #[command(flatten)]
    planning: PlanningArgs,
}

/// Runs the subcommand.
pub(crate) fn run(args: &PlannerCommandArgs, context: &Context) -> Result<CommandOutcome> {
    match &args.command {
        PlannerCommand::List(args) => list(args.format),
        PlannerCommand::Info(args) => info(&args.run, args.format),
        PlannerCommand::Import(args) => import::run(args, context),
        PlannerCommand::Serve(args) => serve_planner(args, context),
    }
}

fn list(format: OutputFormat) -> Result<CommandOutcome> {
    let registry = Registry::builtin();
    match format {
        OutputFormat::Json => {
            let families: Vec<Value> = registry
                .families()
                .map(|family| {
                    let presets = family.presets().iter();
                    let presets = presets
                        .map(|preset| json!({"name": preset.name, "summary": preset.summary}));
                    json!({
                        "id": family.id(),
                        "summary": family.summary(),
                        "presets": presets.collect::<Vec<_>>(),
                    })
                })
                .collect();
            output::json(&json!({"schema": "ksim.planners/1", "planners": families}))?;
        }
        OutputFormat::Text => {
            let mut text = String::from("To train with `ksim train`:\n");
            for family in registry.families() {
                text += &format!("\n{}: {}\n", family.id(), family.summary());
                let presets = family.presets().iter();
                let rows: Vec<(String, String)> = presets
                    .map(|preset| (format!("  {}", preset.name), preset.summary.to_owned()))
                    .collect();
                let rows: Vec<(&str, String)> = rows
                    .iter()
                    .map(|(name, summary)| (name.as_str(), summary.clone()))
                    .collect();
                text += &table::properties(&rows);
            }
            text += "\nTo play with `ksim rollout --planner`:\n\n";
            let rows: Vec<(&str, String)> = SOURCES
                .iter()
                .map(|(syntax, summary)| (*syntax, (*summary).to_owned()))
                .collect();
            text += &table::properties(&rows);
            output::text(&text)?;
        }
    }
    Ok(CommandOutcome::Done)
}

fn info(run: &Path, format: OutputFormat) -> Result<CommandOutcome> {
    let family = family_of(run)?;
    let path = run.join("manifest.json");
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let manifest: Value =
        serde_json::from_str(&text).with_context(|| path.display().to_string())?;
    let files = files(run).with_context(|| run.display().to_string())?;
    if format == OutputFormat::Json {
        let files: Vec<Value> = files
            .iter()
            .map(|(name, bytes)| json!({"name": name, "bytes": bytes}))
            .collect();
        let known = Registry::builtin().family(&family).is_ok();
        output::json(&json!({
            "schema": "ksim.planner-run/1",
            "run": run.display().to_string(),
            "in_this_build": known,
            "manifest": manifest,
            "files": files,
        }))?;
        return Ok(CommandOutcome::Done);
    }
    let mut rows = Vec::new();
    flatten("", &manifest, &mut rows);
    rows.extend(
        files
            .into_iter()
            .map(|(name, bytes)| (name, format!("{bytes} bytes"))),
    );
    let rows: Vec<(&str, String)> = rows
        .iter()
        .map(|(name, value)| (name.as_str(), value.clone()))
        .collect();
    output::text(&table::properties(&rows))?;
    Ok(CommandOutcome::Done)
}

/// Names with their tables before them, and values.
fn flatten(prefix: &str, value: &Value, rows: &mut Vec<(String, String)>) {
    match value {
        Value::Object(table) => {
            for (name, value) in table {
                let name = match prefix {
                    "" => name.clone(),
                    prefix => format!("{prefix}.{name}"),
                };
                flatten(&name, value, rows);
            }
        }
        Value::String(text) => rows.push((prefix.to_owned(), text.clone())),
        Value::Null => {}
        other => rows.push((prefix.to_owned(), other.to_string())),
    }
}

/// Files of a run with their sizes, by name.
fn files(run: &Path) -> io::Result<Vec<(String, u64)>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(run)? {
        let entry = entry?;
        let metadata = entry.metadata()?;
        if metadata.is_file() {
            files.push((
                entry.file_name().to_string_lossy().into_owned(),
                metadata.len(),
            ));
        }
    }
    files.sort();
    Ok(files)
}

fn serve_planner(args: &ServeArgs, context: &Context) -> Result<CommandOutcome> {
    let source = PlannerSource::parse(&args.planner)?;
    if source.is_finished() == Some(false) {
        context.warn(&format!("the training of {} is not finished", args.planner));
    }
    let options = args.planning.open_options(context.threads());
    let make = |setting: &Setting| {
        let environment = registry::make(&EnvironmentRequest::of_id(&setting.environment));
        let environment = environment.map_err(|error| PlannerError::Request {
            what: "the environment",
            expected: "one of `ksim env list`".to_owned(),
            found: error.to_string(),
        })?;
        source
            .open(&Registry::builtin(), environment.spec(), &options)
            .map_err(|error| PlannerError::Request {
                what: "the planner",
                expected: "one that plans for the environment".to_owned(),
                found: format!("{:#}", anyhow::Error::from(error)),
            })
    };
    serve(make, io::stdin().lock(), io::stdout().lock())?;
    Ok(CommandOutcome::Done)
}
