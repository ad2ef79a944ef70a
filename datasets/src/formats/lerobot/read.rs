//! Reading a dataset folder in batches.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, RecordBatch, RecordBatchOptions, RecordBatchReader};
use arrow::datatypes::{DataType, Field, FieldRef, Schema, SchemaRef};
use arrow::error::ArrowError;
use serde_json::Value;

use super::attributes::SEED;
use super::columns::{Column, Columns, Conversion, FRAME_INDEX, INDEX};
use super::episodes::{self, Episodes, Place};
use super::files::{Batches, ParquetFile};
use super::info::{Info, Layout};
use super::recover;
use super::root::Root;
use super::rows::{Rows, Run, picture_bytes};
use super::tasks::Tasks;
use crate::episode::{EpisodeEnd, EpisodeRecord, action_column};
use crate::error::{DatasetError, Result};
use crate::format::{Format, OpenOptions};
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan, Warning};
use crate::spec::LeafSpec;

/// Bytes of a batch, about: fewer rows are read at a time where they are large.
const BATCH_BYTES: u64 = 64 << 20;

/// A dataset folder, open. Memory: 40 bytes an episode, the tasks, and in a scan one batch of about 64 MiB at
/// most (one row, if that is larger).
pub(super) struct LeRobotSource {
    root: Root,
    info: DatasetInfo,
    schema: SchemaRef,
    columns: Vec<Column>,
    episodes: Episodes,
    tasks: Tasks,
    declared: Info,
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
        Ok(LeRobotScan {
            source: self,
            schema,
            columns,
            jobs,
            open: None,
            batch_rows: batch_rows.max(1),
        })
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

/// A pass over the data files.
pub(super) struct LeRobotScan<'a> {
    source: &'a LeRobotSource,
    schema: SchemaRef,
    columns: Vec<&'a Column>,
    /// Wanted episodes of the files that are not open yet, none empty.
    jobs: VecDeque<Vec<Place>>,
    open: Option<OpenFile>,
    batch_rows: usize,
}

struct OpenFile {
    /// Place among the files.
    file: usize,
    batches: Batches,
    /// Episodes not yet read to the end, and how many steps of the first were.
    episodes: VecDeque<Place>,
    next_step: u64,
}

impl LeRobotScan<'_> {
    fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        loop {
            if self.open.is_none() {
                let Some(job) = self.jobs.pop_front() else {
                    return Ok(None);
                };
                let file = job[0].file;
                let opened = self.open_file(file, job);
                self.open = Some(opened.map_err(|error| self.in_data_file(file, error))?);
            }
            if let Some(mut open) = self.open.take() {
                let file = open.file;
                let batch = self.read(&mut open);
                let batch = batch.map_err(|error| self.in_data_file(file, error))?;
                if batch.is_some() {
                    self.open = Some(open);
                    return Ok(batch);
                }
            }
        }
    }

    fn in_data_file(&self, file: usize, error: DatasetError) -> DatasetError {
        let file = self.source.episodes.files.get(file);
        let path = file.map_or("", |file| file.path.as_str());
        error.in_file(&self.source.root.join(path))
    }

    /// The index columns are always read: they are what the rows are checked by.
    fn open_file(&self, place: usize, episodes: Vec<Place>) -> Result<OpenFile> {
        let source = self.source;
        let Some(data_file) = source.episodes.files.get(place) else {
            return Err(DatasetError::corrupt("a file vanished"));
        };
        let file = ParquetFile::open(&source.root, &data_file.path)?;
        if file.n_rows() != data_file.n_rows {
            return Err(DatasetError::LengthMismatch {
                key: "data".to_owned(),
                actual: file.n_rows(),
                expected: data_file.n_rows,
            });
        }
        let ranges: Vec<(u64, u64)> = episodes
            .iter()
            .map(|place| (place.first_row, place.first_row + place.length))
            .collect();
        let wanted = |name: &str| {
            [schema::EPISODE_INDEX, FRAME_INDEX, INDEX].contains(&name)
                || self.columns.iter().any(|column| column.feature == name)
        };
        let batch_rows = self.batch_rows.min(self.affordable_rows(&file, &wanted));
        Ok(OpenFile {
            file: place,
            batches: file.read_rows(wanted, batch_rows, &ranges)?,
            episodes: episodes.into(),
            next_step: 0,
        })
    }

    /// How many rows may be read at a time.
    fn affordable_rows(&self, file: &ParquetFile, wanted: &dyn Fn(&str) -> bool) -> usize {
        let stored = file.row_bytes(wanted);
        let declared = self.columns.iter().map(|column| {
            let width = column.shape.iter().product::<usize>() as u64;
            width.saturating_mul(column.stored.primitive_width().unwrap_or(1) as u64)
        });
        let has_task = |column: &&Column| column.conversion == Conversion::Task;
        let task = match self.columns.iter().any(has_task) {
            true => self.source.tasks.longest() as u64,
            false => 0,
        };
        let row = declared.fold(stored.saturating_add(task), u64::saturating_add);
        usize::try_from(BATCH_BYTES / row.max(1))
            .unwrap_or(1)
            .max(1)
    }

    fn read(&self, open: &mut OpenFile) -> Result<Option<RecordBatch>> {
        let Some(batch) = open.batches.next().transpose()? else {
            let Some(place) = open.episodes.front() else {
                return Ok(None);
            };
            return Err(DatasetError::LengthMismatch {
                key: format!("episode {}", place.number),
                actual: open.next_step,
                expected: place.length,
            });
        };
        let rows = Rows {
            runs: open.runs(batch.num_rows())?,
            batch: &batch,
            fps: self.source.declared.fps,
            tasks: &self.source.tasks,
        };
        let (episodes, steps) = rows.indices()?;
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(self.schema.fields().len());
        let mut columns = self.columns.iter();
        for field in self.schema.fields() {
            arrays.push(match field.name().as_str() {
                schema::EPISODE_INDEX => Arc::clone(&episodes),
                schema::STEP_INDEX => Arc::clone(&steps),
                _ => match columns.next() {
                    Some(column) => rows.convert(column, &steps)?,
                    None => return Err(DatasetError::corrupt("a column vanished")),
                },
            });
        }
        let options = RecordBatchOptions::new().with_row_count(Some(batch.num_rows()));
        RecordBatch::try_new_with_options(Arc::clone(&self.schema), arrays, &options)
            .map(Some)
            .map_err(DatasetError::arrow("build a batch"))
    }
}

impl OpenFile {
    /// Takes the next rows off the episodes.
    fn runs(&mut self, n_rows: usize) -> Result<Vec<Run>> {
        let mut runs = Vec::new();
        let mut left = n_rows;
        while left > 0 {
            let Some(&episode) = self.episodes.front() else {
                return Err(DatasetError::corrupt("more rows than its footer counts"));
            };
            let rest = episode.length - self.next_step;
            let n_rows = usize::try_from(rest).unwrap_or(usize::MAX).min(left);
            runs.push(Run {
                episode,
                first_step: self.next_step,
                n_rows,
            });
            left -= n_rows;
            self.next_step += n_rows as u64;
            if self.next_step == episode.length {
                self.episodes.pop_front();
                self.next_step = 0;
            }
        }
        Ok(runs)
    }
}

impl Iterator for LeRobotScan<'_> {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        let batch = self.next_batch();
        if batch.is_err() {
            // A reader that failed ends its pass.
            self.jobs.clear();
            self.open = None;
        }
        batch.map_err(ArrowError::from).transpose()
    }
}

impl RecordBatchReader for LeRobotScan<'_> {
    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }
}
