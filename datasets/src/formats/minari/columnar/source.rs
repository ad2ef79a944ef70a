//! Delivering a dataset of columnar files in batches.

use std::collections::{BTreeSet, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array, RecordBatch, RecordBatchOptions, RecordBatchReader};
use arrow::datatypes::{FieldRef, SchemaRef};
use arrow::error::ArrowError;
use serde_json::Value;

use super::super::describe::{Oddities, count_warnings, dataset_info, table_schema};
use super::super::empty::SpaceLeaves;
use super::super::metadata::{Metadata, episode_attributes};
use super::super::space::Space;
use super::convert::column;
use super::leaves::{Leaf, Leaves, info_paths};
use super::part::{Part, PartReader};
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::format::{Format, OpenOptions};
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan, Warning};

/// Files of episodes, at most: more than any dataset has.
const MAX_EPISODES: usize = 10_000_000;

/// A Minari dataset of Arrow or Parquet files, open.
pub(crate) struct ColumnarSource {
    /// The folder with a folder per episode.
    data: PathBuf,
    episodes: Vec<Episode>,
    columns: Vec<Leaf>,
    schema: SchemaRef,
    info: DatasetInfo,
}

#[derive(Debug, Clone, Copy)]
struct Episode {
    number: i64,
    n_rows: u64,
    n_steps: u64,
}

impl ColumnarSource {
    /// Opens a dataset folder: reads the metadata and the footer of every file.
    ///
    /// # Errors
    /// Whatever of that fails; the file is named.
    pub(crate) fn open(path: &Path, format: Format, options: &OpenOptions) -> Result<Self> {
        let metadata = Metadata::read(path)?;
        let mut warnings: Vec<Warning> =
            metadata.check_version(options.force)?.into_iter().collect();
        let data = path.join("data");
        let numbers = episode_numbers(&data, &mut warnings)?;
        let mut leaves = first_leaves(&data, format, &numbers, &metadata)?;
        if !numbers.is_empty()
            && (metadata.observation_space.is_none() || metadata.action_space.is_none())
        {
            warnings.push(Warning::NoSpace);
        }
        warnings.append(&mut leaves.warnings);
        let episodes = episodes(&data, format, numbers, &mut warnings)?;
        let n_steps = episodes.iter().map(|episode| episode.n_steps).sum();
        count_warnings(&metadata, episodes.len() as u64, n_steps, &mut warnings);
        let fields: Vec<FieldRef> = match episodes.is_empty() && leaves.columns.is_empty() {
            true => SpaceLeaves::new(&metadata)?.fields(),
            false => leaves
                .columns
                .iter()
                .map(|c| Arc::clone(&c.field))
                .collect(),
        };
        let schema = table_schema(format, &fields, &metadata);
        let mut info = dataset_info(format, path, metadata);
        info.n_episodes = Some(episodes.len() as u64);
        info.n_steps = Some(n_steps);
        info.observation = leaves.observation;
        info.action = leaves.action;
        info.warnings = warnings;
        Ok(Self {
            data,
            episodes,
            columns: leaves.columns,
            schema,
            info,
        })
    }

    fn folder(&self, episode: &Episode) -> PathBuf {
        self.data.join(episode.number.to_string())
    }
}

/// Numbers of the episodes' folders, in order.
fn episode_numbers(data: &Path, warnings: &mut Vec<Warning>) -> Result<Vec<i64>> {
    let entries = std::fs::read_dir(data).map_err(|e| DatasetError::io("list", e).in_file(data))?;
    let mut numbers = Vec::new();
    for entry in entries {
        let entry = entry.map_err(|e| DatasetError::io("list", e).in_file(data))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let number = name.parse::<i64>().ok();
        match number.filter(|number| *number >= 0 && number.to_string() == name) {
            Some(number) => numbers.push(number),
            None if name == "metadata.json" => {}
            None => warnings.push(Warning::ColumnLeftOut {
                column: name,
                reason: "it is no episode",
            }),
        }
        if numbers.len() > MAX_EPISODES {
            return Err(DatasetError::corrupt("more episodes than can be").in_file(data));
        }
    }
    numbers.sort_unstable();
    Ok(numbers)
}

