//! Reading Parquet files in batches.

use std::collections::HashSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{
    ArrayRef, BooleanArray, Int64Array, RecordBatch, RecordBatchOptions, RecordBatchReader,
};
use arrow::datatypes::{DataType, Field, FieldRef, Schema, SchemaRef};
use arrow::error::ArrowError;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder,
};
use parquet::file::metadata::RowGroupMetaData;
use parquet::file::statistics::Statistics;
use serde_json::{Map, Value};

use super::ahead::{Ahead, Selection};
use super::columns::{ColumnNames, ColumnPlan, Conversion, FilePlan, Role};
use super::rows::{
    EpisodeNames, EpisodeTracker, as_index, check_action, convert, first_width, with_width,
};
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::guard;
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan};
use crate::spec::LeafSpec;

/// Opens a Parquet file.
///
/// # Errors
/// Not a Parquet file, missing columns, or columns of types that cannot serve.
pub(crate) fn open(path: &Path, names: &ColumnNames) -> Result<Box<dyn DatasetSource>> {
    let file = File::open(path).map_err(|e| DatasetError::io("open", e))?;
    let metadata = guard::decode(|| {
        ArrowReaderMetadata::load(&file, ArrowReaderOptions::new())
            .map_err(DatasetError::parquet("read the Parquet footer"))
    })?;
    let mut plan = FilePlan::new(metadata.schema(), names)?;
    let lists: Vec<usize> = plan
        .columns
        .iter()
        .filter(|c| c.conversion == Conversion::List)
        .map(|c| c.source)
        .collect();
    if !lists.is_empty() {
        let widths = first_widths(file, &metadata, &lists)?;
        for column in &mut plan.columns {
            if let Some((_, width)) = widths.iter().find(|(source, _)| *source == column.source)
                && column.conversion == Conversion::List
            {
                *column = with_width(column, *width)?;
            }
        }
    }
    let schema = canonical_schema(&plan.columns, metadata.schema(), path);
    let info = describe(path, &metadata, &schema, plan);
    Ok(Box::new(ParquetSource {
        path: path.to_owned(),
        metadata,
        schema,
        plan: info.1,
        info: info.0,
    }))
}

/// Widths of list columns, from the first row that is not null among the first few.
fn first_widths(
    file: File,
    metadata: &ArrowReaderMetadata,
    lists: &[usize],
) -> Result<Vec<(usize, usize)>> {
    const ROWS_TRIED: usize = 64;
    let mask = ProjectionMask::roots(metadata.parquet_schema(), lists.iter().copied());
    let mut reader = ParquetRecordBatchReaderBuilder::new_with_metadata(file, metadata.clone())
        .with_projection(mask)
        .with_batch_size(ROWS_TRIED)
        .with_limit(ROWS_TRIED)
        .build()
        .map_err(DatasetError::parquet("read the first rows"))?;
    let batch = guard::decode(|| {
        reader
            .next()
            .ok_or(DatasetError::Empty)?
            .map_err(DatasetError::arrow("read the first rows"))
    })?;
    let mut widths = Vec::new();
    for &source in lists {
        let name = metadata.schema().field(source).name();
        let array = batch.column_by_name(name).ok_or(DatasetError::Empty)?;
        widths.push((source, first_width(array).ok_or(DatasetError::Empty)?));
    }
    Ok(widths)
}

/// Index columns first, made up where the file has none.
fn canonical_schema(columns: &[ColumnPlan], file: &Schema, path: &Path) -> SchemaRef {
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
    metadata
        .entry(schema::SOURCE_ID.to_owned())
        .or_insert_with(|| {
            path.file_stem()
                .map(|stem| stem.to_string_lossy().into_owned())
                .unwrap_or_default()
        });
    metadata
        .entry(schema::VERSION_KEY.to_owned())
        .or_insert_with(|| schema::VERSION.to_owned());
    metadata
        .entry(schema::SOURCE_FORMAT.to_owned())
        .or_insert_with(|| Format::Parquet.name().to_owned());
    Arc::new(Schema::new_with_metadata(fields, metadata))
}

