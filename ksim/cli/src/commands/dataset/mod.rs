//! `ksim dataset`: what is on this machine, and what a dataset holds.

mod collect;
mod download;
#[cfg(feature = "mcap")]
mod inspect;
#[cfg(not(feature = "mcap"))]
#[path = "inspect_disabled.rs"]
mod inspect;
mod known;
mod validate;

use anyhow::{Context as _, Result};
use clap::{Args, Subcommand};
use ksim_datasets::{DatasetInfo, Listed, SearchRoots, Spread, Summary};
use serde::Serialize;
use serde_json::{Value, json};

use crate::context::Context;
use crate::data_args::{self, DataArgs};
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::table;

/// Name and version of the schema of `ksim dataset list --format json`.
const LIST_SCHEMA: &str = "ksim.dataset-list/1";
/// Name and version of the schema of `ksim dataset info --format json`.
const INFO_SCHEMA: &str = "ksim.dataset-info/1";

/// How to get data, for people who have none.
const HOW_TO_GET: &str = "\
ksim dataset download D4RL/antmaze/large-play-v1   fetches one (a Minari id or a D4RL name)
ksim dataset list --known                          shows what is published
Any file can also be given by its path.
";

/// Show which datasets are there and what they hold, fetch and collect more
#[derive(Debug, Clone, Args)]
pub(crate) struct DatasetArgs {
    #[command(subcommand)]
    command: DatasetCommand,
}

#[derive(Debug, Clone, Subcommand)]
enum DatasetCommand {
    /// List the datasets in the Minari and D4RL folders of this machine, or those that can be downloaded
    List {
        /// Show published datasets instead: all, or those whose id holds PATTERN (`*` stands for a part of it)
        #[arg(long, value_name = "PATTERN", num_args = 0..=1, default_missing_value = "")]
        known: Option<String>,
        /// How to print the list
        #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
        format: OutputFormat,
    },
    /// Describe a dataset: episodes, columns, returns, success
    Info {
        /// A file, a folder, or a name such as antmaze-large-play
        #[arg(value_name = "NAME|PATH")]
        dataset: String,
        /// How to print the description
        #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
        format: OutputFormat,
        #[command(flatten)]
        data: Box<DataArgs>,
    },
    Inspect(Box<inspect::InspectArgs>),
    Validate(Box<validate::ValidateArgs>),
    Download(download::DownloadArgs),
    Collect(Box<collect::CollectArgs>),
}

/// Runs the subcommand.
pub(crate) fn run(args: &DatasetArgs, context: &Context) -> Result<CommandOutcome> {
    match &args.command {
        DatasetCommand::List {
            known: Some(pattern),
            format,
        } => known::list(pattern, *format),
        DatasetCommand::List {
            known: None,
            format,
        } => list(*format),
        DatasetCommand::Info {
            dataset,
            format,
            data,
        } => info(dataset, *format, data, context),
        DatasetCommand::Inspect(args) => inspect::run(args, context),
        DatasetCommand::Validate(args) => validate::run(args, context),
        DatasetCommand::Download(args) => download::run(args, context),
        DatasetCommand::Collect(args) => collect::run(args, context),
    }
}

fn list(format: OutputFormat) -> Result<CommandOutcome> {
    let roots = SearchRoots::from_env();
    let listed = ksim_datasets::list(&roots);
    match format {
        OutputFormat::Text => output::text(&list_text(&roots, &listed))?,
        OutputFormat::Json => output::json(&list_json(&roots, &listed))?,
    }
    Ok(CommandOutcome::Done)
}

