//! Recordings as a dataset.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::Arc;

use arrow::array::{RecordBatch, RecordBatchReader};
use arrow::datatypes::SchemaRef;
use arrow::error::ArrowError;
use serde_json::{Map, Value, json};

use super::Recording;
use super::bind::Layout;
use super::mapping::{Grid, Mapping, Role};
use super::numbered;
use super::plan::Episode;
use super::scan::{FileInput, FileScan};
use super::steps::StepCheck;
use super::track::Track;
use crate::episode::{EpisodeEnd, EpisodeRecord};
use crate::error::Result;
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan};

/// One recording or a folder of them, read through a mapping.
///
/// Opening is one pass over the mapped topics of every file: it keeps the time of each message (8 bytes) and of
/// each row. A scan is another pass; it holds the samples that rows still wait for and one batch.
pub(crate) struct McapSource {
    pub(super) mapping: Mapping,
    pub(super) files: Vec<FileState>,
    pub(super) layouts: Vec<Layout>,
    pub(super) schema: SchemaRef,
    pub(super) info: DatasetInfo,
}

/// One file.
pub(super) struct FileState {
    pub(super) recording: Recording,
    pub(super) tracks: BTreeMap<String, Track>,
    /// With their numbers in the dataset.
    pub(super) episodes: Vec<(i64, Episode)>,
    pub(super) metadata: Value,
}

impl DatasetSource for McapSource {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let (schema, _) = schema::project(&self.schema, scan.columns.as_deref())
            .map_err(|error| error.in_file(&self.info.path))?;
        Ok(Box::new(McapScan {
            source: self,
            schema,
            wanted: scan.episodes.clone(),
            batch_rows: scan.batch_rows.max(1),
            files: self.files.iter().collect(),
            open: None,
        }))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        let is_numbered = matches!(self.mapping.grid, Grid::Index(_));
        let columns = || self.mapping.columns.iter();
        let says_more = columns().any(|column| {
            let is_step = matches!(
                column.role,
                Role::Reward | Role::Terminated | Role::Truncated
            );
            is_step || column.name == schema::INFO_SUCCESS
        });
        let mut records = match says_more || is_numbered {
            true => (self as &dyn DatasetSource).derived_episodes()?,
            false => self.plain_records(),
        };
        let has_steps = columns().any(numbered::is_step);
        let own = self.files.iter().flat_map(|file| {
            file.episodes
                .iter()
                .map(move |(_, episode)| (file, episode))
        });
        for (record, (file, episode)) in records.iter_mut().zip(own) {
            if !has_steps {
                // No column tells a final observation.
                record.length = episode.n_steps();
                record.has_final_obs = episode.has_final;
            }
            if !is_numbered {
                record.success = episode.success.or(record.success);
                record.attributes = attributes(file, episode);
            }
        }
        Ok(records)
    }
}

impl McapSource {
    /// The episodes without what only their rows say.
    fn plain_records(&self) -> Vec<EpisodeRecord> {
        let mut first_row = 0;
        let episodes = self.files.iter().flat_map(|file| &file.episodes);
        episodes
            .map(|(number, episode)| {
                let n_rows = episode.rows.len() as u64;
                first_row += n_rows;
                EpisodeRecord {
                    episode_index: *number,
                    length: episode.n_steps(),
                    first_row: first_row - n_rows,
                    n_rows,
                    end: EpisodeEnd::Unknown,
                    has_final_obs: episode.has_final,
                    seed: None,
                    success: None,
                    total_return: None,
                    attributes: Map::new(),
                }
            })
            .collect()
    }
}

/// What is known of an episode beside its rows.
fn attributes(file: &FileState, episode: &Episode) -> Map<String, Value> {
    let name = file.recording.path().file_name().unwrap_or_default();
    let mut attributes = Map::new();
    attributes.insert("source_file".to_owned(), json!(name.to_string_lossy()));
    attributes.insert("start_time_ns".to_owned(), json!(episode.rows.first()));
    if let Some(task) = &episode.task {
        attributes.insert("tasks".to_owned(), json!([task]));
    }
    if file
        .metadata
        .as_array()
        .is_some_and(|records| !records.is_empty())
    {
        attributes.insert("metadata".to_owned(), file.metadata.clone());
    }
    attributes
}

/// A file in the middle of a pass.
struct OpenFile<'a> {
    path: &'a Path,
    scan: FileScan<'a>,
    /// Where rows carry their numbers; elsewhere the mapping says where nulls may be.
    check: Option<StepCheck<'a>>,
}

impl OpenFile<'_> {
    fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        let batch = self.scan.next_batch()?;
        if let (Some(check), Some(batch)) = (&mut self.check, &batch) {
            check.check(batch)?;
        }
        Ok(batch)
    }
}

/// A pass over the files.
struct McapScan<'a> {
    source: &'a McapSource,
    schema: SchemaRef,
    wanted: Option<Vec<i64>>,
    batch_rows: usize,
    files: VecDeque<&'a FileState>,
    open: Option<OpenFile<'a>>,
}

impl<'a> McapScan<'a> {
    fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        loop {
            if let Some(file) = &mut self.open {
                let batch = file
                    .next_batch()
                    .map_err(|error| error.in_file(file.path))?;
                if batch.is_some() {
                    return Ok(batch);
                }
                self.open = None;
            }
            let Some(file) = self.files.pop_front() else {
                return Ok(None);
            };
            self.open = Some(self.start(file)?);
        }
    }

    fn start(&self, file: &'a FileState) -> Result<OpenFile<'a>> {
        let is_wanted = |number: &i64| {
            self.wanted
                .as_ref()
                .is_none_or(|wanted| wanted.contains(number))
        };
        let episodes = file.episodes.iter().filter(|(number, _)| is_wanted(number));
        let episodes: Vec<_> = episodes
            .map(|(number, episode)| (*number, episode))
            .collect();
        let mapping = &self.source.mapping;
        let is_numbered = matches!(mapping.grid, Grid::Index(_));
        let check = is_numbered.then(|| {
            let episodes = episodes.iter().map(|(_, episode)| *episode);
            StepCheck::new(mapping, episodes.collect())
        });
        let input = FileInput {
            recording: &file.recording,
            mapping,
            tracks: &file.tracks,
            layouts: &self.source.layouts,
            episodes,
        };
        let path = file.recording.path();
        let scan = FileScan::new(input, &self.schema, self.batch_rows)
            .map_err(|error| error.in_file(path))?;
        Ok(OpenFile { path, scan, check })
    }
}

impl Iterator for McapScan<'_> {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        let batch = self.next_batch();
        if batch.is_err() {
            // A reader that failed ends its pass.
            self.files.clear();
            self.open = None;
        }
        batch.map_err(ArrowError::from).transpose()
    }
}

impl RecordBatchReader for McapScan<'_> {
    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }
}