fn describe(
    path: &Path,
    metadata: &ArrowReaderMetadata,
    schema: &SchemaRef,
    plan: FilePlan,
) -> (DatasetInfo, Vec<ColumnPlan>) {
    let text = |key: &str| metadata.schema().metadata().get(key);
    let json = |key: &str| text(key).and_then(|text| serde_json::from_str::<Value>(text).ok());
    let id = schema
        .metadata()
        .get(schema::SOURCE_ID)
        .cloned()
        .unwrap_or_default();
    let mut info = DatasetInfo::new(id, Format::Parquet, path.to_owned());
    info.n_steps = steps_without_final_rows(metadata, &plan.columns);
    let leaves = |role: Role| -> Vec<LeafSpec> {
        plan.columns
            .iter()
            .filter(|c| c.role == role)
            .filter_map(|c| LeafSpec::of_field(&c.field))
            .collect()
    };
    info.observation = leaves(Role::Observation);
    info.action = leaves(Role::Action);
    let episode = plan
        .columns
        .iter()
        .find(|column| column.role == Role::Episode);
    info.episode_rule = match episode {
        Some(column) => format!(
            "by column `{}`",
            metadata.schema().field(column.source).name()
        ),
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
    info.warnings = plan.warnings;
    (info, plan.columns)
}

/// The rows of the file, if its statistics say that no action is null.
fn steps_without_final_rows(metadata: &ArrowReaderMetadata, columns: &[ColumnPlan]) -> Option<u64> {
    let action = columns.iter().find(|column| column.role == Role::Action)?;
    let leaf = (0..metadata.parquet_schema().num_columns())
        .find(|&leaf| metadata.parquet_schema().get_column_root_idx(leaf) == action.source)?;
    let mut n_rows = 0;
    for group in metadata.metadata().row_groups() {
        if group.column(leaf).statistics()?.null_count_opt()? != 0 {
            return None;
        }
        n_rows += u64::try_from(group.num_rows()).ok()?;
    }
    Some(n_rows)
}

struct ParquetSource {
    path: PathBuf,
    metadata: ArrowReaderMetadata,
    schema: SchemaRef,
    plan: Vec<ColumnPlan>,
    info: DatasetInfo,
}

impl DatasetSource for ParquetSource {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        self.reader(scan)
            .map(|reader| Box::new(reader) as _)
            .map_err(|error| error.in_file(&self.path))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        (self as &dyn DatasetSource).derived_episodes()
    }
}

impl ParquetSource {
    fn reader(&self, scan: &Scan) -> Result<ParquetScan<'_>> {
        let (schema, chosen) = schema::project(&self.schema, scan.columns.as_deref())?;
        let chosen: Vec<&str> = chosen
            .iter()
            .map(|&i| self.schema.field(i).name().as_str())
            .collect();
        // Episode and step are always read: they are what the rows are checked by.
        let is_read = |column: &&ColumnPlan| {
            matches!(column.role, Role::Episode | Role::Step)
                || chosen.contains(&column.field.name().as_str())
        };
        let columns: Vec<&ColumnPlan> = self.plan.iter().filter(is_read).collect();
        let roots = columns.iter().map(|column| column.source);
        let selection = Selection {
            path: self.path.clone(),
            metadata: self.metadata.clone(),
            mask: ProjectionMask::roots(self.metadata.parquet_schema(), roots),
            batch_rows: scan.batch_rows.max(1),
        };
        let groups = self.groups_of(scan.episodes.as_deref());
        Ok(ParquetScan {
            source: self,
            reader: Ahead::start(&selection, &groups),
            schema,
            columns,
            episodes: (scan.episodes.as_ref()).map(|wanted| wanted.iter().copied().collect()),
            tracker: EpisodeTracker::default(),
            names: EpisodeNames::default(),
            null_action: None,
            failed: false,
        })
    }

    /// The row groups that may hold rows of some episodes, by the statistics of the episode column.
    fn groups_of(&self, episodes: Option<&[i64]>) -> Vec<usize> {
        let groups = self.metadata.metadata().row_groups();
        let mut is_number = |column: &&ColumnPlan| {
            column.role == Role::Episode && column.conversion != Conversion::Name
        };
        let leaf = self.plan.iter().find(&mut is_number).and_then(|column| {
            let descriptor = self.metadata.parquet_schema();
            (0..descriptor.num_columns())
                .find(|&leaf| descriptor.get_column_root_idx(leaf) == column.source)
        });
        let may_hold = |group: &RowGroupMetaData| {
            let (Some(wanted), Some(leaf)) = (episodes, leaf) else {
                return true;
            };
            let Some(Statistics::Int64(statistics)) = group.column(leaf).statistics() else {
                return true;
            };
            match (statistics.min_opt(), statistics.max_opt()) {
                (Some(min), Some(max)) => wanted.iter().any(|e| (min..=max).contains(&e)),
                _ => true,
            }
        };
        (0..groups.len())
            .filter(|&group| may_hold(&groups[group]))
            .collect()
    }
}