/// The folders that are looked at, with the variable that sets each.
fn looked_at(roots: &SearchRoots) -> [(&'static str, Option<String>); 2] {
    let show =
        |path: &Option<std::path::PathBuf>| path.as_ref().map(|path| path.display().to_string());
    [
        ("MINARI_DATASETS_PATH", show(&roots.minari)),
        ("D4RL_DATASET_DIR", show(&roots.d4rl)),
    ]
}

fn list_text(roots: &SearchRoots, listed: &[Listed]) -> String {
    let mut text = String::new();
    if listed.is_empty() {
        text.push_str("no datasets found\n");
    } else {
        let header = ["dataset", "format", "episodes", "steps", "note"].map(str::to_owned);
        let count = |n: Option<u64>| n.map_or_else(|| "?".to_owned(), |n| n.to_string());
        let rows = listed.iter().map(|one| {
            vec![
                one.id.clone(),
                one.format.name().to_owned(),
                count(one.n_episodes),
                count(one.n_steps),
                one.note.clone().unwrap_or_default(),
            ]
        });
        text.push_str(&table::align(
            &[header.to_vec()]
                .into_iter()
                .chain(rows)
                .collect::<Vec<_>>(),
        ));
    }
    text.push_str("\nlooked in\n");
    let folders = looked_at(roots).map(|(variable, folder)| {
        let folder =
            folder.unwrap_or_else(|| "nowhere: neither it nor a home folder is set".to_owned());
        (variable, folder)
    });
    for line in table::properties(&folders).lines() {
        text.extend(["  ", line, "\n"]);
    }
    if listed.is_empty() {
        text.extend(["\n", HOW_TO_GET]);
    }
    text
}

fn list_json(roots: &SearchRoots, listed: &[Listed]) -> Value {
    let datasets: Vec<Value> = listed
        .iter()
        .map(|one| {
            json!({
                "id": one.id,
                "format": one.format.name(),
                "path": one.path.display().to_string(),
                "n_episodes": one.n_episodes,
                "n_steps": one.n_steps,
                "note": one.note,
            })
        })
        .collect();
    let folders: serde_json::Map<String, Value> = looked_at(roots)
        .into_iter()
        .map(|(name, folder)| (name.to_owned(), json!(folder)))
        .collect();
    json!({ "schema": LIST_SCHEMA, "datasets": datasets, "looked_in": folders })
}

fn info(
    name: &str,
    format: OutputFormat,
    data: &DataArgs,
    context: &Context,
) -> Result<CommandOutcome> {
    let (_, source) = data_args::open(name, &data.open_options())?;
    let info = source.info();
    let progress = context.spinner(format!("reading {}", info.id));
    let summary =
        ksim_datasets::summarize(&*source).with_context(|| info.path.display().to_string());
    drop(progress);
    let summary = summary?;
    match format {
        OutputFormat::Text => output::text(&info_text(info, &summary))?,
        OutputFormat::Json => output::json(&InfoDocument::new(info, &summary))?,
    }
    for warning in &info.warnings {
        context.warn(&format!("{}: {warning}", info.path.display()));
    }
    Ok(CommandOutcome::of([info]))
}

/// The description of a dataset, in the order of its fields.
#[derive(Serialize)]
struct InfoDocument {
    schema: &'static str,
    id: String,
    format: &'static str,
    path: String,
    n_episodes: u64,
    n_steps: u64,
    n_rows: u64,
    observation_width: usize,
    action_width: usize,
    episode_rule: String,
    boundaries_inferred: bool,
    episode_ends: serde_json::Map<String, Value>,
    episode_lengths: Option<SpreadPart>,
    returns: Option<SpreadPart>,
    success_rate: Option<f64>,
    n_success_known: u64,
    ref_min_score: Option<f64>,
    ref_max_score: Option<f64>,
    columns: Vec<Value>,
    warnings: Vec<String>,
}

#[derive(Serialize)]
struct SpreadPart {
    mean: f64,
    std: f64,
    min: f64,
    max: f64,
}

impl From<Spread> for SpreadPart {
    fn from(spread: Spread) -> Self {
        Self {
            mean: spread.mean,
            std: spread.std,
            min: spread.min,
            max: spread.max,
        }
    }
}

impl InfoDocument {
    fn new(info: &DatasetInfo, summary: &Summary) -> Self {
        let columns = summary.columns.iter().map(|column| {
            json!({
                "name": column.name,
                "type": column.data_type,
                "width": column.width,
                "n_null": column.n_null,
                "n_nan": column.n_nan,
                "n_infinite": column.n_infinite,
            })
        });
        let ends = summary
            .ends
            .iter()
            .map(|(end, n)| (end.to_string(), json!(n)));
        Self {
            schema: INFO_SCHEMA,
            id: info.id.clone(),
            format: info.format.name(),
            path: info.path.display().to_string(),
            n_episodes: summary.n_episodes,
            n_steps: summary.n_steps,
            n_rows: summary.n_rows,
            observation_width: info.observation_width(),
            action_width: info.action_width(),
            episode_rule: info.episode_rule.clone(),
            boundaries_inferred: info.boundaries_inferred,
            episode_ends: ends.collect(),
            episode_lengths: summary.lengths.map(SpreadPart::from),
            returns: summary.returns.map(SpreadPart::from),
            success_rate: summary.success_rate,
            n_success_known: summary.n_success_known,
            ref_min_score: info.ref_min_score,
            ref_max_score: info.ref_max_score,
            columns: columns.collect(),
            warnings: info.warnings.iter().map(ToString::to_string).collect(),
        }
    }
}

/// The returns that count as 0 and 1 in normalized scores.
fn reference_scores(info: &DatasetInfo) -> String {
    match (info.ref_min_score, info.ref_max_score) {
        (Some(low), Some(high)) => {
            format!("returns of {low} and {high} count as 0 and 1")
        }
        _ => "not known".to_owned(),
    }
}

fn info_text(info: &DatasetInfo, summary: &Summary) -> String {
    let spread = |spread: Option<Spread>| match spread {
        Some(Spread {
            mean,
            std,
            min,
            max,
        }) => {
            let [mean, std, min, max] = [mean, std, min, max].map(table::number);
            format!("mean {mean}, std {std}, from {min} to {max}")
        }
        None => "not recorded".to_owned(),
    };
    let success = match summary.success_rate {
        Some(rate) => {
            format!(
                "{:.1} % of the {} episodes where it is known",
                100.0 * rate,
                summary.n_success_known
            )
        }
        None => "not recorded".to_owned(),
    };
    let ends: Vec<String> = summary
        .ends
        .iter()
        .map(|(end, n)| format!("{n} {end}"))
        .collect();
    let inferred = if info.boundaries_inferred {
        " (inferred, not recorded)"
    } else {
        ""
    };
    let finals = summary.n_rows.saturating_sub(summary.n_steps);
    let steps = match finals {
        0 => summary.n_steps.to_string(),
        _ => format!(
            "{} (and {finals} rows with only a final observation)",
            summary.n_steps
        ),
    };
    let rows = [
        ("dataset", info.id.clone()),
        ("format", info.format.name().to_owned()),
        ("path", info.path.display().to_string()),
        ("episodes", summary.n_episodes.to_string()),
        ("steps", steps),
        ("lengths", spread(summary.lengths)),
        ("ends", ends.join(", ")),
        ("episode rule", format!("{}{inferred}", info.episode_rule)),
        ("returns", spread(summary.returns)),
        ("success", success),
        ("reference scores", reference_scores(info)),
        (
            "observation",
            format!("{} columns", info.observation_width()),
        ),
        ("action", format!("{} columns", info.action_width())),
    ];
    let header = ["column", "type", "width", "null rows", "NaN", "infinite"].map(str::to_owned);
    let columns = summary.columns.iter().map(|column| {
        vec![
            column.name.clone(),
            column.data_type.clone(),
            column.width.to_string(),
            column.n_null.to_string(),
            column.n_nan.to_string(),
            column.n_infinite.to_string(),
        ]
    });
    let columns: Vec<_> = [header.to_vec()].into_iter().chain(columns).collect();
    format!("{}\n{}", table::properties(&rows), table::align(&columns))
}
