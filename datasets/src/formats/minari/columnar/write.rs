//! Writing the Arrow and Parquet storages.

use std::fs::File;
use std::path::{Path, PathBuf};

use arrow::array::{Array, ArrayRef, RecordBatch};
use arrow::ipc::writer::FileWriter;
use parquet::arrow::ArrowWriter;
use parquet::basic::Compression;
use parquet::file::properties::WriterProperties;
use serde_json::Value;

use super::super::json;
use super::super::write::columns::Group;
use super::super::write::tree::Node;
use super::super::write::{self, Episode, EpisodeStore, Rows};
use super::encode::Encoder;
use super::part::Part;
use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::formats::fill::concat;
use crate::sink::{DatasetSink, Loss, LossEffect, LossTally, SinkInput, WriteOptions};

/// Rows of a record batch, at most: what pyarrow's scanner gives in one go. Minari 0.5.4 takes every batch
/// of the scanner for an episode, so shorter episodes are one batch.
const MAX_BATCH_ROWS: usize = 131_072;
/// Bytes of an episode that are held in memory, at most.
const MAX_HELD_BYTES: usize = 256 << 20;

/// Starts a dataset folder.
///
/// # Errors
/// The columns do not fit, or the folder cannot be made.
pub(crate) fn create(
    path: &Path,
    format: Format,
    input: &SinkInput<'_>,
    options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    write::create(path, format, input, options, |data, columns, losses| {
        note_infos(&columns.infos, losses);
        Ok(Box::new(ColumnarStore {
            data: data.to_owned(),
            format,
            encoder: Encoder {
                observation: columns.observation.clone(),
                action: columns.action.clone(),
                infos: columns.infos.clone(),
            },
            open: None,
        }))
    })
}

/// What this storage or its library does to infos.
fn note_infos(infos: &Group, losses: &mut Vec<Loss>) {
    let Some(tree @ Node::Dict(parts)) = &infos.tree else {
        return;
    };
    let mut changed = |detail| losses.push(Loss::new("info", LossEffect::Changed, detail));
    if tree.has_tuple() {
        changed("elements of tuples become keys named by their number");
    }
    if parts.iter().any(|(_, part)| !matches!(part, Node::Leaf(_))) {
        changed("nested infos are kept, but Minari 0.5.4 does not restore them from this storage");
    }
}

struct ColumnarStore {
    data: PathBuf,
    format: Format,
    encoder: Encoder,
    open: Option<OpenEpisode>,
}

/// The episode that is being written.
struct OpenEpisode {
    path: PathBuf,
    held: Vec<Rows>,
    held_rows: usize,
    held_bytes: usize,
    writer: Option<PartWriter>,
    /// Which infos the file has; decided at the first write.
    infos: Vec<bool>,
}

enum PartWriter {
    Arrow(Box<FileWriter<File>>),
    Parquet(Box<ArrowWriter<File>>),
}

impl EpisodeStore for ColumnarStore {
    fn begin(&mut self, episode: &Episode, _: &mut LossTally) -> Result<()> {
        let folder = self.data.join(episode.number.to_string());
        std::fs::create_dir(&folder).map_err(|e| DatasetError::io("create", e))?;
        let text = json::write(&Value::Object(episode.attributes.clone()));
        std::fs::write(folder.join("metadata.json"), text)
            .map_err(|e| DatasetError::io("write", e))?;
        self.open = Some(OpenEpisode {
            path: Part::path(self.format, &folder),
            held: Vec::new(),
            held_rows: 0,
            held_bytes: 0,
            writer: None,
            infos: Vec::new(),
        });
        Ok(())
    }

    fn append(&mut self, rows: Rows, losses: &mut LossTally) -> Result<()> {
        let Some(mut open) = self.open.take() else {
            return Ok(());
        };
        let is_end = rows.is_end;
        let n_bytes = bytes(&rows);
        let is_full = open.held_rows + rows.n_rows() > MAX_BATCH_ROWS
            || open.held_bytes + n_bytes > MAX_HELD_BYTES;
        if is_full && !open.held.is_empty() {
            if open.writer.is_none() {
                let detail = "longer than 131072 rows or 256 MiB, so they are several record batches, \
                     which Minari 0.5.4 takes for several episodes";
                losses.add("long episodes", LossEffect::Changed, detail, 1);
            }
            self.flush(&mut open, losses)?;
        }
        open.held_rows += rows.n_rows();
        open.held_bytes += n_bytes;
        open.held.push(rows);
        if !is_end {
            self.open = Some(open);
            return Ok(());
        }
        self.flush(&mut open, losses)?;
        open.writer.map_or(Ok(()), PartWriter::finish)
    }

