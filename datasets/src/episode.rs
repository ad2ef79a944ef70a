//! The table of episodes, derived from a pass over the steps.

use std::collections::HashMap;
use std::fmt;

use arrow::array::{Array, ArrayRef, AsArray, RecordBatch};
use arrow::datatypes::{DataType, Float64Type, Int64Type};
use serde_json::{Map, Value};

use crate::error::{DatasetError, Result};
use crate::schema;
use crate::source::{DatasetSource, Scan};

/// How an episode ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum EpisodeEnd {
    /// The task ended.
    Terminated,
    /// Cut by a limit that belongs to the task, such as a time limit.
    Truncated,
    /// The recording stopped; no flag says that the episode ended.
    Cut,
    /// The source has no flags.
    Unknown,
}

impl fmt::Display for EpisodeEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Terminated => "terminated",
            Self::Truncated => "truncated",
            Self::Cut => "cut",
            Self::Unknown => "unknown",
        })
    }
}

/// One episode.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeRecord {
    /// Its number.
    pub episode_index: i64,
    /// Number of steps N.
    pub length: u64,
    /// Row of its first step in a scan of the whole dataset.
    pub first_row: u64,
    /// Its rows: N, or N+1 with a final observation.
    pub n_rows: u64,
    /// How it ended; terminated wins if both flags are set.
    pub end: EpisodeEnd,
    /// Whether the observation after the last step is known.
    pub has_final_obs: bool,
    /// Seed of its reset, where recorded.
    pub seed: Option<u64>,
    /// Whether any row reports success; `None` where success is not recorded.
    pub success: Option<bool>,
    /// Sum of its rewards, undiscounted; `None` where rewards are not recorded.
    pub total_return: Option<f64>,
    /// What the source records about the episode itself (Minari's attributes, options nested).
    pub attributes: Map<String, Value>,
}

/// Derives the episodes from one pass over the few columns that are needed.
///
/// # Errors
/// Those of the scan.
pub(crate) fn derive_episodes(source: &dyn DatasetSource) -> Result<Vec<EpisodeRecord>> {
    let schema = source.schema();
    let mut wanted = vec![schema::EPISODE_INDEX.to_owned()];
    let optional = [
        schema::REWARD,
        schema::TERMINATED,
        schema::TRUNCATED,
        schema::INFO_SUCCESS,
    ];
    wanted.extend(
        optional
            .iter()
            .filter(|name| schema.index_of(name).is_ok())
            .map(|&name| name.to_owned()),
    );
    // Nulls in the action mark final-observation rows; where flags or rewards exist they do so as well.
    let marker = wanted
        .iter()
        .skip(1)
        .find(|name| *name != schema::INFO_SUCCESS)
        .cloned();
    // Without any of them every row is a step: no number of an episode is null.
    let marker = marker.unwrap_or_else(|| match action_column(&schema) {
        Ok(name) => {
            wanted.push(name.clone());
            name
        }
        Err(_) => schema::EPISODE_INDEX.to_owned(),
    });
    let mut fold = EpisodeFold::default();
    for batch in source.scan(&Scan {
        columns: Some(wanted),
        ..Scan::default()
    })? {
        fold.add(&batch?, &marker)?;
    }
    let mut episodes = fold.episodes;
    if let Some(records) = schema.metadata().get(schema::EPISODE_RECORDS) {
        add_records(&mut episodes, records)?;
    }
    Ok(episodes)
}

/// What [`schema::EPISODE_RECORDS`] holds for some episodes: `None` if there is nothing to record.
pub(crate) fn records_json(episodes: &[EpisodeRecord]) -> Option<String> {
    let records: Vec<Value> = episodes
        .iter()
        .filter(|episode| episode.seed.is_some() || !episode.attributes.is_empty())
        .map(|episode| {
            serde_json::json!({
                schema::EPISODE_INDEX: episode.episode_index,
                "seed": episode.seed,
                "attributes": episode.attributes,
            })
        })
        .collect();
    (!records.is_empty()).then(|| Value::Array(records).to_string())
}

fn add_records(episodes: &mut [EpisodeRecord], json: &str) -> Result<()> {
    let records: Vec<Map<String, Value>> =
        serde_json::from_str(json).map_err(|source| DatasetError::Json {
            what: schema::EPISODE_RECORDS.to_owned(),
            source,
        })?;
    let by_index: HashMap<i64, &Map<String, Value>> = records
        .iter()
        .filter_map(|record| Some((record.get(schema::EPISODE_INDEX)?.as_i64()?, record)))
        .collect();
    for episode in episodes {
        let Some(record) = by_index.get(&episode.episode_index) else {
            continue;
        };
        episode.seed = record.get("seed").and_then(Value::as_u64);
        if let Some(Value::Object(attributes)) = record.get("attributes") {
            episode.attributes.clone_from(attributes);
        }
    }
    Ok(())
}

