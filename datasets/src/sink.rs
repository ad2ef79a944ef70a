//! Writing datasets.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::sync::Arc;

use arrow::array::RecordBatch;
use arrow::datatypes::SchemaRef;

use crate::episode::{EpisodeRecord, records_json};
use crate::error::{DatasetError, Result};
use crate::format::{Format, OpenOptions, open};
use crate::formats::parquet::ParquetSink;
use crate::formats::tabular::{ColumnNames, FilePlan};
use crate::formats::{hdf5_writing, ipc, lerobot, mcap_files, minari};
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan};
use crate::staging::Staged;

/// Write side. Nothing is visible at the destination until `finish` succeeds; a sink that is dropped before
/// leaves nothing behind.
pub trait DatasetSink: Send {
    /// Adds the rows of a batch in the canonical layout; all batches have the same schema.
    ///
    /// # Errors
    /// A batch of another schema, or a failed write.
    fn write(&mut self, batch: &RecordBatch) -> Result<()>;

    /// Puts the dataset in its place and describes it.
    ///
    /// # Errors
    /// A failed write; the destination is then untouched.
    fn finish(self: Box<Self>) -> Result<Written>;
}

/// A dataset that was written.
#[derive(Debug, Clone)]
pub struct Written {
    /// What was written, as its reader describes it.
    pub info: DatasetInfo,
    /// What of the source the format does not hold.
    pub losses: Vec<Loss>,
}

/// Something that a written file does not hold as the source did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Loss {
    /// The column, or what else it is about: `seeds`, `final observations`.
    pub item: String,
    /// What became of it.
    pub effect: LossEffect,
    /// Why and how, for people.
    pub detail: String,
    /// How many rows or episodes, where it is not all of them.
    pub count: Option<u64>,
}

/// What became of something that a format cannot hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum LossEffect {
    /// It is not in the file.
    Dropped,
    /// It is there in another form: another type, name or place.
    Changed,
    /// The format demands something the source does not have, and a value was made up.
    Invented,
}

impl LossEffect {
    /// Stable name: `dropped`, `changed` or `invented`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Dropped => "dropped",
            Self::Changed => "changed",
            Self::Invented => "invented",
        }
    }
}

impl Loss {
    /// A loss that concerns everything of its kind.
    pub(crate) fn new(
        item: impl Into<String>,
        effect: LossEffect,
        detail: impl Into<String>,
    ) -> Self {
        Self {
            item: item.into(),
            effect,
            detail: detail.into(),
            count: None,
        }
    }
}

/// Losses that are met one by one and reported once, in the order of their items.
#[derive(Debug, Default)]
pub(crate) struct LossTally {
    counts: BTreeMap<(String, LossEffect, String), u64>,
}

impl LossTally {
    /// Notes a loss of `n` rows, episodes or what the item says; nothing if `n` is 0.
    pub(crate) fn add(
        &mut self,
        item: impl Into<String>,
        effect: LossEffect,
        detail: impl Into<String>,
        n: u64,
    ) {
        if n > 0 {
            let key = (item.into(), effect, detail.into());
            *self.counts.entry(key).or_default() += n;
        }
    }

    /// The losses with their counts.
    pub(crate) fn into_losses(self) -> impl Iterator<Item = Loss> {
        let counts = self.counts.into_iter();
        counts.map(|((item, effect, detail), count)| Loss {
            item,
            effect,
            detail,
            count: Some(count),
        })
    }
}

impl fmt::Display for Loss {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.item, self.effect.name())?;
        if let Some(count) = self.count {
            write!(f, " ({count})")?;
        }
        write!(f, ": {}", self.detail)
    }
}

/// What a sink must know before the first row.
#[derive(Clone, Copy)]
pub struct SinkInput<'a> {
    /// The columns that will come, with the schema metadata of the source.
    pub schema: &'a SchemaRef,
    /// The source's description.
    pub info: &'a DatasetInfo,
    /// The episodes that will come, in order, with their seeds and attributes.
    pub episodes: &'a [EpisodeRecord],
}

