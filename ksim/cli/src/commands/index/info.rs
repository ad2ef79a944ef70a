//! `ksim index info`.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Args;
use ksim_index::{About, SavedIndex};
use serde::Serialize;

use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::table;

/// Show what an index was built from, and check it
#[derive(Debug, Clone, Args)]
pub(crate) struct InfoArgs {
    /// The index
    #[arg(value_name = "FILE")]
    index: PathBuf,
    /// Check every byte against the checksums, not only what is shown
    #[arg(long)]
    check: bool,
    /// How to print the result
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
}

/// As JSON: `ksim.index/1`.
#[derive(Serialize)]
struct Shown<'a> {
    schema: &'static str,
    format_version: u32,
    n_bytes: usize,
    checked: bool,
    #[serde(flatten)]
    about: &'a About,
    sections: Vec<Section>,
}

#[derive(Serialize)]
struct Section {
    name: String,
    n_bytes: u64,
}

/// Prints.
pub(super) fn run(args: &InfoArgs) -> Result<CommandOutcome> {
    let path = || args.index.display().to_string();
    let index = SavedIndex::open(&args.index).with_context(path)?;
    if args.check {
        index.verify().with_context(path)?;
    }
    match args.format {
        OutputFormat::Text => output::text(&text(&index, args.check))?,
        OutputFormat::Json => {
            let sections = index.sections().into_iter().map(|section| Section {
                name: section.name,
                n_bytes: section.n_bytes,
            });
            output::json(&Shown {
                schema: "ksim.index/1",
                format_version: ksim_index::VERSION,
                n_bytes: index.n_bytes(),
                checked: args.check,
                about: index.about(),
                sections: sections.collect(),
            })?;
        }
    }
    Ok(CommandOutcome::Done)
}

/// The first few and the last.
fn names(all: &[String]) -> String {
    match all {
        [first, second, _, .., last] if all.len() > 6 => format!("{first}, {second}, … {last}"),
        all => all.join(", "),
    }
}

fn text(index: &SavedIndex, checked: bool) -> String {
    let about = index.about();
    let dataset = &about.dataset;
    let clusters = match &about.clusters {
        None => "none: for exact search only".to_owned(),
        Some(clusters) => match &clusters.backend {
            Some(backend) => format!(
                "{}, fitted by {backend} with seed {}",
                clusters.n_clusters, clusters.seed
            ),
            None => format!("{}, of given centers", clusters.n_clusters),
        },
    };
    let sections: Vec<String> = index
        .sections()
        .iter()
        .map(|section| format!("{} {:.1} MB", section.name, section.n_bytes as f64 / 1e6))
        .collect();
    table::properties(&[
        (
            "index",
            format!(
                "version {}, {:.1} MB, by ksim {}",
                ksim_index::VERSION,
                index.n_bytes() as f64 / 1e6,
                about.ksim
            ),
        ),
        (
            "dataset",
            format!("{} ({}), {}", dataset.name, dataset.format, dataset.path),
        ),
        (
            "steps",
            format!(
                "{} of {} episodes, fingerprint {}",
                dataset.n_steps, dataset.n_episodes, dataset.fingerprint
            ),
        ),
        (
            "state",
            format!(
                "{} columns: {}",
                about.state_columns.len(),
                names(&about.state_column_names)
            ),
        ),
        ("action", format!("{} columns", about.action_dim)),
        ("clusters", clusters),
        ("sections", sections.join(", ")),
        (
            "checked",
            if checked {
                "every byte"
            } else {
                "the frame; --check looks at every byte"
            }
            .to_owned(),
        ),
    ])
}
