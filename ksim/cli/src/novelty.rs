//! Novelty of every step, as `ksim rollout --planner` records it.

use std::collections::BTreeMap;

use anyhow::{Context as _, Result, bail};
use arrow::array::{Array as _, AsArray as _};
use arrow::datatypes::{DataType, Float64Type, Int64Type};
use ksim_datasets::{DatasetSource, EpisodeRecord, Scan, schema};

/// The column.
const NOVELTY: &str = "info.novelty";

/// The novelties of some episodes, in the order of their steps.
///
/// # Errors
/// The file has no such column, or it is empty: the planner knows no novelty.
pub(crate) fn novelties(
    source: &dyn DatasetSource,
    chosen: &[EpisodeRecord],
) -> Result<Vec<Vec<f64>>> {
    let path = source.info().path.display();
    if source.schema().field_with_name(NOVELTY).is_err() {
        bail!("{path}: no column \"{NOVELTY}\": expected what `ksim rollout --planner` records");
    }
    let scan = Scan {
        columns: Some(vec![schema::EPISODE_INDEX.to_owned(), NOVELTY.to_owned()]),
        episodes: Some(chosen.iter().map(|episode| episode.episode_index).collect()),
        ..Scan::default()
    };
    let mut found = BTreeMap::<i64, Vec<f64>>::new();
    for batch in source.scan(&scan)? {
        let batch = batch?;
        let column = |name: &str| batch.column_by_name(name).context("a column vanished");
        let episodes = column(schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        let values = arrow::compute::cast(column(NOVELTY)?, &DataType::Float64)?;
        let values = values.as_primitive::<Float64Type>();
        for (row, episode) in episodes.values().iter().enumerate() {
            // Null below the last step, where there is an observation only.
            if values.is_valid(row) {
                found.entry(*episode).or_default().push(values.value(row));
            }
        }
    }
    if found.is_empty() {
        bail!("{path}: column \"{NOVELTY}\" is empty: the planner knows no novelty");
    }
    let of = |episode: &EpisodeRecord| found.remove(&episode.episode_index).unwrap_or_default();
    Ok(chosen.iter().map(of).collect())
}