/// How to write.
#[derive(Debug, Clone, Default)]
pub struct WriteOptions {
    /// Id to write into the dataset; `None` keeps the source's, or takes the name of the destination.
    pub id: Option<String>,
    /// Replace a dataset folder that is at the destination. It stays there until the new one is complete.
    pub overwrite: bool,
    /// How formats that demand a final observation get one, for episodes that have none.
    pub final_observation: FinalObservation,
    /// Steps per second, for formats that need it; `None` takes what the source records.
    pub fps: Option<f64>,
    /// Task text of episodes that have none, for LeRobot.
    pub task: Option<String>,
    /// Name of the robot, for LeRobot.
    pub robot_type: Option<String>,
    /// How messages are encoded, for MCAP.
    pub mcap_encoding: McapEncoding,
}

/// Where the observation after the last step comes from if the episode has none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum FinalObservation {
    /// `next_observation` where the source has it, else the last step is given up for its observation.
    #[default]
    Recorded,
    /// The last observation once more. The last transition then shows no motion.
    Duplicate,
    /// The last step is always given up.
    DropStep,
}

/// Message encoding of written MCAP files.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum McapEncoding {
    /// JSON with JSON Schema: readable by anything.
    Json,
    /// Protobuf with its descriptors in the file: exact and compact.
    #[default]
    Protobuf,
}

/// Starts a dataset of a format at a path where nothing is yet (a file is replaced when the sink finishes, a
/// folder is not).
///
/// # Errors
/// The format cannot hold such columns, cannot be written by this build, or the destination cannot be made.
pub fn create(
    path: &Path,
    format: Format,
    input: &SinkInput<'_>,
    options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    if matches!(format, Format::Parquet | Format::ArrowIpc) {
        // What the reader refuses must not take the place of what is there.
        let plan = FilePlan::new(input.schema, &ColumnNames::default());
        plan.map_err(|error| error.in_file(path))?;
    }
    let created = match format {
        Format::Parquet => ParquetSink::create(path, with_records(input, options))
            .map(|sink| Box::new(sink) as Box<dyn DatasetSink>),
        Format::ArrowIpc => ipc::create(path, input, options),
        Format::D4rlHdf5 => hdf5_writing::create_d4rl(path, input, options),
        Format::MinariHdf5 => hdf5_writing::create_minari(path, input, options),
        Format::MinariArrow | Format::MinariParquet => {
            minari::create_columnar(path, format, input, options)
        }
        Format::LeRobot => lerobot::create(path, input, options),
        Format::Mcap => mcap_files::create(path, input, options),
        Format::Robomimic | Format::Npz => Err(DatasetError::Unsupported {
            what: format!("writing {format}"),
        }),
    };
    created.map_err(|error| error.in_file(path))
}

/// The schema of a file without a place of its own for the id and for what the source records of its episodes.
pub(crate) fn with_records(input: &SinkInput<'_>, options: &WriteOptions) -> SchemaRef {
    let mut metadata = input.schema.metadata().clone();
    if let Some(id) = &options.id {
        metadata.insert(schema::SOURCE_ID.to_owned(), id.clone());
    }
    if let Some(records) = records_json(input.episodes) {
        metadata.insert(schema::EPISODE_RECORDS.to_owned(), records);
    }
    Arc::new(input.schema.as_ref().clone().with_metadata(metadata))
}

/// Checks that what was written can be read, puts it in its place, and describes it.
///
/// # Errors
/// It cannot be read or put there; what stood at the target still does.
pub(crate) fn publish(staged: Staged, losses: Vec<Loss>) -> Result<Written> {
    let target = staged.target().to_owned();
    let options = OpenOptions::default();
    // Before it takes the place of something that can be read.
    drop(open(staged.path(), &options)?);
    staged.publish()?;
    let info = open(&target, &options)?.info().clone();
    Ok(Written { info, losses })
}

/// Writes all rows of a dataset; the caller finishes the sink. Gives the number of rows.
///
/// # Errors
/// Those of the scan and of the sink.
pub fn copy(source: &dyn DatasetSource, sink: &mut dyn DatasetSink) -> Result<u64> {
    let mut n_rows = 0;
    for batch in source.scan(&Scan::default())? {
        let batch = batch?;
        n_rows += batch.num_rows() as u64;
        sink.write(&batch)?;
    }
    Ok(n_rows)
}
