//! Novelty of every step, as `ksim rollout --planner` records it.

use std::collections::BTreeMap;

use anyhow::{Context as _, Result, bail};
use arrow::array::AsArray as _;
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
    let Some(rows) = rows(source, chosen)? else {
        bail!("{path}: no column \"{NOVELTY}\": expected what `ksim rollout --planner` records");
    };
    if rows.iter().flatten().all(Option::is_none) {
        bail!("{path}: column \"{NOVELTY}\" is empty: the planner knows no novelty");
    }
    let known = |rows: Vec<Option<f64>>| rows.into_iter().flatten().collect();
    Ok(rows.into_iter().map(known).collect())
}

/// The novelty of every row of some episodes, `None` where it is null; `None` without such a column.
///
/// # Errors
/// A column that does not hold numbers, and those of the reader.
pub(crate) fn rows(
    source: &dyn DatasetSource,
    chosen: &[EpisodeRecord],
) -> Result<Option<Vec<Vec<Option<f64>>>>> {
    let path = source.info().path.display();
    let columns = source.schema();
    let Ok(field) = columns.field_with_name(NOVELTY) else {
        return Ok(None);
    };
    if !matches!(field.data_type(), DataType::Null) && !field.data_type().is_numeric() {
        bail!(
            "{path}: column \"{NOVELTY}\" holds {}, expected numbers",
            field.data_type()
        );
    }
    let scan = Scan {
        columns: Some(vec![schema::EPISODE_INDEX.to_owned(), NOVELTY.to_owned()]),
        episodes: Some(chosen.iter().map(|episode| episode.episode_index).collect()),
        ..Scan::default()
    };
    let mut found = BTreeMap::<i64, Vec<Option<f64>>>::new();
    for batch in source.scan(&scan)? {
        let batch = batch.with_context(|| path.to_string())?;
        let column = |name: &str| batch.column_by_name(name).context("a column vanished");
        let episodes = column(schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        let values = arrow::compute::cast(column(NOVELTY)?, &DataType::Float64)?;
        let values = values.as_primitive::<Float64Type>();
        for (episode, value) in episodes.values().iter().zip(values) {
            found.entry(*episode).or_default().push(value);
        }
    }
    let of = |episode: &EpisodeRecord| found.remove(&episode.episode_index).unwrap_or_default();
    Ok(Some(chosen.iter().map(of).collect()))
}
