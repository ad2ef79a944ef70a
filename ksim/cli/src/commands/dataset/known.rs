//! `ksim dataset list --known`: what is published.

use anyhow::Result;
use ksim_datasets::registry::{self, Family, Known};
use serde_json::{Value, json};

use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::table;

/// Name and version of the schema of `ksim dataset list --known --format json`.
const SCHEMA: &str = "ksim.known-datasets/1";

/// Prints the datasets whose id fits.
pub(super) fn list(pattern: &str, format: OutputFormat) -> Result<CommandOutcome> {
    let fits = |id: &str| match pattern.contains('*') {
        true => registry::matches(pattern, id),
        false => id.contains(pattern),
    };
    let known: Vec<&Known> = registry::all().filter(|known| fits(known.id)).collect();
    let families: Vec<&Family> = registry::families()
        .filter(|family| fits(family.pattern) || family.matches(pattern))
        .collect();
    match format {
        OutputFormat::Text => output::text(&text(&known, &families))?,
        OutputFormat::Json => output::json(&document(&known, &families))?,
    }
    Ok(CommandOutcome::Done)
}

fn text(known: &[&Known], families: &[&Family]) -> String {
    if known.is_empty() && families.is_empty() {
        return "no published dataset of such a name is known\n".to_owned();
    }
    let header = ["dataset", "store", "MB", "episodes", "steps", "note"].map(str::to_owned);
    let count = |n: Option<u64>| n.map_or_else(|| "?".to_owned(), |n| n.to_string());
    let rows = known.iter().map(|one| {
        let megabytes = one.bytes.map(|bytes| format!("{:.1}", bytes as f64 / 1e6));
        let deprecated = if one.is_deprecated { "deprecated" } else { "" };
        let note: Vec<&str> = [deprecated, one.note.unwrap_or_default()]
            .into_iter()
            .filter(|part| !part.is_empty())
            .collect();
        vec![
            one.id.to_owned(),
            one.store.to_string(),
            megabytes.unwrap_or_else(|| "?".to_owned()),
            count(one.n_episodes),
            count(one.n_steps),
            note.join(": "),
        ]
    });
    let families = families.iter().map(|family| {
        let unknown = || "?".to_owned();
        let (id, store) = (family.pattern.to_owned(), family.store.to_string());
        vec![
            id,
            store,
            unknown(),
            unknown(),
            unknown(),
            family.note.to_owned(),
        ]
    });
    let rows: Vec<_> = [header.to_vec()]
        .into_iter()
        .chain(rows)
        .chain(families)
        .collect();
    table::align(&rows)
}

fn document(known: &[&Known], families: &[&Family]) -> Value {
    let datasets = known.iter().map(|one| {
        json!({
            "id": one.id,
            "store": one.store.name(),
            "url": one.url(),
            "file_name": one.file_name(),
            "bytes": one.bytes,
            "sha256": one.sha256,
            "n_episodes": one.n_episodes,
            "n_steps": one.n_steps,
            "ref_min_score": one.ref_min_score,
            "ref_max_score": one.ref_max_score,
            "is_deprecated": one.is_deprecated,
            "note": one.note,
        })
    });
    let families = families.iter().map(|family| {
        json!({ "pattern": family.pattern, "store": family.store.name(), "note": family.note })
    });
    json!({
        "schema": SCHEMA,
        "datasets": datasets.collect::<Vec<_>>(),
        "families": families.collect::<Vec<_>>(),
    })
}
