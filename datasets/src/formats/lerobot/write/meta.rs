//! The files of `meta`, and what of the source's metadata has no place in them.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array, RecordBatch, StringArray};
use arrow::datatypes::{DataType, Field, Schema};
use serde_json::{Value, json};

use super::super::attributes::TASKS;
use super::super::columns::TASK_INDEX;
use super::files;
use super::plan::loss;
use super::rate::is_lerobot;
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::sink::{Loss, LossEffect, WriteOptions};

/// Writes `tasks.parquet`; the text is noted as pandas' index, by which LeRobot finds it.
///
/// # Errors
/// A failed write.
pub(super) fn write_tasks(path: &Path, texts: &[String]) -> Result<()> {
    let column = |name: &str, pandas: &str, numpy: &str| json!({"name": name, "field_name": name, "pandas_type": pandas, "numpy_type": numpy, "metadata": null});
    let note = json!({
        "index_columns": ["task"],
        "column_indexes": [{
            "name": null, "field_name": null, "pandas_type": "unicode", "numpy_type": "object",
            "metadata": {"encoding": "UTF-8"},
        }],
        "columns": [
            column(TASK_INDEX, "int64", "int64"),
            column("task", "unicode", "object"),
        ],
        "attributes": {},
        "creator": {"library": "pyarrow", "version": "21.0.0"},
        "pandas_version": "2.3.3",
    });
    let fields = vec![
        Field::new(TASK_INDEX, DataType::Int64, true),
        Field::new("task", DataType::Utf8, true),
    ];
    let noted = [("pandas".to_owned(), note.to_string())];
    let schema = Arc::new(Schema::new_with_metadata(fields, noted.into()));
    let columns: Vec<ArrayRef> = vec![
        Arc::new(Int64Array::from_iter_values((0i64..).take(texts.len()))),
        Arc::new(StringArray::from_iter_values(texts)),
    ];
    let batch = RecordBatch::try_new(Arc::clone(&schema), columns)
        .map_err(DatasetError::arrow("build a batch"))?;
    let mut writer = files::start(path, &schema)?;
    files::write(&mut writer, &batch)?;
    files::finish(writer)
}

/// JSON as LeRobot writes it.
///
/// # Errors
/// Never, in fact: all of it is finite.
pub(super) fn pretty(value: &Value) -> Result<String> {
    serde_json::to_string_pretty(value).map_err(|source| DatasetError::Json {
        what: "a file of meta".to_owned(),
        source,
    })
}

/// The robot: as asked, else as a LeRobot source has it, else unknown.
pub(super) fn robot_type(schema: &Schema, options: &WriteOptions) -> Value {
    if let Some(robot) = &options.robot_type {
        return json!(robot);
    }
    let recorded = schema.metadata().get(schema::SOURCE_METADATA);
    let recorded = recorded.filter(|_| is_lerobot(schema));
    let info = recorded.and_then(|text| serde_json::from_str::<Value>(text).ok());
    info.map_or(Value::Null, |info| info["robot_type"].clone())
}

/// The task of each episode that records exactly one.
pub(super) fn episode_tasks(episodes: &[EpisodeRecord]) -> BTreeMap<i64, String> {
    let only = |episode: &EpisodeRecord| match episode.attributes.get(TASKS) {
        Some(Value::Array(tasks)) => match tasks.as_slice() {
            [Value::String(task)] => Some((episode.episode_index, task.clone())),
            _ => None,
        },
        _ => None,
    };
    episodes.iter().filter_map(only).collect()
}

/// Statistics of pictures that were not looked at.
pub(super) fn picture_stats(n_steps: i64) -> Value {
    let each = |values: [f64; 3]| json!(values.map(|value| [[value]]));
    json!({
        "min": each([0.0; 3]),
        "max": each([1.0; 3]),
        "mean": each([0.485, 0.456, 0.406]),
        "std": each([0.229, 0.224, 0.225]),
        "count": [n_steps],
    })
}

/// What the schema says about the source that LeRobot has no place for.
pub(super) fn metadata_losses(schema: &Schema) -> Vec<Loss> {
    let entries = [
        (schema::SPACE_OBSERVATION, "bounds and kinds of the space"),
        (schema::SPACE_ACTION, "bounds and kinds of the space"),
        (schema::ENV_SPEC, "the environment"),
        (schema::SOURCE_METADATA, "the source's own metadata"),
    ];
    let is_lost = |key: &str| {
        let kept = key == schema::SOURCE_METADATA && is_lerobot(schema);
        schema.metadata().contains_key(key) && !kept
    };
    let lost = entries.into_iter().filter(|(key, _)| is_lost(key));
    lost.map(|(key, what)| {
        let detail = format!("LeRobot has no place for {what}");
        loss(key, LossEffect::Dropped, detail)
    })
    .collect()
}
