//! `ksim convert`: from one dataset format to another.

use std::ops::{ControlFlow, Range};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, anyhow, bail};
use clap::{Args, ValueEnum};
use ksim_datasets::convert::{Cast, ConvertOptions, ConvertReport, convert};
use ksim_datasets::{FinalObservation, Format, Loss, McapEncoding, WriteOptions, arrow_type};
use serde_json::{Value, json};

use crate::atomic;
use crate::context::Context;
use crate::data_args::{self, DataArgs};
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::table;

/// Name and version of the schema of `ksim convert --format json`.
const SCHEMA: &str = "ksim.convert/1";

/// Convert a dataset or recording to another format
///
/// Reads every format that ksim knows and writes Parquet, Arrow IPC, D4RL, Minari, LeRobot v3.0 or MCAP. The
/// report says what the new format cannot hold. Nothing is visible at the destination before it is complete.
#[derive(Debug, Clone, Args)]
pub(crate) struct ConvertArgs {
    /// A file, a folder, or a name such as antmaze-large-play
    #[arg(value_name = "IN")]
    input: String,
    /// Where to write: a file, or a folder for Minari and LeRobot
    #[arg(value_name = "OUT")]
    output: PathBuf,
    /// Format to write [default: by the suffix of OUT: .parquet, .arrow, .hdf5 (D4RL), .mcap]
    #[arg(long, value_enum, value_name = "FORMAT")]
    to: Option<Target>,
    /// Keep only these episodes: numbers and half-open ranges
    #[arg(long, value_name = "0..10,15", value_delimiter = ',', value_parser = episode_range)]
    episodes: Option<Vec<Range<i64>>>,
    /// Keep only these columns; `observation` stands for all columns below it
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    columns: Option<Vec<String>>,
    /// Change value types; without NAME, of all floating-point observations and actions
    #[arg(long, value_name = "[NAME=]TYPE", value_delimiter = ',', value_parser = cast)]
    cast: Vec<Cast>,
    /// Replace a dataset that is already there
    #[arg(long)]
    overwrite: bool,
    /// How to print the report
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
    #[command(flatten)]
    write: WriteArgs,
    #[command(flatten)]
    data: DataArgs,
}

/// What formats need that the source may lack.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Writing")]
struct WriteArgs {
    /// Dataset id to write, for Minari [default: the source's, or the name of OUT]
    #[arg(long, value_name = "ID")]
    id: Option<String>,
    /// Where Minari's observation after the last step comes from, if there is none
    #[arg(long, value_enum, default_value_t = FinalArg::Recorded)]
    final_observation: FinalArg,
    /// Steps per second, for LeRobot [default: the source's]
    #[arg(long, value_name = "HZ", value_parser = rate)]
    fps: Option<f64>,
    /// Task text of episodes without one, for LeRobot
    #[arg(long, value_name = "TEXT")]
    task: Option<String>,
    /// Name of the robot, for LeRobot
    #[arg(long, value_name = "NAME")]
    robot_type: Option<String>,
    /// How messages are encoded in MCAP
    #[arg(long, value_enum, default_value_t = EncodingArg::Protobuf)]
    mcap_encoding: EncodingArg,
}

/// The formats that are written.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum Target {
    /// Canonical table of steps, zstd
    Parquet,
    /// The same, uncompressed, for memory mapping
    #[value(alias = "ipc", alias = "feather")]
    Arrow,
    /// Flat HDF5 file as D4RL's
    #[value(alias = "d4rl-hdf5")]
    D4rl,
    /// Minari dataset folder, HDF5 storage
    #[value(alias = "minari")]
    MinariHdf5,
    /// Minari dataset folder, Arrow storage
    MinariArrow,
    /// Minari dataset folder, Parquet storage
    MinariParquet,
    /// LeRobot v3.0 dataset folder
    Lerobot,
    /// MCAP recording
    Mcap,
}

