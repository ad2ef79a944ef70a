//! How recordings describe themselves as a dataset: fields, schema metadata, info.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Schema};
use serde_json::{Map, Value, json};

use super::Metadata;
use super::align::Pace;
use super::bind::Layout;
use super::mapping::{Column, EpisodeRule, From, Grid, Mapping, Missing, OnMiss, Role};
use crate::format::Format;
use crate::schema;
use crate::source::{DatasetInfo, Warning};
use crate::spec::LeafSpec;

/// Metadata record of recordings that bring their mapping along.
pub(crate) const MAPPING_RECORD: &str = "ksim.mapping";
/// Its entry.
pub(crate) const MAPPING_ENTRY: &str = "toml";
/// Metadata record with the schema metadata of a written table.
pub(crate) const SCHEMA_RECORD: &str = "ksim.schema";
/// Field metadata: encoding of raw pixels in the recording.
const PIXEL_ENCODING: &str = "source.encoding";

/// The field of a column.
pub(crate) fn field(column: &Column, layout: &Layout, mapping: &Mapping) -> Field {
    let codec = layout.picture.as_ref().and_then(|picture| picture.codec);
    let field = match (&layout.value_type, codec) {
        (_, Some(codec)) => schema::image_field(&column.name, codec, &layout.shape),
        (DataType::Utf8 | DataType::Binary, None) => {
            Field::new(&column.name, layout.value_type.clone(), true)
        }
        (value_type, None) => {
            schema::leaf_field(&column.name, value_type.clone(), &layout.shape, true)
        }
    };
    let field = match layout.value_type {
        DataType::Utf8 | DataType::Binary => field,
        _ => field.with_nullable(is_nullable(column, mapping)),
    };
    let mut metadata = field.metadata().clone();
    let base = match column.from {
        From::NextOf(base) => mapping.columns.get(base).unwrap_or(column),
        From::Topic(_) => column,
    };
    let mut add = |key: &str, value: Option<String>| {
        if let Some(value) = value {
            metadata.insert(key.to_owned(), value);
        }
    };
    add(
        schema::NAMES,
        layout.names.as_ref().map(|names| json!(names).to_string()),
    );
    add(
        schema::UNIT,
        column.unit.clone().or_else(|| base.unit.clone()),
    );
    let kind = column
        .kind
        .or(base.kind)
        .and_then(super::mapping::Kind::name);
    add(schema::KIND, kind.map(str::to_owned));
    let encoding = layout
        .picture
        .as_ref()
        .and_then(|picture| picture.encoding.clone());
    add(PIXEL_ENCODING, encoding);
    metadata.extend(column.metadata.clone());
    field.with_metadata(metadata)
}

/// Whether rows of a column may be null: all but observations that every step has.
fn is_nullable(column: &Column, mapping: &Mapping) -> bool {
    let may_lack = match &column.from {
        From::Topic(fields) => fields.missing == Missing::Null,
        From::NextOf(_) => true,
    };
    let may_miss = column.on_miss == OnMiss::Null && !matches!(mapping.grid, Grid::Index(_));
    column.role != Role::Observation || may_lack || may_miss
}

/// The metadata of the table.
pub(crate) fn schema_metadata(
    path: &Path,
    mapping: &Mapping,
    library: &str,
    embedded: &[Metadata],
    files: Value,
) -> HashMap<String, String> {
    if matches!(mapping.grid, Grid::Index(_)) {
        let record = embedded.iter().find(|record| record.name == SCHEMA_RECORD);
        if let Some(record) = record {
            return record.entries.clone().into_iter().collect();
        }
    }
    let mut metadata = HashMap::from([
        (schema::SOURCE_ID.to_owned(), id(path)),
        (schema::VERSION_KEY.to_owned(), schema::VERSION.to_owned()),
        (
            schema::SOURCE_FORMAT.to_owned(),
            Format::Mcap.name().to_owned(),
        ),
        (schema::SOURCE_VERSION.to_owned(), library.to_owned()),
        (schema::SOURCE_METADATA.to_owned(), files.to_string()),
        (schema::CLOCK.to_owned(), mapping.clock.name().to_owned()),
        (schema::ALIGN.to_owned(), mapping.text.clone()),
    ]);
    if let Grid::Pace(pace) = &mapping.grid {
        metadata.insert(schema::FPS.to_owned(), fps(*pace));
    }
    metadata
}

/// The name of the file or folder, without its ending.
fn id(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or(path.as_os_str());
    stem.to_string_lossy().into_owned()
}

fn fps(pace: Pace) -> String {
    pace.rate_hz().to_string()
}

/// The description of the dataset.
pub(crate) fn info(
    path: &Path,
    mapping: &Mapping,
    table: &Arc<Schema>,
    (n_episodes, n_steps): (u64, u64),
    warnings: Vec<Warning>,
) -> DatasetInfo {
    let recorded = table.metadata().get(schema::SOURCE_ID).cloned();
    let id = recorded.unwrap_or_else(|| id(path));
    let mut info = DatasetInfo::new(id, Format::Mcap, path.to_owned());
    let leaves = |root: &str| -> Vec<LeafSpec> {
        let fields = table.fields().iter();
        let inside = fields.filter(|field| schema::belongs_to(field.name(), root));
        inside
            .filter_map(|field| LeafSpec::of_field(field))
            .collect()
    };
    info.observation = leaves(schema::OBSERVATION);
    info.action = leaves(schema::ACTION);
    info.n_episodes = Some(n_episodes);
    info.n_steps = Some(n_steps);
    (info.episode_rule, info.boundaries_inferred) = match &mapping.episodes {
        EpisodeRule::File => ("a file is an episode".to_owned(), false),
        EpisodeRule::Index => ("by the recorded numbers".to_owned(), false),
        EpisodeRule::Gap { topic, gap_ns } => {
            let seconds = *gap_ns as f64 / 1e9;
            (format!("by silences of \"{topic}\" over {seconds} s"), true)
        }
        EpisodeRule::Marker(marker) => (format!("by the messages of \"{}\"", marker.topic), false),
    };
    info.metadata = metadata_map(table);
    info.warnings = warnings;
    info
}

fn metadata_map(table: &Schema) -> Map<String, Value> {
    let text = table.metadata().get(schema::SOURCE_METADATA);
    let value = text.and_then(|text| serde_json::from_str(text).ok());
    match value {
        Some(Value::Object(map)) => map,
        Some(other) => Map::from_iter([("files".to_owned(), other)]),
        None => Map::new(),
    }
}
