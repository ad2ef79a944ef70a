//! The evidence: every step and the reference step it was matched with, as Parquet.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context as _, Result};
use arrow::array::{ArrayRef, Float64Builder, Int64Builder, RecordBatch, StringBuilder};
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use ksim::{KSim, Report, StepScore};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, ZstdLevel};
use parquet::file::properties::WriterProperties;

use crate::atomic::AtomicFile;
use crate::load::{StepNumbers, Steps};

/// Rows turned into Arrow at a time.
const BATCH_ROWS: usize = 16_384;

/// Writes the steps of all rollouts into one file, which appears when it is complete.
pub(crate) struct PerStepWriter {
    writer: ArrowWriter<AtomicFile>,
    schema: SchemaRef,
    labels: Labels,
}

/// Which columns tell the rows of several rollouts apart.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Labels {
    /// There is more than one file.
    pub(crate) file: bool,
    /// Some file names planners.
    pub(crate) planner: bool,
}

/// The rollouts behind a report.
pub(crate) struct Scored<'a> {
    /// Their file, as given.
    pub(crate) file: &'a str,
    /// Their states, actions and step numbers.
    pub(crate) steps: &'a Steps,
    /// Their scores.
    pub(crate) report: &'a Report,
    /// The reference they were scored against.
    pub(crate) ksim: &'a KSim,
    /// Step numbers of the reference.
    pub(crate) reference: &'a StepNumbers,
}

impl PerStepWriter {
    /// Starts the file.
    pub(crate) fn create(path: &Path, labels: Labels) -> Result<Self> {
        let schema = schema(labels);
        let properties = WriterProperties::builder()
            .set_compression(Compression::ZSTD(ZstdLevel::default()))
            .build();
        let file = AtomicFile::create(path)?;
        let writer = ArrowWriter::try_new(file, Arc::clone(&schema), Some(properties))
            .context("cannot start the per-step file")?;
        Ok(Self {
            writer,
            schema,
            labels,
        })
    }

    /// Adds the steps of one file or planner.
    pub(crate) fn write(&mut self, scored: &Scored<'_>) -> Result<()> {
        let mut rows = Rows::default();
        for episode in scored.steps.trajectories.episodes() {
            for row in episode.rows.clone() {
                let number = scored.steps.number(row, row - episode.rows.start);
                rows.push(
                    episode.episode_index,
                    number,
                    &scored.report.steps[row],
                    scored,
                );
                if rows.len == BATCH_ROWS {
                    self.flush(std::mem::take(&mut rows), scored)?;
                }
            }
        }
        self.flush(rows, scored)
    }

    fn flush(&mut self, mut rows: Rows, scored: &Scored<'_>) -> Result<()> {
        let mut columns: Vec<ArrayRef> = Vec::with_capacity(self.schema.fields().len());
        if self.labels.file {
            columns.push(repeated(Some(scored.file), rows.len));
        }
        if self.labels.planner {
            columns.push(repeated(scored.steps.planner.as_deref(), rows.len));
        }
        columns.extend(rows.finish());
        let batch = RecordBatch::try_new(Arc::clone(&self.schema), columns);
        let batch = batch.context("cannot lay out the per-step rows")?;
        self.writer
            .write(&batch)
            .context("cannot write the per-step file")
    }

    /// Puts the complete file in its place.
    pub(crate) fn finish(self) -> Result<()> {
        let file = self
            .writer
            .into_inner()
            .context("cannot finish the per-step file")?;
        file.publish()
    }
}

fn schema(labels: Labels) -> SchemaRef {
    let text = |name: &str, wanted: bool, nullable: bool| {
        wanted.then(|| Field::new(name, DataType::Utf8, nullable))
    };
    let int = |name: &str| Field::new(name, DataType::Int64, name == "cluster");
    let float = |name: &str| Field::new(name, DataType::Float64, false);
    let labels = [
        text("file", labels.file, false),
        text("planner", labels.planner, true),
    ];
    let fields = labels.into_iter().flatten().chain([
        int("episode_index"),
        int("step_index"),
        float("score"),
        float("distance"),
        float("state_distance"),
        float("action_distance"),
        int("cluster"),
        int("reference_row"),
        int("reference_episode_index"),
        int("reference_step_index"),
    ]);
    Arc::new(Schema::new(fields.collect::<Vec<_>>()))
}

fn repeated(text: Option<&str>, n: usize) -> ArrayRef {
    let mut builder = StringBuilder::new();
    for _ in 0..n {
        builder.append_option(text);
    }
    Arc::new(builder.finish())
}

/// Columns in the order of [`schema`].
#[derive(Default)]
struct Rows {
    len: usize,
    place: [Int64Builder; 2],
    distances: [Float64Builder; 4],
    cluster: Int64Builder,
    reference: [Int64Builder; 3],
}

impl Rows {
    fn push(&mut self, episode: i64, number: i64, step: &StepScore, scored: &Scored<'_>) {
        let (reference_episode, position) = scored.ksim.reference_step(step.reference_row);
        let reference_number = scored
            .reference
            .number(step.reference_row as usize, position);
        append(&mut self.place, [episode, number]);
        let distances = [
            step.score,
            step.distance,
            step.state_distance,
            step.action_distance,
        ];
        for (builder, value) in self.distances.iter_mut().zip(distances) {
            builder.append_value(value);
        }
        self.cluster.append_option(step.cluster.map(i64::from));
        let row = i64::from(step.reference_row);
        append(
            &mut self.reference,
            [row, reference_episode, reference_number],
        );
        self.len += 1;
    }

    fn finish(&mut self) -> Vec<ArrayRef> {
        let mut columns: Vec<ArrayRef> = Vec::with_capacity(10);
        columns.extend(
            self.place
                .iter_mut()
                .map(|builder| Arc::new(builder.finish()) as ArrayRef),
        );
        columns.extend(
            self.distances
                .iter_mut()
                .map(|builder| Arc::new(builder.finish()) as ArrayRef),
        );
        columns.push(Arc::new(self.cluster.finish()));
        columns.extend(
            self.reference
                .iter_mut()
                .map(|builder| Arc::new(builder.finish()) as ArrayRef),
        );
        columns
    }
}

fn append<const N: usize>(builders: &mut [Int64Builder; N], values: [i64; N]) {
    for (builder, value) in builders.iter_mut().zip(values) {
        builder.append_value(value);
    }
}
