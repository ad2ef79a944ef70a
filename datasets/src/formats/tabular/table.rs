//! What a file of columns is in the canonical layout.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::RecordBatch;
use arrow::datatypes::{DataType, Field, FieldRef, Schema, SchemaRef};
use serde_json::{Map, Value};

use super::columns::{ColumnPlan, Conversion, FilePlan, Role};
use super::names::ColumnNames;
use super::rows::{first_width, with_width};
use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::schema;
use crate::source::DatasetInfo;
use crate::spec::LeafSpec;

/// How many rows are looked at for the width of a list column.
pub(crate) const FIRST_ROWS: usize = 64;

/// A file's columns and what becomes of them.
pub(crate) struct Table {
    pub(super) path: PathBuf,
    /// The columns as the file has them.
    pub(super) file: SchemaRef,
    pub(super) columns: Vec<ColumnPlan>,
    pub(crate) schema: SchemaRef,
    pub(crate) info: DatasetInfo,
}

impl Table {
    /// Plans a file. `first_rows` reads the first [`FIRST_ROWS`] rows of the columns at some places.
    ///
    /// # Errors
    /// Missing columns, columns of types that cannot serve, and those of `first_rows`.
    pub(crate) fn new(
        path: &Path,
        format: Format,
        file: &SchemaRef,
        names: &ColumnNames,
        first_rows: impl FnOnce(&[usize]) -> Result<RecordBatch>,
    ) -> Result<Self> {
        let mut plan = FilePlan::new(file, names)?;
        let is_list = |column: &ColumnPlan| column.conversion == Conversion::List;
        let lists: Vec<usize> = plan
            .columns
            .iter()
            .filter(|c| is_list(c))
            .map(|c| c.source)
            .collect();
        if !lists.is_empty() {
            let rows = first_rows(&lists)?;
            for column in plan.columns.iter_mut().filter(|column| is_list(column)) {
                let array = rows.column_by_name(file.field(column.source).name());
                let width = array.and_then(first_width).ok_or(DatasetError::Empty)?;
                *column = with_width(column, width)?;
            }
        }
        let schema = canonical_schema(&plan.columns, file, path, format);
        let mut info = describe(path, format, &schema, &plan.columns, file);
        info.warnings = plan.warnings;
        Ok(Self {
            path: path.to_owned(),
            file: Arc::clone(file),
            columns: plan.columns,
            schema,
            info,
        })
    }

    /// Place in the file of the first action column.
    pub(crate) fn action_source(&self) -> Option<usize> {
        let action = self
            .columns
            .iter()
            .find(|column| column.role == Role::Action)?;
        Some(action.source)
    }

    /// Place in the file of the episode column, if it holds numbers.
    pub(crate) fn episode_source(&self) -> Option<usize> {
        let is_number = |column: &&ColumnPlan| {
            column.role == Role::Episode && column.conversion != Conversion::Name
        };
        Some(self.columns.iter().find(is_number)?.source)
    }

    /// The file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }
}

/// Index columns first, made up where the file has none.
fn canonical_schema(
    columns: &[ColumnPlan],
    file: &Schema,
    path: &Path,
    format: Format,
) -> SchemaRef {
    let mut fields: Vec<FieldRef> = vec![
        Arc::new(Field::new(schema::EPISODE_INDEX, DataType::Int64, false)),
        Arc::new(Field::new(schema::STEP_INDEX, DataType::Int64, false)),
    ];
    let rest = columns
        .iter()
        .filter(|column| !matches!(column.role, Role::Episode | Role::Step));
    fields.extend(rest.map(|column| Arc::clone(&column.field)));
    let mut metadata = file.metadata().clone();
    // A copy of the file then still says what it was made from.
    let mut default = |key: &str, value: String| {
        metadata.entry(key.to_owned()).or_insert(value);
    };
    let stem = path.file_stem().unwrap_or_default();
    default(schema::SOURCE_ID, stem.to_string_lossy().into_owned());
    default(schema::VERSION_KEY, schema::VERSION.to_owned());
    default(schema::SOURCE_FORMAT, format.name().to_owned());
    Arc::new(Schema::new_with_metadata(fields, metadata))
}

fn describe(
    path: &Path,
    format: Format,
    schema: &SchemaRef,
    columns: &[ColumnPlan],
    file: &Schema,
) -> DatasetInfo {
    let json = |key: &str| {
        let text = file.metadata().get(key)?;
        serde_json::from_str::<Value>(text).ok()
    };
    let id = schema.metadata().get(schema::SOURCE_ID);
    let mut info = DatasetInfo::new(id.cloned().unwrap_or_default(), format, path.to_owned());
    let leaves = |role: Role| -> Vec<LeafSpec> {
        let columns = columns.iter().filter(|column| column.role == role);
        columns
            .filter_map(|column| LeafSpec::of_field(&column.field))
            .collect()
    };
    info.observation = leaves(Role::Observation);
    info.action = leaves(Role::Action);
    let episode = columns.iter().find(|column| column.role == Role::Episode);
    info.episode_rule = match episode {
        Some(column) => format!("by column `{}`", file.field(column.source).name()),
        None => "the whole file is one episode".to_owned(),
    };
    info.boundaries_inferred = episode.is_none();
    info.env_spec = json(schema::ENV_SPEC);
    info.metadata = match json(schema::SOURCE_METADATA) {
        Some(Value::Object(map)) => map,
        _ => Map::new(),
    };
    info.ref_min_score = info.metadata.get("ref_min_score").and_then(Value::as_f64);
    info.ref_max_score = info.metadata.get("ref_max_score").and_then(Value::as_f64);
    info
}
