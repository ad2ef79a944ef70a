//! The sink.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, AsArray, BooleanArray, Float32Array, Int64Array, RecordBatch};
use arrow::compute::filter_record_batch;
use arrow::datatypes::{DataType, Int64Type, Schema, SchemaRef};
use parquet::arrow::ArrowWriter;
use serde_json::{Map, Value, json};

use super::super::columns::{FRAME_INDEX, INDEX, TASK_INDEX, TIMESTAMP};
use super::super::info::{DATA_PATH_V3, INFO_PATH};
use super::super::rows::grid_ns;
use super::super::tasks::TASKS_PATH;
use super::arrays::{convert, numbers};
use super::counts::Counts;
use super::plan::{Feature, features, file_schema, loss};
use super::rate::Rate;
use super::stats::{FeatureStats, StatsRow, capacity};
use super::table::{EpisodeRow, EpisodeTable};
use super::tasks::Tasks;
use super::{files, meta};
use crate::episode::{action_column, column};
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::sink::{DatasetSink, Loss, LossEffect, SinkInput, WriteOptions, Written, publish};
use crate::staging::Staged;

/// A data file is followed by the next one when it has this many bytes.
const FILE_BYTES: usize = 100 << 20;
/// Files of a folder.
pub(super) const CHUNK_FILES: i64 = 1000;
/// Rows of a row group, at least: an episode of its own below that would cost more to describe than to hold.
const GROUP_ROWS: usize = 128;
/// Values of a row that statistics are kept for, at most.
const STATS_WIDTH: usize = 4096;
/// Times further from the grid than LeRobot tolerates, in ns.
const TOLERANCE_NS: i64 = 100_000;
/// Writes a LeRobot dataset of version 3.0.
pub(in crate::formats::lerobot) struct LeRobotSink {
    staged: Staged,
    schema: SchemaRef,
    features: Vec<Feature>,
    file_schema: Arc<Schema>,
    /// A column that is null in final-observation rows only.
    marker: Option<String>,
    /// Steps of each episode, where no column tells them from final observations.
    lengths: HashMap<i64, i64>,
    rate: Rate,
    /// Rows that wait until the rate is known.
    waiting: Vec<RecordBatch>,
    /// Whether `t_ns` is a feature, so that timestamps can be on the grid.
    keeps_time: bool,
    tasks: Tasks,
    data: Option<ArrowWriter<std::fs::File>>,
    n_files: i64,
    table: EpisodeTable,
    current: Option<Current>,
    /// Of the episode at hand, and of all before; none for features without statistics.
    episode_stats: Vec<Option<FeatureStats>>,
    stats: Vec<Option<FeatureStats>>,
    robot_type: Value,
    n_episodes: i64,
    n_steps: i64,
    losses: Vec<Loss>,
    counts: Counts,
}

/// The episode that is being written.
struct Current {
    source_index: i64,
    n_steps: i64,
    tasks: Vec<String>,
}

impl LeRobotSink {
    /// Starts a folder.
    ///
    /// # Errors
    /// Something is there already, the folder cannot be made, or a rate that is no positive number.
    pub(in crate::formats::lerobot) fn create(
        path: &Path,
        input: &SinkInput<'_>,
        options: &WriteOptions,
    ) -> Result<Self> {
        let schema = Arc::clone(input.schema);
        let indices = [schema::EPISODE_INDEX, schema::STEP_INDEX].map(str::to_owned);
        schema::project(&schema, Some(&indices))?;
        let mut losses = meta::metadata_losses(&schema);
        let rate = Rate::new(&schema, options.fps, &mut losses)?;
        let has_time = schema.index_of(schema::T_NS).is_ok();
        let keeps_time = has_time && !rate.is_grid(&schema);
        let mut features = features(&schema, keeps_time, &mut losses);
        let defaults = [
            TIMESTAMP,
            FRAME_INDEX,
            schema::EPISODE_INDEX,
            INDEX,
            TASK_INDEX,
        ];
        features.extend(defaults.map(|name| match name {
            TIMESTAMP => Feature::index(name, "float32"),
            name => Feature::index(name, "int64"),
        }));
        let stats = empty_stats(&features, &mut losses);
        let staged = Staged::folder(path, options.overwrite)?;
        let with_stats = features.iter().zip(&stats);
        let with_stats: Vec<&Feature> = with_stats
            .filter_map(|(feature, stats)| stats.as_ref().map(|_| feature))
            .collect();
        let table_path = staged
            .path()
            .join("meta/episodes/chunk-000/file-000.parquet");
        let table = EpisodeTable::create(&table_path, &with_stats, input.episodes, &mut losses)?;
        let marker = marker(&schema);
        let unmarked = input.episodes.iter().filter(|_| marker.is_none());
        let length = |n: u64| i64::try_from(n).unwrap_or(i64::MAX);
        Ok(Self {
            lengths: unmarked
                .map(|episode| (episode.episode_index, length(episode.length)))
                .collect(),
            marker,
            robot_type: meta::robot_type(&schema, options),
            staged,
            schema,
            file_schema: file_schema(&features),
            features,
            rate,
            waiting: Vec::new(),
            keeps_time,
            tasks: Tasks::new(options.task.as_ref(), meta::episode_tasks(input.episodes)),
            data: None,
            n_files: 0,
            table,
            current: None,
            episode_stats: stats.clone(),
            stats,
            n_episodes: 0,
            n_steps: 0,
            losses,
            counts: Counts::default(),
        })
    }