struct ParquetScan<'a> {
    source: &'a ParquetSource,
    reader: Ahead,
    schema: SchemaRef,
    columns: Vec<&'a ColumnPlan>,
    episodes: Option<HashSet<i64>>,
    tracker: EpisodeTracker,
    names: EpisodeNames,
    null_action: Option<(i64, u64)>,
    failed: bool,
}

impl ParquetScan<'_> {
    fn convert(&mut self, batch: &RecordBatch) -> Result<RecordBatch> {
        let first_row = self.tracker.first_row;
        let mut converted: Vec<(&ColumnPlan, ArrayRef)> = Vec::new();
        for column in &self.columns {
            let name = self.source.metadata.schema().field(column.source).name();
            let array = batch
                .column_by_name(name)
                .ok_or_else(|| DatasetError::corrupt("a column vanished"))?;
            let array = match column.conversion {
                Conversion::Name => self.names.numbers(name, array, first_row)?,
                _ => convert(column, name, array, first_row)?,
            };
            converted.push((column, array));
        }
        let find = |role: Role| converted.iter().find(|(column, _)| column.role == role);
        let index = |role: Role| {
            find(role).map(|(column, array)| {
                (
                    self.source
                        .metadata
                        .schema()
                        .field(column.source)
                        .name()
                        .as_str(),
                    as_index(array),
                )
            })
        };
        let (episodes, steps) =
            self.tracker
                .rows(batch.num_rows(), index(Role::Episode), index(Role::Step))?;
        if let Some((column, array)) = find(Role::Action) {
            let name = self.source.metadata.schema().field(column.source).name();
            check_action(name, array, &episodes, &mut self.null_action, first_row)?;
        }
        self.assemble(&converted, &episodes, &steps)
    }

    fn assemble(
        &self,
        converted: &[(&ColumnPlan, ArrayRef)],
        episodes: &Int64Array,
        steps: &Int64Array,
    ) -> Result<RecordBatch> {
        let mut arrays: Vec<ArrayRef> = Vec::new();
        for field in self.schema.fields() {
            arrays.push(match field.name().as_str() {
                schema::EPISODE_INDEX => Arc::new(episodes.clone()),
                schema::STEP_INDEX => Arc::new(steps.clone()),
                name => converted
                    .iter()
                    .find(|(column, _)| column.field.name() == name)
                    .map(|(_, array)| array.clone())
                    .ok_or_else(|| DatasetError::corrupt("a column vanished"))?,
            });
        }
        let options = RecordBatchOptions::new().with_row_count(Some(episodes.len()));
        let batch = RecordBatch::try_new_with_options(Arc::clone(&self.schema), arrays, &options)
            .map_err(DatasetError::arrow("build a batch"))?;
        match &self.episodes {
            None => Ok(batch),
            Some(wanted) => {
                let keep: BooleanArray = episodes
                    .values()
                    .iter()
                    .map(|episode| Some(wanted.contains(episode)))
                    .collect();
                arrow::compute::filter_record_batch(&batch, &keep)
                    .map_err(DatasetError::arrow("choose episodes"))
            }
        }
    }
}

impl Iterator for ParquetScan<'_> {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.failed {
            let converted = self.reader.next()?.and_then(|(first_row, batch)| {
                // Row groups without a wanted episode were passed over.
                self.tracker.first_row = first_row;
                self.convert(&batch)
            });
            match converted {
                Ok(batch) if batch.num_rows() == 0 && self.episodes.is_some() => {}
                Ok(batch) => return Some(Ok(batch)),
                Err(error) => {
                    self.failed = true;
                    return Some(Err(error.in_file(&self.source.path).into()));
                }
            }
        }
        None
    }
}

impl RecordBatchReader for ParquetScan<'_> {
    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }
}