impl From<Target> for Format {
    fn from(target: Target) -> Self {
        match target {
            Target::Parquet => Self::Parquet,
            Target::Arrow => Self::ArrowIpc,
            Target::D4rl => Self::D4rlHdf5,
            Target::MinariHdf5 => Self::MinariHdf5,
            Target::MinariArrow => Self::MinariArrow,
            Target::MinariParquet => Self::MinariParquet,
            Target::Lerobot => Self::LeRobot,
            Target::Mcap => Self::Mcap,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum FinalArg {
    /// The recorded next observation; without one, the last step is given up for its observation
    Recorded,
    /// The last observation once more
    Duplicate,
    /// Always give up the last step
    DropStep,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum EncodingArg {
    /// Exact and compact, descriptors in the file
    Protobuf,
    /// Readable by anything
    Json,
}

impl WriteArgs {
    fn options(&self) -> WriteOptions {
        WriteOptions {
            id: self.id.clone(),
            overwrite: false,
            final_observation: match self.final_observation {
                FinalArg::Recorded => FinalObservation::Recorded,
                FinalArg::Duplicate => FinalObservation::Duplicate,
                FinalArg::DropStep => FinalObservation::DropStep,
            },
            fps: self.fps,
            task: self.task.clone(),
            robot_type: self.robot_type.clone(),
            mcap_encoding: match self.mcap_encoding {
                EncodingArg::Protobuf => McapEncoding::Protobuf,
                EncodingArg::Json => McapEncoding::Json,
            },
        }
    }
}

/// Episode numbers: one, or a half-open range.
pub(crate) fn episode_range(text: &str) -> Result<Range<i64>> {
    let number = |text: &str| text.parse::<i64>().with_context(|| format!("\"{text}\""));
    let range = match text.split_once("..") {
        Some((start, end)) => number(start)?..number(end)?,
        None => {
            let one = number(text)?;
            one..one.checked_add(1).context("too large")?
        }
    };
    if range.is_empty() {
        bail!("an empty range: the end is not part of it");
    }
    Ok(range)
}

fn cast(text: &str) -> Result<Cast> {
    let (columns, name) = match text.split_once('=') {
        Some((column, name)) => (Some(column.to_owned()), name),
        None => (None, text),
    };
    let to = arrow_type(name).with_context(|| {
        format!("unknown type \"{name}\", expected float16, float32, float64, int8 to int64 or uint8 to uint64")
    })?;
    Ok(Cast { columns, to })
}

fn rate(text: &str) -> Result<f64> {
    let rate: f64 = text.parse()?;
    if rate.is_finite() && rate > 0.0 {
        Ok(rate)
    } else {
        bail!("expected a number above 0")
    }
}

/// Converts and reports.
pub(crate) fn run(args: &ConvertArgs, context: &Context) -> Result<CommandOutcome> {
    let format = match args.to {
        Some(target) => target.into(),
        None => format_of(&args.output)?,
    };
    let (resolved, source) = data_args::open(&args.input, &args.data.open_options())?;
    atomic::check_not_an_input(&args.output, [resolved.path.as_path()])?;
    let options = ConvertOptions {
        format,
        episodes: args.episodes.clone(),
        columns: args.columns.clone(),
        casts: args.cast.clone(),
        write: WriteOptions {
            overwrite: args.overwrite,
            ..args.write.options()
        },
    };
    let steps = source.info().n_steps.unwrap_or(0);
    let progress = context.bar(format!("writing {}", args.output.display()), steps, "rows");
    let _cooperative = atomic::Cooperative::begin();
    let report = convert(&*source, &args.output, &options, &mut |done| {
        progress.set_of(done.rows, done.of);
        match atomic::is_interrupted() {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        }
    })?;
    drop(progress);
    for warning in &report.source.warnings {
        context.warn(&format!("{}: {warning}", report.source.path.display()));
    }
    match args.format {
        OutputFormat::Text => output::text(&text(&report))?,
        OutputFormat::Json => output::json(&document(&report))?,
    }
    Ok(CommandOutcome::of([&report.source]))
}

/// The format that a name tells.
pub(crate) fn format_of(output: &Path) -> Result<Format> {
    let suffix = output.extension().and_then(|suffix| suffix.to_str());
    match suffix {
        Some("parquet") => Ok(Format::Parquet),
        Some("arrow" | "feather" | "ipc") => Ok(Format::ArrowIpc),
        Some("hdf5" | "h5") => Ok(Format::D4rlHdf5),
        Some("mcap") => Ok(Format::Mcap),
        _ => Err(anyhow!(
            "the name {} does not tell the format: say --to minari-hdf5, lerobot, parquet, …",
            output.display()
        )),
    }
}

fn text(report: &ConvertReport) -> String {
    let written = &report.written;
    let rows = [
        (
            "from",
            format!(
                "{} ({})",
                report.source.path.display(),
                report.source.format
            ),
        ),
        (
            "to",
            format!("{} ({})", written.path.display(), written.format),
        ),
        ("episodes", report.n_episodes.to_string()),
        ("steps", steps_text(report)),
        ("left out", joined(&report.left_out, "nothing")),
    ];
    let mut text = table::properties(&rows);
    for cast in &report.casts {
        text += &format!(
            "\ncast {} from {} to {}: {} values changed, by {:e} at most",
            cast.column, cast.from, cast.to, cast.n_changed, cast.max_abs_error
        );
    }
    if !report.casts.is_empty() {
        text.push('\n');
    }
    if report.losses.is_empty() {
        text += match CommandOutcome::of([&report.source]) {
            CommandOutcome::DoneWithDataLoss => {
                "\nnothing more was lost than the warnings on reading say\n"
            }
            _ => "\nnothing was lost\n",
        };
        return text;
    }
    let header = ["what", "became", "how many", "why"].map(str::to_owned);
    let losses = report.losses.iter().map(|loss| {
        vec![
            loss.item.clone(),
            loss.effect.name().to_owned(),
            loss.count
                .map_or_else(|| "all".to_owned(), |n| n.to_string()),
            loss.detail.clone(),
        ]
    });
    text.push('\n');
    text += &table::align(
        &[header.to_vec()]
            .into_iter()
            .chain(losses)
            .collect::<Vec<_>>(),
    );
    text
}

fn steps_text(report: &ConvertReport) -> String {
    let (steps, finals) = (report.n_steps, report.n_rows.saturating_sub(report.n_steps));
    match report.written.n_steps {
        Some(written) if written != steps => format!("{steps} read, {written} written"),
        _ if finals > 0 => format!("{steps} (and {finals} final observations)"),
        _ => steps.to_string(),
    }
}

fn joined(names: &[String], nothing: &str) -> String {
    if names.is_empty() {
        nothing.to_owned()
    } else {
        names.join(", ")
    }
}

fn document(report: &ConvertReport) -> Value {
    let casts = report.casts.iter().map(|cast| {
        json!({
            "column": cast.column,
            "from": cast.from.to_string(),
            "to": cast.to.to_string(),
            "n_changed": cast.n_changed,
            "max_abs_error": cast.max_abs_error,
        })
    });
    let loss = |loss: &Loss| {
        json!({
            "item": loss.item,
            "effect": loss.effect.name(),
            "count": loss.count,
            "detail": loss.detail,
        })
    };
    let warnings = report.source.warnings.iter().map(ToString::to_string);
    json!({
        "schema": SCHEMA,
        "from": { "path": report.source.path.display().to_string(), "format": report.source.format.name() },
        "to": {
            "path": report.written.path.display().to_string(),
            "format": report.written.format.name(),
            "id": report.written.id,
            "n_episodes": report.written.n_episodes,
            "n_steps": report.written.n_steps,
        },
        "n_episodes": report.n_episodes,
        "n_steps": report.n_steps,
        "n_rows": report.n_rows,
        "left_out": report.left_out,
        "casts": casts.collect::<Vec<_>>(),
        "losses": report.losses.iter().map(loss).collect::<Vec<_>>(),
        "warnings": warnings.collect::<Vec<_>>(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn episodes_are_numbers_and_half_open_ranges() {
        assert_eq!(episode_range("3").unwrap(), 3..4);
        assert_eq!(episode_range("0..10").unwrap(), 0..10);
        for wrong in ["", "a", "3..3", "1..", "9223372036854775807"] {
            assert!(episode_range(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_suffix_tells_the_format_and_a_folder_does_not() {
        assert_eq!(format_of(Path::new("a.mcap")).unwrap(), Format::Mcap);
        let error = format_of(Path::new("out")).unwrap_err().to_string();
        assert!(error.contains("--to"), "{error}");
    }
}
