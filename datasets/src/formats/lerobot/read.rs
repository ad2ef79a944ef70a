//! Reading a dataset folder in batches.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{Array, RecordBatchReader};
use arrow::datatypes::{DataType, Field, FieldRef, Schema, SchemaRef};
use serde_json::Value;

use super::attributes::SEED;
use super::columns::{Column, Columns};
use super::episodes::{self, Episodes, Place};
use super::files::ParquetFile;
use super::info::{Info, Layout};
use super::recover;
use super::root::Root;
use super::rows::picture_bytes;
use super::scan::LeRobotScan;
use super::tasks::Tasks;
use crate::episode::{EpisodeEnd, EpisodeRecord, action_column};
use crate::error::{DatasetError, Result};
use crate::format::{Format, OpenOptions};
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan, Warning};
use crate::spec::LeafSpec;

/// A dataset folder, open. Memory: 40 bytes an episode, the tasks, and in a scan one batch of about 64 MiB at
/// most (one row, if that is larger).
pub(super) struct LeRobotSource {
    pub(super) root: Root,
    info: DatasetInfo,
    schema: SchemaRef,
    columns: Vec<Column>,
    pub(super) episodes: Episodes,
    pub(super) tasks: Tasks,
    pub(super) declared: Info,
}

impl LeRobotSource {
    /// Opens a folder: reads what is in `meta`, and the footer of the first data file.
    ///
    /// # Errors
    /// Whatever of that is missing or damaged, or a data file that is not there; it is named.
    pub(super) fn open(path: &Path, options: &OpenOptions) -> Result<Self> {
        let root = Root::new(path)?;
        let mut declared = Info::read(&root, options.force)?;
        let mut warnings = std::mem::take(&mut declared.warnings);
        let mut episodes = Episodes::read(&root, &declared)?;
        let mut counts = check_counts(&root, &declared, &episodes, options.recover)?;
        warnings.append(&mut counts);
        let tasks = match episodes.places.is_empty() && !root.has(Tasks::path(declared.layout)) {
            true => Tasks::default(),
            false => Tasks::read(&root, declared.layout)?,
        };
        if options.recover {
            recover::drop_unopenable(&root, &mut episodes, &mut warnings)?;
        } else {
            for file in &episodes.files {
                root.check(&file.path)?;
            }
        }
        let mut columns = plan_columns(&root, &declared, &episodes)?;
        warnings.append(&mut columns.warnings);
        let mut source = Self {
            info: DatasetInfo::new(folder_name(path), Format::LeRobot, path.to_owned()),
            schema: table_schema(&columns.columns, &declared, path),
            root,
            columns: columns.columns,
            episodes,
            tasks,
            declared,
        };
        if options.recover {
            recover::drop_damaged(&mut source, &mut warnings);
        }
        source.describe(warnings);
        Ok(source)
    }

    fn describe(&mut self, warnings: Vec<Warning>) {
        let leaves = |root: &str| {
            let fields = self.columns.iter().map(|column| &column.field);
            let leaves = fields.filter(|field| schema::belongs_to(field.name(), root));
            leaves
                .filter_map(|field| LeafSpec::of_field(field))
                .collect()
        };
        self.info.observation = leaves(schema::OBSERVATION);
        self.info.action = leaves(schema::ACTION);
        self.info.n_episodes = Some(self.episodes.places.len() as u64);
        self.info.n_steps = Some(self.episodes.n_steps());
        self.info.episode_rule = match self.declared.layout {
            Layout::V2 => "as recorded in meta/episodes.jsonl".to_owned(),
            Layout::V3 => "as recorded in meta/episodes".to_owned(),
        };
        self.info.metadata = self.declared.fields.clone();
        self.info.warnings = warnings;
    }

    pub(super) fn all_episodes(&mut self) -> &mut Episodes {
        &mut self.episodes
    }

    /// A pass over these episodes, which are in order.
    pub(super) fn pass(
        &self,
        places: impl Iterator<Item = Place>,
        columns: Option<&[String]>,
        batch_rows: usize,
    ) -> Result<LeRobotScan<'_>> {
        let (schema, _) = schema::project(&self.schema, columns)?;
        let is_wanted = |column: &&Column| schema.index_of(column.field.name()).is_ok();
        let columns: Vec<&Column> = self.columns.iter().filter(is_wanted).collect();
        let mut jobs: VecDeque<Vec<Place>> = VecDeque::new();
        for place in places {
            match jobs.back_mut() {
                Some(job) if job[0].file == place.file => job.push(place),
                _ => jobs.push_back(vec![place]),
            }
        }
        Ok(LeRobotScan::new(self, schema, columns, jobs, batch_rows))
    }

    /// Records of the episodes where no column tells steps from other rows: all rows are steps.
    fn plain_episodes(&self) -> Vec<EpisodeRecord> {
        let mut first_row = 0;
        let places = self.episodes.places.iter();
        let record = |place: &Place| {
            let record = EpisodeRecord {
                episode_index: place.number,
                length: place.length,
                first_row,
                n_rows: place.length,
                end: EpisodeEnd::Unknown,
                has_final_obs: false,
                seed: None,
                success: None,
                total_return: None,
                attributes: serde_json::Map::new(),
            };
            first_row += place.length;
            record
        };
        places.map(record).collect()
    }

    fn episode_records(&self) -> Result<Vec<EpisodeRecord>> {
        let markers = [schema::REWARD, schema::TERMINATED, schema::TRUNCATED];
        let has_marker = markers
            .iter()
            .any(|name| self.schema.index_of(name).is_ok())
            || action_column(&self.schema).is_ok();
        let mut records = match has_marker {
            true => (self as &dyn DatasetSource).derived_episodes()?,
            false => self.plain_episodes(),
        };
        let mut attributes = episodes::attributes(&self.root, &self.declared)?;
        for record in &mut records {
            let mut attributes = attributes.remove(&record.episode_index).unwrap_or_default();
            record.seed = attributes.get(SEED).and_then(Value::as_u64);
            if record.seed.is_some() {
                attributes.remove(SEED);
            }
            record.attributes = attributes;
        }
        Ok(records)
    }
}