/// The columns of the first episode, or of the spaces if there is none.
fn first_leaves(
    data: &Path,
    format: Format,
    numbers: &[i64],
    metadata: &Metadata,
) -> Result<Leaves> {
    let Some(first) = numbers.first() else {
        let leaves = SpaceLeaves::new(metadata)?;
        return Ok(Leaves {
            observation: leaves.observation,
            action: leaves.action,
            ..Leaves::default()
        });
    };
    let path = Part::path(format, &data.join(first.to_string()));
    let part = Part::open(format, &path);
    let leaves = part.and_then(|part| {
        Leaves::new(
            part.schema(),
            &Space::of(&metadata.observation_space),
            &Space::of(&metadata.action_space),
        )
    });
    leaves.map_err(|error| error.in_file(&path))
}

/// Lengths of all episodes; those without a step are left out.
fn episodes(
    data: &Path,
    format: Format,
    numbers: Vec<i64>,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Episode>> {
    let mut odd = Oddities::default();
    let mut episodes = Vec::with_capacity(numbers.len());
    for number in numbers {
        let folder = data.join(number.to_string());
        let path = Part::path(format, &folder);
        let part = Part::open(format, &path).map_err(|error| error.in_file(&path))?;
        odd.note_infos(info_paths(part.schema()));
        let n_rows = part.n_rows();
        let recorded = episode_attributes(&folder)?
            .get("total_steps")
            .and_then(Value::as_u64);
        let n_steps = recorded.unwrap_or(n_rows.saturating_sub(1));
        if n_rows != n_steps && n_rows.checked_sub(1) != Some(n_steps) {
            let error = DatasetError::LengthMismatch {
                key: "observations".to_owned(),
                actual: n_rows,
                expected: n_steps.saturating_add(1),
            };
            return Err(error.in_file(&path));
        }
        if n_steps == 0 {
            odd.n_empty += 1;
            continue;
        }
        odd.n_without_final += u64::from(n_rows == n_steps);
        episodes.push(Episode {
            number,
            n_rows,
            n_steps,
        });
    }
    odd.warn(warnings);
    Ok(episodes)
}

impl DatasetSource for ColumnarSource {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let (schema, _) = schema::project(&self.schema, scan.columns.as_deref())
            .map_err(|error| error.in_file(&self.data))?;
        let is_wanted = |episode: &&Episode| match &scan.episodes {
            Some(wanted) => wanted.contains(&episode.number),
            None => true,
        };
        Ok(Box::new(ColumnarScan {
            source: self,
            schema,
            episodes: self.episodes.iter().filter(is_wanted).copied().collect(),
            open: None,
            pending: None,
            batch_rows: scan.batch_rows.max(1),
        }))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        let mut records = (self as &dyn DatasetSource).derived_episodes()?;
        for (record, episode) in records.iter_mut().zip(&self.episodes) {
            record.attributes = episode_attributes(&self.folder(episode))?;
            record.seed = record.attributes.get("seed").and_then(Value::as_u64);
        }
        Ok(records)
    }
}

/// A pass over the files.
struct ColumnarScan<'a> {
    source: &'a ColumnarSource,
    schema: SchemaRef,
    /// Not yet opened.
    episodes: VecDeque<Episode>,
    open: Option<(Episode, u64, PartReader)>,
    /// Whole short episodes that wait for others to fill the batch.
    pending: Option<RecordBatch>,
    batch_rows: usize,
}

