//! Writing Minari dataset folders.
//!
//! [`columns`] sorts the columns of a table by their place in an episode, [`episodes`] decides what becomes of
//! episodes without a final observation, [`MinariSink`] cuts batches into episodes and hands their rows to an
//! [`EpisodeStore`]: one HDF5 file or a folder each. [`spaces`] and [`metadata`] describe the result.

pub(super) mod columns;
mod episodes;

#[cfg(feature = "hdf5")]
mod hdf5;
mod metadata;
mod spaces;
pub(super) mod tree;

use std::path::{Path, PathBuf};

use arrow::array::{Array, ArrayRef, RecordBatch};
use serde_json::{Map, Value};

#[cfg(feature = "hdf5")]
pub(crate) use self::hdf5::create as create_hdf5;

use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::formats::episode_rows::EpisodeCursor;
use crate::sink::{DatasetSink, Loss, LossTally, SinkInput, WriteOptions, Written, publish};
use crate::staging::Staged;
use columns::Columns;
use episodes::{Fates, rows};
use metadata::DatasetMetadata;

/// An episode that is about to come.
pub(super) struct Episode {
    pub(super) number: u64,
    /// At least 1.
    #[cfg_attr(
        not(feature = "hdf5"),
        allow(dead_code, reason = "used by the HDF5 writer")
    )]
    pub(super) n_steps: u64,
    /// Its seed, options and whatever else is recorded.
    pub(super) attributes: Map<String, Value>,
}

/// Some rows of an episode: as many observations and infos as rows, and a value of everything else for each
/// row that is a step. Only infos have nulls.
pub(super) struct Rows {
    pub(super) observations: Vec<ArrayRef>,
    pub(super) actions: Vec<ArrayRef>,
    /// `Float64`.
    pub(super) rewards: ArrayRef,
    pub(super) terminations: ArrayRef,
    pub(super) truncations: ArrayRef,
    pub(super) infos: Vec<ArrayRef>,
    /// These are the last rows of the episode.
    pub(super) is_end: bool,
}

impl Rows {
    /// Number of observations.
    pub(super) fn n_rows(&self) -> usize {
        self.observations.first().map_or(0, |array| array.len())
    }
}

/// Where the rows of episodes go.
pub(super) trait EpisodeStore: Send {
    /// Starts an episode; numbers count from 0 without a gap.
    ///
    /// # Errors
    /// A failed write.
    fn begin(&mut self, episode: &Episode, losses: &mut LossTally) -> Result<()>;

    /// Adds the next rows of the episode.
    ///
    /// # Errors
    /// A failed write.
    fn append(&mut self, rows: Rows, losses: &mut LossTally) -> Result<()>;

    /// Finishes all files.
    ///
    /// # Errors
    /// A failed write.
    fn finish(self: Box<Self>) -> Result<()>;
}

/// A dataset folder that is being written.
struct MinariSink {
    path: PathBuf,
    staged: Staged,
    cursor: EpisodeCursor,
    fates: Fates,
    columns: Columns,
    metadata: DatasetMetadata,
    store: Box<dyn EpisodeStore>,
    losses: Vec<Loss>,
    tally: LossTally,
}

/// Starts a dataset folder. `store` is given the folder for the data and the columns.
///
/// # Errors
/// The columns do not fit, or the folder cannot be made.
pub(super) fn create(
    path: &Path,
    format: Format,
    input: &SinkInput<'_>,
    options: &WriteOptions,
    store: impl FnOnce(&Path, &Columns, &mut Vec<Loss>) -> Result<Box<dyn EpisodeStore>>,
) -> Result<Box<dyn DatasetSink>> {
    let mut losses = Vec::new();
    let columns = Columns::new(input.schema, &mut losses)?;
    let metadata = DatasetMetadata::new(path, format, &columns, (input, options), &mut losses)?;
    let fates = Fates::new(input.episodes, &columns, options.final_observation);
    let staged = Staged::folder(path, options.overwrite)?;
    let data = staged.path().join("data");
    std::fs::create_dir(&data).map_err(|e| DatasetError::io("create", e))?;
    let store = store(&data, &columns, &mut losses)?;
    Ok(Box::new(MinariSink {
        path: path.to_owned(),
        staged,
        cursor: EpisodeCursor::new(input),
        fates,
        columns,
        metadata,
        store,
        losses,
        tally: LossTally::default(),
    }))
}

impl MinariSink {
    fn write_rows(&mut self, batch: &RecordBatch) -> Result<()> {
        for piece in self.cursor.cut(batch)? {
            let Some(record) = self.cursor.episodes().get(piece.place) else {
                continue;
            };
            let Some(fate) = self.fates.of(piece.place) else {
                continue;
            };
            if piece.first_row == 0 {
                let episode = fate.episode(record, &mut self.tally);
                self.store.begin(&episode, &mut self.tally)?;
            }
            let is_end = piece.first_row + piece.rows.num_rows() as u64 >= record.n_rows;
            let rows = rows(&piece, is_end, fate, &self.columns)?;
            self.metadata.see(&rows);
            self.store.append(rows, &mut self.tally)?;
        }
        Ok(())
    }

    fn place(self) -> Result<Written> {
        self.cursor.finish()?;
        let mut losses = self.losses;
        losses.extend(self.fates.losses());
        losses.extend(self.tally.into_losses());
        self.store.finish()?;
        let data = self.staged.path().join("data");
        self.metadata.write(&data, &self.fates)?;
        publish(self.staged, losses)
    }
}

impl DatasetSink for MinariSink {
    fn write(&mut self, batch: &RecordBatch) -> Result<()> {
        self.write_rows(batch)
            .map_err(|error| error.in_file(&self.path))
    }

    fn finish(self: Box<Self>) -> Result<Written> {
        let path = self.path.clone();
        self.place().map_err(|error| error.in_file(&path))
    }
}