fn folder_name(path: &Path) -> String {
    let real = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let name = real.file_name();
    name.map(|name| name.to_string_lossy().into_owned())
        .unwrap_or_default()
}

/// Compares what `info.json` counts with the episodes that are described.
///
/// # Errors
/// Fewer than it counts: descriptions are missing. In recovery that is a warning, as more always are.
fn check_counts(
    root: &Root,
    declared: &Info,
    episodes: &Episodes,
    recover: bool,
) -> Result<Vec<Warning>> {
    let mut warnings = Vec::new();
    let n_episodes = episodes.places.len() as u64 + episodes.n_empty;
    let counts = [
        ("episodes", "total_episodes", n_episodes),
        ("steps", "total_frames", episodes.n_steps()),
    ];
    for (what, key, actual) in counts {
        let Some(recorded) = declared.count(key).filter(|recorded| *recorded != actual) else {
            continue;
        };
        if actual < recorded && !recover {
            let error = DatasetError::LengthMismatch {
                key: what.to_owned(),
                actual,
                expected: recorded,
            };
            return Err(error.in_file(&root.join(episodes::path(declared.layout))));
        }
        warnings.push(Warning::CountMismatch {
            what,
            recorded,
            actual,
        });
    }
    if episodes.n_empty > 0 {
        warnings.push(Warning::EmptyEpisodes {
            n_episodes: episodes.n_empty,
        });
    }
    Ok(warnings)
}

/// The columns, as the first data file has them.
fn plan_columns(root: &Root, declared: &Info, episodes: &Episodes) -> Result<Columns> {
    let Some(first) = episodes.places.first() else {
        return Columns::new(&declared.features, None, |_| None);
    };
    let path = &episodes.files[first.file].path;
    let plan = || {
        let file = ParquetFile::open(root, path)?;
        let schema = Arc::clone(file.schema());
        let first_picture = |feature: &str| {
            let file = ParquetFile::open(root, path).ok()?;
            let mut rows = file.read_rows(|name| name == feature, 1, &[(0, 1)]).ok()?;
            let batch = rows.next()?.ok()?;
            let bytes = picture_bytes(batch.column_by_name(feature)?)?;
            (bytes.len() == 1 && !bytes.is_null(0)).then(|| bytes.value(0).to_vec())
        };
        Columns::new(&declared.features, Some(&schema), first_picture)
    };
    plan().map_err(|error| error.in_file(&root.join(path)))
}

fn table_schema(columns: &[Column], declared: &Info, path: &Path) -> SchemaRef {
    let mut fields: Vec<FieldRef> = vec![
        Arc::new(Field::new(schema::EPISODE_INDEX, DataType::Int64, false)),
        Arc::new(Field::new(schema::STEP_INDEX, DataType::Int64, false)),
    ];
    fields.extend(columns.iter().map(|column| Arc::clone(&column.field)));
    let metadata = [
        (schema::VERSION_KEY, schema::VERSION.to_owned()),
        (schema::SOURCE_FORMAT, Format::LeRobot.name().to_owned()),
        (schema::SOURCE_VERSION, declared.version.clone()),
        (schema::SOURCE_ID, folder_name(path)),
        (schema::SOURCE_METADATA, declared.text.clone()),
        (schema::FPS, declared.fps.to_string()),
    ];
    let metadata = metadata.map(|(key, value)| (key.to_owned(), value));
    Arc::new(Schema::new_with_metadata(fields, metadata.into()))
}

impl DatasetSource for LeRobotSource {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let is_wanted = |place: &Place| match &scan.episodes {
            Some(wanted) => wanted.contains(&place.number),
            None => true,
        };
        let places = self.episodes.places.iter().copied().filter(is_wanted);
        self.pass(places, scan.columns.as_deref(), scan.batch_rows)
            .map(|pass| Box::new(pass) as _)
            .map_err(|error| error.in_file(&self.info.path))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        self.episode_records()
            .map_err(|error| error.in_file(&self.info.path))
    }
}
