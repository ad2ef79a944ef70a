//! `ksim dataset inspect`: what a recording holds.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clap::Args;
use ksim_datasets::mcap::{FieldDescription, FieldKind, FieldLength, Inspection, TopicInspection};
use ksim_datasets::{DatasetError, Format, Warning};
use serde_json::{Value, json};

use crate::atomic;
use crate::context::Context;
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::table;

/// Name and version of the schema of `ksim dataset inspect --format json`.
const SCHEMA: &str = "ksim.dataset-inspect/1";

/// Show what an MCAP recording holds: topics, types, rates, gaps; and propose a mapping
#[derive(Debug, Clone, Args)]
pub(crate) struct InspectArgs {
    /// An MCAP file, or a folder of them
    #[arg(value_name = "FILE.mcap|FOLDER")]
    recording: PathBuf,
    /// How to print it
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
    /// Write a mapping to start from: the one that the recording brings along, or a guess by topic names and types, with
    /// comments
    #[arg(long, value_name = "OUT.toml")]
    propose: Option<PathBuf>,
    /// Read what is whole of a damaged file, and say what is lost
    #[arg(long)]
    recover: bool,
}

/// Runs the command.
pub(crate) fn run(args: &InspectArgs, context: &Context) -> Result<CommandOutcome> {
    let format = ksim_datasets::detect(&args.recording)?;
    if format != Format::Mcap {
        bail!(
            "{}: a dataset of format {format}, expected an MCAP recording; `ksim dataset info` describes datasets",
            args.recording.display()
        );
    }
    if let Some(target) = &args.propose {
        atomic::check_target(target)?;
        if target.exists() {
            bail!(
                "{}: there is something already; choose another name or remove it",
                target.display()
            );
        }
    }
    let progress = context.spinner(format!("reading {}", args.recording.display()));
    let inspection = ksim_datasets::mcap::inspect(&args.recording, args.recover);
    drop(progress);
    let inspection = inspection?;
    if let Some(target) = &args.propose {
        propose(&inspection, &args.recording, target)?;
    }
    match args.format {
        OutputFormat::Text => output::text(&text(&inspection))?,
        OutputFormat::Json => output::json(&document(&inspection))?,
    }
    for warning in &inspection.warnings {
        context.warn(&format!("{}: {warning}", args.recording.display()));
    }
    let is_lost = |warning: &Warning| matches!(warning, Warning::Lost { .. });
    Ok(match inspection.warnings.iter().any(is_lost) {
        true => CommandOutcome::DoneWithDataLoss,
        false => CommandOutcome::Done,
    })
}

fn propose(inspection: &Inspection, recording: &Path, target: &Path) -> Result<()> {
    let toml = inspection.propose().map_err(|error| match error {
        DatasetError::Empty => anyhow::anyhow!(
            "{}: no topic has numbers or pictures that can be decoded, so there is nothing to propose",
            recording.display()
        ),
        other => other.into(),
    })?;
    atomic::write(target, toml.as_bytes())
}

fn text(inspection: &Inspection) -> String {
    let or_dash = |number: Option<f64>| number.map_or_else(|| "-".to_owned(), table::number);
    let span = |span: Option<(u64, u64)>| span.map(|(first, last)| (last - first) as f64 / 1e9);
    let compression = inspection.compression.iter().map(|(name, n)| {
        let name = if name.is_empty() { "none" } else { name };
        format!("{n} chunks {name}")
    });
    let rows = [
        ("files", inspection.files.len().to_string()),
        ("profile", inspection.profile.clone()),
        ("library", inspection.library.clone()),
        ("compression", compression.collect::<Vec<_>>().join(", ")),
        ("seconds", or_dash(span(inspection.span_ns))),
    ];
    let header = [
        "topic",
        "type",
        "encoding",
        "messages",
        "rate Hz",
        "jitter ms",
        "largest gap s",
        "log - stamp ms",
    ];
    let mut topics = vec![header.map(str::to_owned).to_vec()];
    topics.extend(inspection.topics.iter().map(|topic| {
        vec![
            topic.topic.clone(),
            topic.schema.clone(),
            encoding(topic),
            topic.n_messages.to_string(),
            or_dash(topic.rate_hz),
            or_dash(topic.jitter_ms),
            or_dash(topic.largest_gap_s),
            or_dash(topic.skew_ms),
        ]
    }));
    format!(
        "{}\n{}\nnumeric fields\n{}{}",
        table::properties(&rows),
        table::align(&topics),
        fields_text(inspection),
        records_text(inspection)
    )
}