    /// Steps only: rows of final observations are counted and left out.
    fn steps(&mut self, batch: &RecordBatch) -> Result<RecordBatch> {
        let Some(marker) = &self.marker else {
            return Ok(batch.clone());
        };
        let marker = column(batch, marker)?;
        if marker.null_count() == 0 {
            return Ok(batch.clone());
        }
        self.counts.final_rows += marker.null_count() as u64;
        let keep: BooleanArray = (0..marker.len())
            .map(|row| Some(!marker.is_null(row)))
            .collect();
        filter_record_batch(batch, &keep).map_err(DatasetError::arrow("leave out rows"))
    }

    /// Writes what waited for the rate, which is made up now if it is still not known.
    fn release(&mut self) -> Result<()> {
        self.rate.settle(&mut self.losses);
        for batch in std::mem::take(&mut self.waiting) {
            self.write_steps(&batch)?;
        }
        Ok(())
    }

    fn write_steps(&mut self, batch: &RecordBatch) -> Result<()> {
        let episodes = column(batch, schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        let episodes = episodes.values().clone();
        let mut start = 0;
        for run in episodes.chunk_by(|a, b| a == b) {
            let is_next = |current: &Current| current.source_index != run[0];
            if self.current.as_ref().is_none_or(is_next) {
                self.end_episode()?;
                self.current = Some(Current {
                    source_index: run[0],
                    n_steps: 0,
                    tasks: Vec::new(),
                });
            }
            let n_steps = self.n_steps_of(run);
            self.counts.final_rows += (run.len() - n_steps) as u64;
            if n_steps > 0 {
                self.write_run(&batch.slice(start, n_steps))?;
            }
            start += run.len();
        }
        Ok(())
    }

    /// How many of the next rows of the episode at hand are steps.
    fn n_steps_of(&self, run: &[i64]) -> usize {
        let length = run.first().and_then(|episode| self.lengths.get(episode));
        let left = length.map(|length| length - self.current.as_ref().map_or(0, |c| c.n_steps));
        left.map_or(run.len(), |left| {
            usize::try_from(left).unwrap_or(0).min(run.len())
        })
    }

    /// Writes rows of the episode at hand.
    fn write_run(&mut self, batch: &RecordBatch) -> Result<()> {
        let first_step = self.current.as_ref().map_or(0, |current| current.n_steps);
        let n_rows = i64::try_from(batch.num_rows()).unwrap_or(i64::MAX);
        let steps = || (first_step..).take(batch.num_rows());
        let recorded = column(batch, schema::STEP_INDEX)?.as_primitive::<Int64Type>();
        let moved = recorded
            .values()
            .iter()
            .zip(steps())
            .filter(|(a, b)| **a != *b);
        self.counts.renumbered_steps += moved.count() as u64;
        let Some(current) = &mut self.current else {
            return Err(DatasetError::corrupt("rows without an episode"));
        };
        let tasks = self
            .tasks
            .of_rows(batch, current.source_index, &mut current.tasks);
        let first_index = self.n_steps;
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(self.features.len());
        let n_columns = self.features.len() - 5;
        for place in 0..n_columns {
            let feature = &self.features[place];
            let source = batch.column(feature.source);
            let first_row = u64::try_from(first_index).unwrap_or(0);
            let converted = convert(feature, source, first_row)?;
            if converted.n_filled > 0 {
                let column = self.schema.field(feature.source).name().clone();
                *self.counts.filled.entry(column).or_default() += converted.n_filled;
            }
            self.add_stats(place, &converted.values)?;
            arrays.push(converted.array);
        }
        let indices: [ArrayRef; 5] = [
            Arc::new(self.timestamps(batch, first_step)?),
            Arc::new(Int64Array::from_iter_values(steps())),
            Arc::new(Int64Array::from(vec![self.n_episodes; batch.num_rows()])),
            Arc::new(Int64Array::from_iter_values(
                (first_index..).take(batch.num_rows()),
            )),
            Arc::new(Int64Array::from(tasks)),
        ];
        for (place, array) in (n_columns..).zip(indices) {
            self.add_stats(place, &array)?;
            arrays.push(array);
        }
        let rows = RecordBatch::try_new(Arc::clone(&self.file_schema), arrays)
            .map_err(DatasetError::arrow("build a batch"))?;
        self.n_steps += n_rows;
        if let Some(current) = &mut self.current {
            current.n_steps += n_rows;
        }
        files::write(self.data_file()?, &rows)
    }

    fn add_stats(&mut self, feature: usize, values: &ArrayRef) -> Result<()> {
        if let Some(Some(stats)) = self.episode_stats.get_mut(feature) {
            stats.add(&numbers(values)?);
        }
        Ok(())
    }

    /// The file at hand, or the next one.
    fn data_file(&mut self) -> Result<&mut ArrowWriter<std::fs::File>> {
        let data = match self.data.take() {
            Some(data) => data,
            None => {
                let (chunk, file) = (self.n_files / CHUNK_FILES, self.n_files % CHUNK_FILES);
                let path = format!("data/chunk-{chunk:03}/file-{file:03}.parquet");
                let path = self.staged.path().join(path);
                self.n_files += 1;
                files::start(&path, &self.file_schema)?
            }
        };
        Ok(self.data.insert(data))
    }

    /// Seconds of each step: on the grid, or as recorded where nothing else keeps the time.
    fn timestamps(&mut self, batch: &RecordBatch, first_step: i64) -> Result<Float32Array> {
        let fps = self.rate.fps();
        let times = match batch.column_by_name(schema::T_NS) {
            Some(times) => {
                let times = arrow::compute::cast(times, &DataType::Int64)
                    .map_err(DatasetError::arrow("read times"))?;
                Some(times.as_primitive::<Int64Type>().clone())
            }
            None => None,
        };
        let mut seconds = Vec::with_capacity(batch.num_rows());
        for (row, step) in (first_step..).take(batch.num_rows()).enumerate() {
            let on_grid = grid_ns(step, fps);
            let recorded = times.as_ref().filter(|times| !times.is_null(row));
            let recorded = recorded.map_or(on_grid, |times| times.value(row));
            let differs = recorded.saturating_sub(on_grid).saturating_abs();
            self.counts.off_grid += u64::from(differs > TOLERANCE_NS);
            seconds.push(match differs == 0 || self.keeps_time {
                true => (step as f64 / fps) as f32,
                false => (recorded as f64 / 1e9) as f32,
            });
        }
        Ok(seconds.into())
    }

    fn end_episode(&mut self) -> Result<()> {
        let Some(current) = self.current.take() else {
            return Ok(());
        };
        let mut stats: Vec<StatsRow> = Vec::new();
        for (whole, part) in self.stats.iter_mut().zip(&mut self.episode_stats) {
            if let (Some(whole), Some(part)) = (whole, part) {
                stats.push(part.summary());
                whole.take(part);
            }
        }
        let place = self.n_files - 1;
        let to = self.n_steps;
        let (chunk, file) = (place / CHUNK_FILES, place % CHUNK_FILES);
        let from = to - current.n_steps;
        self.table.add(EpisodeRow {
            places: [
                self.n_episodes,
                current.n_steps,
                chunk,
                file,
                from,
                to,
                0,
                0,
            ],
            tasks: current.tasks,
            source_index: current.source_index,
            stats,
        })?;
        self.n_episodes += 1;
        if let Some(data) = &mut self.data {
            if data.in_progress_rows() >= GROUP_ROWS {
                data.flush().map_err(DatasetError::parquet("write rows"))?;
            }
            if data.bytes_written() + data.in_progress_size() >= FILE_BYTES {
                self.close_data()?;
            }
        }
        Ok(())
    }

    fn close_data(&mut self) -> Result<()> {
        self.data.take().map_or(Ok(()), files::finish)
    }

    fn write_all(&mut self, batch: &RecordBatch) -> Result<()> {
        if batch.schema().fields() != self.schema.fields() {
            return Err(DatasetError::corrupt(
                "a batch has other columns than the first",
            ));
        }
        let steps = self.steps(batch)?;
        if self.rate.is_known() || self.rate.estimate(&steps, &mut self.losses)? {
            if !self.waiting.is_empty() {
                self.release()?;
            }
            return self.write_steps(&steps);
        }
        self.waiting.push(steps);
        let n_rows: usize = self.waiting.iter().map(RecordBatch::num_rows).sum();
        match n_rows >= GROUP_ROWS {
            true => self.release(),
            false => Ok(()),
        }
    }

    fn info_json(&self) -> Value {
        let features = self.features.iter();
        let features: Map<String, Value> = features
            .map(|feature| (feature.name.clone(), feature.json()))
            .collect();
        json!({
            "codebase_version": "v3.0",
            "robot_type": self.robot_type,
            "total_episodes": self.n_episodes,
            "total_frames": self.n_steps,
            "total_tasks": self.tasks.texts.len(),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": FILE_BYTES >> 20,
            "video_files_size_in_mb": 200,
            "fps": self.rate.fps() as u64,
            "splits": {"train": format!("0:{}", self.n_episodes)},
            "data_path": DATA_PATH_V3,
            "video_path": null,
            "features": features,
        })
    }

    fn finish_all(mut self) -> Result<Written> {
        self.release()?;
        self.end_episode()?;
        self.close_data()?;
        let counted = self.counts.losses(self.rate.fps(), self.keeps_time);
        self.losses.extend(counted);
        self.losses.extend(self.tasks.loss());
        let meta = self.staged.path().join("meta");
        let mut stats = Map::new();
        for (feature, of_feature) in self.features.iter().zip(&self.stats) {
            let entry = match of_feature {
                Some(stats) => stats.json(&feature.shape),
                None if feature.dtype == "image" => meta::picture_stats(self.n_steps),
                None => continue,
            };
            stats.insert(feature.name.clone(), entry);
        }
        let info = self.info_json();
        let Self {
            staged,
            table,
            tasks,
            losses,
            ..
        } = self;
        table.finish()?;
        meta::write_tasks(&staged.path().join(TASKS_PATH), &tasks.texts)?;
        files::write_text(
            &meta.join("stats.json"),
            &meta::pretty(&Value::Object(stats))?,
        )?;
        files::write_text(&staged.path().join(INFO_PATH), &meta::pretty(&info)?)?;
        publish(staged, losses)
    }
}

/// What tells steps from final observations.
fn marker(schema: &Schema) -> Option<String> {
    let usual = [schema::REWARD, schema::TERMINATED, schema::TRUNCATED];
    let usual = usual.iter().find(|name| schema.index_of(name).is_ok());
    let usual = usual.map(|name| (*name).to_owned());
    usual.or_else(|| action_column(schema).ok())
}

fn empty_stats(features: &[Feature], losses: &mut Vec<Loss>) -> Vec<Option<FeatureStats>> {
    let is_kept = |feature: &&Feature| feature.is_numeric() && feature.width() <= STATS_WIDTH;
    let n_values = features.iter().filter(is_kept).map(Feature::width).sum();
    let capacity = capacity(n_values);
    let of = |feature: &Feature| {
        if feature.dtype == "image" {
            let detail = "pictures are not decoded: their statistics are ImageNet's mean and deviation in 0..1";
            let item = format!("statistics of {}", feature.name);
            losses.push(loss(&item, LossEffect::Invented, detail));
        } else if feature.is_numeric() && feature.width() > STATS_WIDTH {
            let detail = format!("features of over {STATS_WIDTH} values get none");
            let item = format!("statistics of {}", feature.name);
            losses.push(loss(&item, LossEffect::Dropped, detail));
        }
        is_kept(&feature).then(|| FeatureStats::new(feature.width(), capacity))
    };
    features.iter().map(of).collect()
}

impl DatasetSink for LeRobotSink {
    fn write(&mut self, batch: &RecordBatch) -> Result<()> {
        let written = self.write_all(batch);
        written.map_err(|error| error.in_file(self.staged.target()))
    }

    fn finish(self: Box<Self>) -> Result<Written> {
        let target = self.staged.target().to_owned();
        self.finish_all().map_err(|error| error.in_file(&target))
    }
}
