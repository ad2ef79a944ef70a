//! `meta/episodes`: where each episode is, what is recorded about it, its statistics.

use std::collections::HashMap;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{
    ArrayRef, BooleanArray, Float64Array, Int64Array, ListBuilder, RecordBatch, StringArray,
    StringBuilder, UInt64Array,
};
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use parquet::arrow::ArrowWriter;
use serde_json::Value;

use super::super::attributes::{self, SEED, TASKS};
use super::arrays::nest;
use super::files;
use super::plan::{Feature, loss, nested_type};
use super::stats::{NAMES, StatsRow};
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::sink::{Loss, LossEffect};

/// Rows that are gathered before they are written.
const ROWS: usize = 256;
/// Columns that are always there, and so cannot be an attribute's.
const PLACES: [&str; 8] = [
    schema::EPISODE_INDEX,
    "length",
    "data/chunk_index",
    "data/file_index",
    "dataset_from_index",
    "dataset_to_index",
    "meta/episodes/chunk_index",
    "meta/episodes/file_index",
];
/// Number of the episode in the source, where it is another.
const SOURCE_INDEX: &str = "source_episode_index";

/// One row.
pub(super) struct EpisodeRow {
    /// Values of [`PLACES`].
    pub(super) places: [i64; 8],
    pub(super) tasks: Vec<String>,
    /// Number in the source.
    pub(super) source_index: i64,
    /// Statistics of the features that have them.
    pub(super) stats: Vec<StatsRow>,
}

/// The table while it is written.
pub(super) struct EpisodeTable {
    writer: ArrowWriter<File>,
    schema: SchemaRef,
    rows: Vec<EpisodeRow>,
    extras: Extras,
    /// Shapes of the features that have statistics.
    shapes: Vec<Vec<usize>>,
}

/// What the source records about its episodes.
struct Extras {
    seeds: bool,
    renumbered: bool,
    attributes: Vec<Attribute>,
    records: HashMap<i64, EpisodeRecord>,
}

/// A column of attributes.
struct Attribute {
    key: String,
    field: Field,
}

impl EpisodeTable {
    /// Starts the table; `features` are those with statistics.
    ///
    /// # Errors
    /// The file cannot be made.
    pub(super) fn create(
        path: &Path,
        features: &[&Feature],
        episodes: &[EpisodeRecord],
        losses: &mut Vec<Loss>,
    ) -> Result<Self> {
        let extras = Extras::new(episodes, losses);
        let integer = |name: &str| Field::new(name, DataType::Int64, true);
        let (places, own) = PLACES.split_at(6);
        let mut fields: Vec<Field> = places.iter().map(|name| integer(name)).collect();
        fields.insert(1, Field::new(TASKS, nested_type(&DataType::Utf8, 1), true));
        if extras.seeds {
            fields.push(Field::new(SEED, DataType::UInt64, true));
        }
        if extras.renumbered {
            fields.push(integer(SOURCE_INDEX));
        }
        fields.extend(extras.attributes.iter().map(|a| a.field.clone()));
        for feature in features {
            let column = |stat: &str| format!("stats/{}/{stat}", feature.name);
            let depth = feature.shape.len();
            let list =
                |stat| Field::new(column(stat), nested_type(&DataType::Float64, depth), true);
            fields.extend(NAMES.map(list));
            let count = nested_type(&DataType::Int64, 1);
            fields.push(Field::new(column("count"), count, true));
        }
        fields.extend(own.iter().map(|name| integer(name)));
        let schema = Arc::new(Schema::new(fields));
        Ok(Self {
            writer: files::start(path, &schema)?,
            schema,
            rows: Vec::new(),
            extras,
            shapes: features
                .iter()
                .map(|feature| feature.shape.clone())
                .collect(),
        })
    }

    /// Adds a row.
    ///
    /// # Errors
    /// A failed write.
    pub(super) fn add(&mut self, row: EpisodeRow) -> Result<()> {
        self.rows.push(row);
        match self.rows.len() >= ROWS {
            true => self.write_rows(),
            false => Ok(()),
        }
    }

    /// Writes what is left and closes the file.
    ///
    /// # Errors
    /// A failed write.
    pub(super) fn finish(mut self) -> Result<()> {
        self.write_rows()?;
        files::finish(self.writer)
    }

    fn write_rows(&mut self) -> Result<()> {
        let rows = std::mem::take(&mut self.rows);
        if rows.is_empty() {
            return Ok(());
        }
        let mut columns = Vec::with_capacity(self.schema.fields().len());
        let integers = |place: usize| -> ArrayRef {
            let values = rows.iter().map(|row| row.places[place]);
            Arc::new(Int64Array::from_iter_values(values))
        };
        columns.extend((0..6).map(integers));
        columns.insert(1, tasks(&rows));
        self.extras.columns(&rows, &mut columns)?;
        for (place, shape) in self.shapes.iter().enumerate() {
            let stats = || rows.iter().filter_map(|row| row.stats.get(place));
            for name in 0..NAMES.len() {
                let values = stats().flat_map(|row| row.values[name].iter().copied());
                let values: ArrayRef = Arc::new(Float64Array::from_iter_values(values));
                columns.push(nest(&values, shape)?);
            }
            let counts = Int64Array::from_iter_values(stats().map(|row| row.count));
            columns.push(nest(&(Arc::new(counts) as ArrayRef), &[1])?);
        }
        columns.extend((6..8).map(integers));
        let batch = RecordBatch::try_new(Arc::clone(&self.schema), columns)
            .map_err(DatasetError::arrow("build a batch"))?;
        files::write(&mut self.writer, &batch)
    }
}

