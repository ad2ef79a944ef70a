//! The report for programs.

use serde_json::{Value, json as object};

use super::Report;
use crate::suite::Played;

/// Name and version of the schema.
const SCHEMA: &str = "ksim.bench-report/1";

/// The report as JSON, with what it was made with.
pub fn json(report: &Report, played: &Played) -> Value {
    let entries = report.entries.iter().map(|entry| {
        object!({
            "environment": entry.environment,
            "planner": entry.planner,
            "family": entry.family,
            "finished": entry.finished,
            "summary": entry.summary,
            "k_sim": entry.k_sim,
            "novelty": entry.novelty,
            "paper": entry.paper,
        })
    });
    object!({
        "schema": SCHEMA,
        "suite": report.suite,
        "runs": report.runs,
        "episodes": report.episodes,
        "seed": report.seed,
        "finished": played.finished,
        "results": entries.collect::<Vec<_>>(),
        "manifest": played.manifest,
    })
}
