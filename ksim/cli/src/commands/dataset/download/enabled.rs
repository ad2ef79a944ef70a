//! A build with downloads.

use anyhow::Result;
use ksim_datasets::download::{Check, DownloadOptions, Downloaded, Event, Plan, download, plan};
use ksim_datasets::registry;
use serde_json::{Value, json};

use super::DownloadArgs;
use crate::context::{Context, Progress};
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::table;

/// Name and version of the schema of `ksim dataset download --format json`.
const SCHEMA: &str = "ksim.dataset-download/1";

/// Runs the command.
pub(in super::super) fn run(args: &DownloadArgs, context: &Context) -> Result<CommandOutcome> {
    let options = DownloadOptions {
        base_url: args.base_url.clone(),
        force: args.force,
        ..DownloadOptions::from_env()
    };
    let mut documents = Vec::new();
    for name in &args.names {
        let mut teller = Teller {
            context,
            name,
            line: None,
        };
        let mut event = |event| teller.tell(event);
        let (text, document) = match args.dry_run {
            true => planned(&plan(name, &options, &mut event)?),
            false => {
                let got = download(name, &options, &mut event)?;
                drop(teller);
                warn_of_faults(&got.id, context);
                done(&got)
            }
        };
        // People see each dataset as it arrives; a document comes whole.
        match args.format {
            OutputFormat::Text => output::text(&text)?,
            OutputFormat::Json => documents.push(document),
        }
    }
    if args.format == OutputFormat::Json {
        let (dry_run, datasets) = (args.dry_run, documents);
        output::json(&json!({ "schema": SCHEMA, "dry_run": dry_run, "datasets": datasets }))?;
    }
    Ok(CommandOutcome::Done)
}

/// Shows the progress of one dataset.
struct Teller<'a> {
    context: &'a Context,
    name: &'a str,
    line: Option<Progress>,
}

impl Teller<'_> {
    fn tell(&mut self, event: Event) {
        match event {
            Event::Bytes { done, total } => {
                let line = self.line.get_or_insert_with(|| match total {
                    Some(total) => self.context.bar(self.name.to_owned(), total, "bytes"),
                    None => self.context.spinner(self.name.to_owned()),
                });
                line.set(done);
            }
            Event::Retry { what, wait } => {
                self.line = None;
                let seconds = wait.as_secs_f64();
                let name = self.name;
                self.context
                    .warn(&format!("{name}: {what}; trying again in {seconds:.1} s"));
            }
            _ => {}
        }
    }
}

fn warn_of_faults(id: &str, context: &Context) {
    let Some(known) = registry::find(id) else {
        return;
    };
    match (known.is_deprecated, known.note) {
        (true, note) => {
            let note = note.map_or_else(String::new, |note| format!(": {note}"));
            context.warn(&format!("{id} is deprecated{note}"));
        }
        (false, Some(note)) => context.warn(&format!("{id}: {note}")),
        (false, None) => {}
    }
}

fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}

fn planned(plan: &Plan) -> (String, Value) {
    let size = plan
        .bytes
        .map_or_else(|| "not known before the download".to_owned(), megabytes);
    let there = if plan.is_there {
        " (something is there already)"
    } else {
        ""
    };
    let rows = [
        ("dataset", plan.id.clone()),
        ("from", plan.url.clone()),
        ("size", size),
        ("to", format!("{}{there}", plan.destination.display())),
    ];
    let document = json!({
        "id": plan.id,
        "store": plan.store.name(),
        "url": plan.url,
        "bytes": plan.bytes,
        "path": plan.destination.display().to_string(),
        "is_there": plan.is_there,
    });
    (table::properties(&rows), document)
}

fn done(got: &Downloaded) -> (String, Value) {
    let how = match got.check {
        Check::Sha256 => "SHA-256 as published",
        Check::Opened => "no checksum is published; its length fits and it opens",
        Check::NotChecked => "not checked: the server could not be reached",
    };
    let was_there = if got.was_there {
        " (was there already)"
    } else {
        ""
    };
    let rows = [
        ("dataset", got.id.clone()),
        ("size", megabytes(got.bytes)),
        ("in", format!("{}{was_there}", got.path.display())),
        ("checked", how.to_owned()),
        ("look at it", format!("ksim dataset info {}", got.id)),
        (
            "score with it",
            format!("ksim score ROLLOUTS --dataset {}", got.id),
        ),
    ];
    let document = json!({
        "id": got.id,
        "path": got.path.display().to_string(),
        "bytes": got.bytes,
        "fetched": got.fetched,
        "was_there": got.was_there,
        "check": got.check.name(),
    });
    (table::properties(&rows), document)
}