fn tasks(rows: &[EpisodeRow]) -> ArrayRef {
    let element = schema::element(DataType::Utf8);
    let mut lists = ListBuilder::new(StringBuilder::new()).with_field(element);
    for row in rows {
        for task in &row.tasks {
            lists.values().append_value(task);
        }
        lists.append(true);
    }
    Arc::new(lists.finish())
}

impl Extras {
    fn new(episodes: &[EpisodeRecord], losses: &mut Vec<Loss>) -> Self {
        let mut keys: Vec<&String> = Vec::new();
        for episode in episodes {
            let known = |key: &&String| {
                let is_seed = *key == SEED && episode.seed.is_some();
                !is_seed && *key != TASKS && !keys.contains(key)
            };
            let new: Vec<&String> = episode.attributes.keys().filter(known).collect();
            keys.extend(new);
        }
        let attributes: Vec<Attribute> = keys
            .into_iter()
            .map(|key| Attribute::new(key, episodes, losses))
            .collect();
        let numbers = episodes.iter().map(|episode| episode.episode_index);
        let renumbered = numbers.zip(0..).any(|(number, place)| number != place);
        if renumbered {
            let detail = format!(
                "episodes are numbered from 0; `{SOURCE_INDEX}` of meta/episodes has their own numbers"
            );
            losses.push(loss("episode numbers", LossEffect::Changed, detail));
        }
        let seeds = episodes.iter().any(|episode| episode.seed.is_some());
        let records = match seeds || !attributes.is_empty() {
            true => episodes
                .iter()
                .map(|e| (e.episode_index, e.clone()))
                .collect(),
            false => HashMap::new(),
        };
        Self {
            seeds,
            renumbered,
            attributes,
            records,
        }
    }

    fn columns(&self, rows: &[EpisodeRow], columns: &mut Vec<ArrayRef>) -> Result<()> {
        let record = |row: &EpisodeRow| self.records.get(&row.source_index);
        if self.seeds {
            let seeds = rows.iter().map(|row| record(row)?.seed);
            columns.push(Arc::new(seeds.collect::<UInt64Array>()));
        }
        if self.renumbered {
            let numbers = rows.iter().map(|row| row.source_index);
            columns.push(Arc::new(Int64Array::from_iter_values(numbers)));
        }
        for attribute in &self.attributes {
            let values: Vec<Option<&Value>> = rows
                .iter()
                .map(|row| record(row)?.attributes.get(&attribute.key))
                .collect();
            columns.push(attribute.array(&values));
        }
        Ok(())
    }
}

impl Attribute {
    fn new(key: &str, episodes: &[EpisodeRecord], losses: &mut Vec<Loss>) -> Self {
        let is_reserved = !attributes::is_attribute(key) || [SEED, SOURCE_INDEX].contains(&key);
        let name = match is_reserved {
            true => {
                let detail = format!("LeRobot has a column of that name: it is `attribute.{key}`");
                losses.push(loss(key, LossEffect::Changed, detail));
                format!("attribute.{key}")
            }
            false => key.to_owned(),
        };
        let values = || {
            let values = episodes
                .iter()
                .filter_map(|episode| episode.attributes.get(key));
            values.filter(|value| !value.is_null())
        };
        let all = |is: fn(&Value) -> bool| values().all(is);
        let field = |data_type| Field::new(&name, data_type, true);
        let field = if all(Value::is_boolean) {
            field(DataType::Boolean)
        } else if all(Value::is_i64) {
            field(DataType::Int64)
        } else if all(Value::is_u64) {
            field(DataType::UInt64)
        } else if all(Value::is_f64) {
            field(DataType::Float64)
        } else if all(Value::is_string) {
            field(DataType::Utf8)
        } else {
            attributes::json_field(&name)
        };
        Self {
            key: key.to_owned(),
            field,
        }
    }

    fn array(&self, values: &[Option<&Value>]) -> ArrayRef {
        let values = values
            .iter()
            .map(|value| value.filter(|value| !value.is_null()));
        match self.field.data_type() {
            DataType::Boolean => Arc::new(values.map(|v| v?.as_bool()).collect::<BooleanArray>()),
            DataType::Int64 => Arc::new(values.map(|v| v?.as_i64()).collect::<Int64Array>()),
            DataType::UInt64 => Arc::new(values.map(|v| v?.as_u64()).collect::<UInt64Array>()),
            DataType::Float64 => Arc::new(values.map(|v| v?.as_f64()).collect::<Float64Array>()),
            _ if self.field.metadata().is_empty() => {
                Arc::new(values.map(|v| v?.as_str()).collect::<StringArray>())
            }
            _ => Arc::new(
                values
                    .map(|v| Some(v?.to_string()))
                    .collect::<StringArray>(),
            ),
        }
    }
}