fn fields_text(inspection: &Inspection) -> String {
    let mut text = String::new();
    for topic in &inspection.topics {
        let fields: Vec<String> = topic
            .numeric_fields()
            .map(|field| format!("{}{}", field.path, length(field)))
            .collect();
        match &topic.undecodable {
            Some(why) => text.extend(["  ", &topic.topic, ": not decoded: ", why, "\n"]),
            None => text.extend(["  ", &topic.topic, ": ", &fields.join(", "), "\n"]),
        }
    }
    text
}

/// Metadata records and attachments.
fn records_text(inspection: &Inspection) -> String {
    let mut text = String::new();
    for record in &inspection.metadata {
        text.extend(["\nmetadata \"", &record.name, "\"\n"]);
        for (key, value) in &record.entries {
            text.extend([
                "  ",
                key,
                ": ",
                value.lines().next().unwrap_or_default(),
                "\n",
            ]);
        }
    }
    for attachment in &inspection.attachments {
        let size = format!("{} bytes", attachment.size);
        text.extend([
            "\nattachment \"",
            &attachment.name,
            "\": ",
            &size,
            " ",
            &attachment.media_type,
            "\n",
        ]);
    }
    text
}

fn encoding(topic: &TopicInspection) -> String {
    match topic.schema_encoding.as_str() {
        "" => topic.message_encoding.clone(),
        schema => format!("{}/{schema}", topic.message_encoding),
    }
}

fn length(field: &FieldDescription) -> String {
    match field.length {
        FieldLength::One => String::new(),
        FieldLength::Fixed(n) => format!("[{n}]"),
        FieldLength::Variable { .. } => "[]".to_owned(),
    }
}

fn document(inspection: &Inspection) -> Value {
    let topics: Vec<Value> = inspection.topics.iter().map(topic_json).collect();
    let files: Vec<String> = inspection
        .files
        .iter()
        .map(|path| path.display().to_string())
        .collect();
    let metadata: Vec<Value> = inspection
        .metadata
        .iter()
        .map(|record| json!({ "name": record.name, "entries": record.entries }))
        .collect();
    let attachments: Vec<Value> = inspection
        .attachments
        .iter()
        .map(|one| json!({ "name": one.name, "media_type": one.media_type, "size": one.size }))
        .collect();
    json!({
        "schema": SCHEMA,
        "files": files,
        "profile": inspection.profile,
        "library": inspection.library,
        "compression": inspection.compression,
        "start_ns": inspection.span_ns.map(|span| span.0),
        "end_ns": inspection.span_ns.map(|span| span.1),
        "topics": topics,
        "metadata": metadata,
        "attachments": attachments,
        "warnings": inspection.warnings.iter().map(ToString::to_string).collect::<Vec<_>>(),
    })
}

fn topic_json(topic: &TopicInspection) -> Value {
    let fields: Vec<Value> = topic
        .fields
        .iter()
        .map(|field| {
            let kind = match &field.kind {
                FieldKind::Number(data_type) => data_type.to_string(),
                other => format!("{other:?}"),
            };
            json!({ "path": field.path, "kind": kind, "length": length(field) })
        })
        .collect();
    json!({
        "topic": topic.topic,
        "type": topic.schema,
        "schema_encoding": topic.schema_encoding,
        "message_encoding": topic.message_encoding,
        "n_messages": topic.n_messages,
        "start_ns": topic.span_ns.map(|span| span.0),
        "end_ns": topic.span_ns.map(|span| span.1),
        "rate_hz": topic.rate_hz,
        "jitter_ms": topic.jitter_ms,
        "largest_gap_s": topic.largest_gap_s,
        "log_minus_stamp_ms": topic.skew_ms,
        "fields": fields,
        "undecodable": topic.undecodable,
    })
}