impl ColumnarScan<'_> {
    /// The next rows of one episode.
    fn next_rows(&mut self) -> Result<Option<RecordBatch>> {
        loop {
            if let Some((episode, first_row, mut reader)) = self.open.take() {
                let path = self.path(&episode);
                let wrong_length = |actual| DatasetError::LengthMismatch {
                    key: "observations".to_owned(),
                    actual,
                    expected: episode.n_rows,
                };
                match reader.next() {
                    None if first_row == episode.n_rows => {}
                    None => return Err(wrong_length(first_row).in_file(&path)),
                    Some(batch) => {
                        let read =
                            batch.and_then(|batch| self.canonical(&batch, episode, first_row));
                        let rows = read.map_err(|error| error.in_file(&path))?;
                        let after = first_row + rows.num_rows() as u64;
                        if after > episode.n_rows {
                            return Err(wrong_length(after).in_file(&path));
                        }
                        self.open = Some((episode, after, reader));
                        return Ok(Some(rows));
                    }
                }
            }
            let Some(episode) = self.episodes.pop_front() else {
                return Ok(None);
            };
            let path = self.path(&episode);
            let reader = self.reader(&path).map_err(|error| error.in_file(&path))?;
            self.open = Some((episode, 0, reader));
        }
    }

    fn path(&self, episode: &Episode) -> PathBuf {
        Part::path(self.source.info.format, &self.source.folder(episode))
    }

    fn wanted(&self) -> impl Iterator<Item = &Leaf> {
        self.source
            .columns
            .iter()
            .filter(|leaf| self.schema.index_of(leaf.field.name()).is_ok())
    }

    /// Rewards are always read: a batch without columns would not know its rows.
    fn reader(&self, path: &Path) -> Result<PartReader> {
        let part = Part::open(self.source.info.format, path)?;
        let roots = self.wanted().filter_map(|leaf| leaf.path.first());
        let mut roots: BTreeSet<&str> = roots.map(String::as_str).collect();
        roots.insert("rewards");
        let columns = roots
            .into_iter()
            .filter_map(|root| part.schema().index_of(root).ok());
        let mut columns: Vec<usize> = columns.collect();
        columns.sort_unstable();
        part.read(columns, self.batch_rows)
    }

    fn canonical(
        &self,
        batch: &RecordBatch,
        episode: Episode,
        first_row: u64,
    ) -> Result<RecordBatch> {
        let n_rows = batch.num_rows();
        let steps = || {
            let first = i64::try_from(first_row).unwrap_or(i64::MAX);
            (0i64..)
                .take(n_rows)
                .map(move |row| first.saturating_add(row))
        };
        let mut leaves = self.wanted();
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(self.schema.fields().len());
        for field in self.schema.fields() {
            arrays.push(match field.name().as_str() {
                schema::EPISODE_INDEX => Arc::new(Int64Array::from(vec![episode.number; n_rows])),
                schema::STEP_INDEX => Arc::new(Int64Array::from_iter_values(steps())),
                _ => {
                    let leaf = leaves
                        .next()
                        .ok_or_else(|| DatasetError::corrupt("a column vanished"))?;
                    column(leaf, batch, first_row, episode.n_steps)?
                }
            });
        }
        let options = RecordBatchOptions::new().with_row_count(Some(n_rows));
        RecordBatch::try_new_with_options(Arc::clone(&self.schema), arrays, &options)
            .map_err(DatasetError::arrow("build a batch"))
    }

    /// Puts episodes together as long as they fit a batch.
    fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        let mut waiting: Vec<RecordBatch> = self.pending.take().into_iter().collect();
        let mut n_rows: usize = waiting.iter().map(RecordBatch::num_rows).sum();
        while let Some(rows) = self.next_rows()? {
            if n_rows + rows.num_rows() > self.batch_rows && !waiting.is_empty() {
                self.pending = Some(rows);
                break;
            }
            n_rows += rows.num_rows();
            waiting.push(rows);
        }
        match waiting.as_slice() {
            [] => Ok(None),
            [one] => Ok(Some(one.clone())),
            several => arrow::compute::concat_batches(&self.schema, several)
                .map(Some)
                .map_err(DatasetError::arrow("build a batch")),
        }
    }
}

impl Iterator for ColumnarScan<'_> {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        let batch = self.next_batch();
        if batch.is_err() {
            // A reader that failed ends its pass.
            self.episodes.clear();
            self.open = None;
            self.pending = None;
        }
        batch.map_err(ArrowError::from).transpose()
    }
}

impl RecordBatchReader for ColumnarScan<'_> {
    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }
}