/// First action column of a canonical schema.
pub(crate) fn action_column(schema: &arrow::datatypes::Schema) -> Result<String> {
    let found = schema
        .fields()
        .iter()
        .find(|field| schema::belongs_to(field.name(), schema::ACTION));
    found
        .map(|field| field.name().clone())
        .ok_or_else(|| DatasetError::MissingColumn {
            role: "action",
            name: String::new(),
            found: schema::column_names(schema),
        })
}

#[derive(Default)]
struct EpisodeFold {
    episodes: Vec<EpisodeRecord>,
    row: u64,
}

/// The columns of one batch, downcast once.
struct FoldColumns<'a> {
    marker: &'a ArrayRef,
    reward: Option<ArrayRef>,
    terminated: Option<ArrayRef>,
    truncated: Option<ArrayRef>,
    success: Option<ArrayRef>,
}

impl EpisodeFold {
    fn add(&mut self, batch: &RecordBatch, marker: &str) -> Result<()> {
        let cast = |name: &str, to: &DataType| -> Result<Option<ArrayRef>> {
            let Some(column) = batch.column_by_name(name) else {
                return Ok(None);
            };
            arrow::compute::cast(column, to)
                .map(Some)
                .map_err(DatasetError::arrow("convert a column"))
        };
        let columns = FoldColumns {
            marker: column(batch, marker)?,
            reward: cast(schema::REWARD, &DataType::Float64)?,
            terminated: cast(schema::TERMINATED, &DataType::Boolean)?,
            truncated: cast(schema::TRUNCATED, &DataType::Boolean)?,
            success: match batch.column_by_name(schema::INFO_SUCCESS) {
                Some(column) => as_flags(column)?,
                None => None,
            },
        };
        let episode = column(batch, schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        for row in 0..batch.num_rows() {
            self.add_row(episode.value(row), &columns, row);
        }
        Ok(())
    }

    fn add_row(&mut self, episode_index: i64, columns: &FoldColumns<'_>, row: usize) {
        if self
            .episodes
            .last()
            .is_none_or(|last| last.episode_index != episode_index)
        {
            let flags = columns.terminated.is_some() || columns.truncated.is_some();
            self.episodes.push(EpisodeRecord {
                episode_index,
                length: 0,
                first_row: self.row,
                n_rows: 0,
                end: if flags {
                    EpisodeEnd::Cut
                } else {
                    EpisodeEnd::Unknown
                },
                has_final_obs: false,
                seed: None,
                success: columns.success.as_ref().map(|_| false),
                total_return: columns.reward.as_ref().map(|_| 0.0),
                attributes: Map::new(),
            });
        }
        self.row += 1;
        let Some(current) = self.episodes.last_mut() else {
            return;
        };
        current.n_rows += 1;
        if flag(columns.success.as_ref(), row) == Some(true) {
            current.success = Some(true);
        }
        if columns.marker.is_null(row) {
            current.has_final_obs = true;
            return;
        }
        current.length += 1;
        if let (Some(total), Some(reward)) = (&mut current.total_return, &columns.reward) {
            *total += reward.as_primitive::<Float64Type>().value(row);
        }
        if flag(columns.terminated.as_ref(), row) == Some(true) {
            current.end = EpisodeEnd::Terminated;
        } else if flag(columns.truncated.as_ref(), row) == Some(true) {
            current.end = EpisodeEnd::Truncated;
        } else if current.end != EpisodeEnd::Unknown {
            // Only the last step's flags count: some files raise them in the middle.
            current.end = EpisodeEnd::Cut;
        }
    }
}

/// A column of a batch that the scan promised.
pub(crate) fn column<'a>(batch: &'a RecordBatch, name: &str) -> Result<&'a ArrayRef> {
    batch
        .column_by_name(name)
        .ok_or_else(|| DatasetError::MissingColumn {
            role: "dataset",
            name: format!("\"{name}\""),
            found: schema::column_names(&batch.schema()),
        })
}

fn flag(array: Option<&ArrayRef>, row: usize) -> Option<bool> {
    let array = array?.as_boolean();
    (!array.is_null(row)).then(|| array.value(row))
}

/// A success column as booleans: `value != 0`; `None` if it is no scalar column.
pub(crate) fn as_flags(array: &ArrayRef) -> Result<Option<ArrayRef>> {
    let flat = match array.data_type() {
        DataType::FixedSizeList(_, 1) => {
            let list = array.as_fixed_size_list();
            list.values().slice(
                usize::try_from(list.value_offset(0)).unwrap_or(0),
                list.len(),
            )
        }
        data_type if schema::is_number(data_type) || *data_type == DataType::Boolean => {
            array.clone()
        }
        _ => return Ok(None),
    };
    arrow::compute::cast(&flat, &DataType::Boolean)
        .map(Some)
        .map_err(DatasetError::arrow("read success as a flag"))
}