    fn finish(self: Box<Self>) -> Result<()> {
        Ok(())
    }
}

impl ColumnarStore {
    /// Writes the rows that are held as one batch.
    fn flush(&self, open: &mut OpenEpisode, losses: &mut LossTally) -> Result<()> {
        let held = joined(std::mem::take(&mut open.held))?;
        (open.held_rows, open.held_bytes) = (0, 0);
        if open.writer.is_none() {
            // A column without any value is left out of the episode.
            let has_value = |array: &ArrayRef| array.null_count() < array.len();
            open.infos = held.infos.iter().map(has_value).collect();
        }
        let batch = self.encoder.batch(&held, &open.infos, losses)?;
        let mut writer = match open.writer.take() {
            Some(writer) => writer,
            None => PartWriter::create(&open.path, self.format, &batch)?,
        };
        writer.write(&batch)?;
        open.writer = Some(writer);
        Ok(())
    }
}

impl PartWriter {
    /// Starts the file of an episode with the columns of its first batch.
    fn create(path: &Path, format: Format, batch: &RecordBatch) -> Result<Self> {
        let file = File::create_new(path).map_err(|e| DatasetError::io("create", e))?;
        let schema = batch.schema();
        if format == Format::MinariParquet {
            let properties = WriterProperties::builder()
                .set_compression(Compression::SNAPPY)
                .set_max_row_group_row_count(Some(MAX_BATCH_ROWS));
            let writer = ArrowWriter::try_new(file, schema, Some(properties.build()));
            let writer = writer.map_err(DatasetError::parquet("start an episode"))?;
            return Ok(Self::Parquet(Box::new(writer)));
        }
        let writer = FileWriter::try_new(file, &schema);
        let writer = writer.map_err(DatasetError::arrow("start an episode"))?;
        Ok(Self::Arrow(Box::new(writer)))
    }

    fn write(&mut self, batch: &RecordBatch) -> Result<()> {
        match self {
            Self::Arrow(writer) => writer
                .write(batch)
                .map_err(DatasetError::arrow("write an episode")),
            Self::Parquet(writer) => {
                let write = DatasetError::parquet("write an episode");
                writer.write(batch).map_err(&write)?;
                // One row group a batch, so that nothing else is held.
                writer.flush().map_err(write)
            }
        }
    }

    fn finish(self) -> Result<()> {
        let file = match self {
            Self::Arrow(writer) => writer
                .into_inner()
                .map_err(DatasetError::arrow("finish an episode"))?,
            Self::Parquet(writer) => writer
                .into_inner()
                .map_err(DatasetError::parquet("finish an episode"))?,
        };
        file.sync_all().map_err(|e| DatasetError::io("write", e))
    }
}

/// All pieces of an episode as one.
fn joined(mut pieces: Vec<Rows>) -> Result<Rows> {
    if pieces.len() == 1
        && let Some(only) = pieces.pop()
    {
        return Ok(only);
    }
    let joined_list = |of: fn(&Rows) -> &Vec<ArrayRef>| -> Result<Vec<ArrayRef>> {
        let n = pieces.first().map_or(0, |rows| of(rows).len());
        let nth = |place| {
            let parts = pieces.iter().filter_map(move |rows| of(rows).get(place));
            concat(&parts.collect::<Vec<_>>())
        };
        (0..n).map(nth).collect()
    };
    let joined_one = |of: fn(&Rows) -> &ArrayRef| -> Result<ArrayRef> {
        concat(&pieces.iter().map(of).collect::<Vec<_>>())
    };
    Ok(Rows {
        observations: joined_list(|rows| &rows.observations)?,
        actions: joined_list(|rows| &rows.actions)?,
        rewards: joined_one(|rows| &rows.rewards)?,
        terminations: joined_one(|rows| &rows.terminations)?,
        truncations: joined_one(|rows| &rows.truncations)?,
        infos: joined_list(|rows| &rows.infos)?,
        is_end: pieces.last().is_some_and(|rows| rows.is_end),
    })
}

fn bytes(rows: &Rows) -> usize {
    let lists = [&rows.observations, &rows.actions, &rows.infos];
    let arrays = lists.into_iter().flatten();
    let size = |array: &ArrayRef| array.to_data().get_slice_memory_size().unwrap_or(0);
    arrays.map(size).sum()
}
