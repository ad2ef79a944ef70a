//! Writing a dataset as an MCAP recording.
//!
//! A row is one message on `/step` (numbers, reward, flags) and one on `/observation`, `/action` and `/info` as far as
//! the table has such columns (`info.k_sim` and `info.demonstration` have topics of their own), all with the same log
//! time; a null is a field, or a whole message, that is not there. `/episode` marks beginnings and ends for viewers.
//! The metadata record `ksim.mapping` holds the mapping that reads all this back as the same table, `ksim.schema` the
//! metadata of the table, `ksim.episodes` how many rows each episode has, so that a reader knows what a damaged file
//! lost.

mod cells;
mod groups;
mod json;
mod protobuf;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{Int64Type, SchemaRef};
use mcap::records::{MessageHeader, Metadata};

use self::cells::cell;
use self::groups::Group;
use super::describe::{MAPPING_ENTRY, MAPPING_RECORD, SCHEMA_RECORD};
use super::numbered;
use crate::episode::{self, column};
use crate::error::{DatasetError, Result};
use crate::formats::episode_rows::EpisodeCursor;
use crate::schema;
use crate::sink::{
    DatasetSink, Loss, LossEffect, McapEncoding, SinkInput, WriteOptions, Written, publish,
};
use crate::staging::Staged;

/// Topic of the marks.
const EPISODE_TOPIC: &str = "/episode";
/// Between two steps if nothing tells their times, and between two episodes, in ns.
const STEP_NS: u64 = 20_000_000;
const PAUSE_NS: u64 = 1_000_000_000;

/// Writes an MCAP file: zstd chunks, all CRCs, an index.
pub(crate) struct McapSink {
    path: PathBuf,
    staged: Staged,
    writer: mcap::Writer<BufWriter<File>>,
    encoding: McapEncoding,
    groups: Vec<(u16, Group)>,
    marks: u16,
    losses: Vec<Loss>,
    clock: Clock,
    n_messages: u32,
    open_episode: Option<i64>,
    /// The rows that were noted at the start of the file.
    promised: EpisodeCursor,
}

/// Gives each row a log time of its own.
struct Clock {
    /// Of the last row, in ns.
    last: u64,
    /// Of the first row of the episode.
    start: u64,
    step_ns: u64,
}

impl McapSink {
    /// Starts a file; an existing one is replaced when the sink finishes.
    ///
    /// # Errors
    /// The file cannot be made, or the schema lacks the index columns.
    pub(crate) fn create(
        path: &Path,
        input: &SinkInput<'_>,
        options: &WriteOptions,
    ) -> Result<Self> {
        let index = [schema::EPISODE_INDEX, schema::STEP_INDEX].map(str::to_owned);
        schema::project(input.schema, Some(&index))?;
        let (groups, mut losses) = groups::groups(input.schema);
        let fps = options.fps.or_else(|| recorded_fps(input.schema));
        if input.schema.index_of(schema::T_NS).is_err() {
            let detail = match fps {
                Some(fps) => format!("no times are recorded: steps are {fps} a second"),
                None => "no times are recorded: steps are 20 ms apart".to_owned(),
            };
            losses.push(Loss {
                item: "message times".to_owned(),
                effect: LossEffect::Invented,
                detail,
                count: None,
            });
        }
        let staged = Staged::file(path)?;
        let file = File::create(staged.path()).map_err(|e| DatasetError::io("create", e))?;
        let mut writer = mcap::WriteOptions::new()
            .library(concat!("ksim ", env!("CARGO_PKG_VERSION")))
            .compression_threads(0)
            .create(BufWriter::new(file))
            .map_err(write_error)?;
        let groups_with_channels = groups
            .iter()
            .map(|group| {
                Ok((
                    channel(&mut writer, group, options.mcap_encoding)?,
                    group.clone(),
                ))
            })
            .collect::<Result<_>>()?;
        let marks = mark_channel(&mut writer)?;
        write_metadata(&mut writer, input, options, &groups)?;
        Ok(Self {
            path: path.to_owned(),
            staged,
            writer,
            encoding: options.mcap_encoding,
            groups: groups_with_channels,
            marks,
            losses,
            clock: Clock {
                last: 0,
                start: 0,
                step_ns: fps.map_or(STEP_NS, |fps| (1e9 / fps).clamp(1.0, 1e15) as u64),
            },
            n_messages: 0,
            open_episode: None,
            promised: EpisodeCursor::new(input),
        })
    }

    fn write_rows(&mut self, batch: &RecordBatch) -> Result<()> {
        self.promised.cut(batch)?;
        let episodes = column(batch, schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        let times = batch.column_by_name(schema::T_NS);
        let times = times.map(|times| times.as_primitive::<Int64Type>());
        for row in 0..batch.num_rows() {
            let episode = episodes.value(row);
            let is_new = self.open_episode != Some(episode);
            if is_new {
                self.mark_end()?;
            }
            let t_ns = times
                .filter(|times| times.is_valid(row))
                .map(|times| times.value(row));
            let time = self.clock.tick(is_new, t_ns);
            if is_new {
                self.open_episode = Some(episode);
                self.mark("start")?;
            }
            self.write_row(batch, row, time)?;
        }
        Ok(())
    }

    fn write_row(&mut self, batch: &RecordBatch, row: usize, time: u64) -> Result<()> {
        for at in 0..self.groups.len() {
            let Some((channel, group)) = self.groups.get(at) else {
                continue;
            };
            let message = match self.encoding {
                McapEncoding::Protobuf => protobuf_message(group, batch, row)?,
                McapEncoding::Json => json_message(group, batch, row)?,
            };
            let channel = *channel;
            if let Some(message) = message {
                self.send(channel, time, &message)?;
            }
        }
        Ok(())
    }

    fn send(&mut self, channel_id: u16, time: u64, data: &[u8]) -> Result<()> {
        let header = MessageHeader {
            channel_id,
            sequence: self.n_messages,
            log_time: time,
            publish_time: time,
        };
        self.n_messages = self.n_messages.wrapping_add(1);
        self.writer
            .write_to_known_channel(&header, data)
            .map_err(write_error)
    }

    fn mark(&mut self, event: &str) -> Result<()> {
        let mark = serde_json::json!({ "event": event, "episode_index": self.open_episode });
        self.send(self.marks, self.clock.last, mark.to_string().as_bytes())
    }

    fn mark_end(&mut self) -> Result<()> {
        match self.open_episode {
            Some(_) => self.mark("end"),
            None => Ok(()),
        }
    }

    fn close(mut self) -> Result<Written> {
        self.promised.finish()?;
        self.mark_end()?;
        self.writer.finish().map_err(write_error)?;
        let io = |e| DatasetError::io("write", e);
        let mut buffer = self.writer.into_inner();
        buffer.flush().map_err(io)?;
        buffer.get_ref().sync_all().map_err(io)?;
        drop(buffer);
        publish(self.staged, self.losses)
    }
}

impl Clock {
    /// The log time of the next row: strictly ascending, and as far from the start of its episode as recorded
    /// where that is possible.
    fn tick(&mut self, is_new: bool, t_ns: Option<i64>) -> u64 {
        let earliest = self.last.saturating_add(1);
        if is_new {
            self.start = self.last.saturating_add(PAUSE_NS);
        }
        let regular = match is_new {
            true => self.start,
            false => self.last.saturating_add(self.step_ns),
        };
        let recorded = t_ns.and_then(|t_ns| self.start.checked_add_signed(t_ns));
        self.last = recorded.unwrap_or(regular).max(earliest);
        self.last
    }
}

impl DatasetSink for McapSink {
    fn write(&mut self, batch: &RecordBatch) -> Result<()> {
        self.write_rows(batch)
            .map_err(|error| error.in_file(&self.path))
    }

    fn finish(self: Box<Self>) -> Result<Written> {
        let path = self.path.clone();
        self.close().map_err(|error| error.in_file(&path))
    }
}

/// A message of the group, or `None` if all its columns are null.
fn protobuf_message(group: &Group, batch: &RecordBatch, row: usize) -> Result<Option<Vec<u8>>> {
    let mut message = Vec::new();
    let mut is_there = false;
    for (at, member) in group.members.iter().enumerate() {
        if let Some(cell) = cell(batch.column(member.place), row, &member.column)? {
            protobuf::push(&mut message, at, member.is_vector, &cell);
            is_there = true;
        }
    }
    Ok(is_there.then_some(message))
}

fn json_message(group: &Group, batch: &RecordBatch, row: usize) -> Result<Option<Vec<u8>>> {
    let mut message = serde_json::Map::new();
    for member in &group.members {
        if let Some(cell) = cell(batch.column(member.place), row, &member.column)? {
            message.insert(member.name.clone(), json::value(member.is_vector, &cell));
        }
    }
    let is_there = !message.is_empty();
    Ok(is_there.then(|| serde_json::Value::Object(message).to_string().into_bytes()))
}

fn channel<W: Write + Seek>(
    writer: &mut mcap::Writer<W>,
    group: &Group,
    encoding: McapEncoding,
) -> Result<u16> {
    let (name, schema_encoding, data, message_encoding) = match encoding {
        McapEncoding::Protobuf => {
            let data = protobuf::descriptors(group);
            (protobuf::type_name(group), "protobuf", data, "protobuf")
        }
        McapEncoding::Json => {
            let data = json::schema(group).to_string().into_bytes();
            (group.message.to_owned(), "jsonschema", data, "json")
        }
    };
    let id = writer
        .add_schema(&name, schema_encoding, &data)
        .map_err(write_error)?;
    writer
        .add_channel(id, group.topic, message_encoding, &BTreeMap::new())
        .map_err(write_error)
}

fn mark_channel<W: Write + Seek>(writer: &mut mcap::Writer<W>) -> Result<u16> {
    let mark = serde_json::json!({
        "title": "Episode",
        "type": "object",
        "properties": { "event": { "type": "string" }, "episode_index": { "type": "integer" } },
    });
    let id = writer
        .add_schema("Episode", "jsonschema", mark.to_string().as_bytes())
        .map_err(write_error)?;
    writer
        .add_channel(id, EPISODE_TOPIC, "json", &BTreeMap::new())
        .map_err(write_error)
}

fn write_metadata<W: Write + Seek>(
    writer: &mut mcap::Writer<W>,
    input: &SinkInput<'_>,
    options: &WriteOptions,
    groups: &[Group],
) -> Result<()> {
    let mut table: BTreeMap<String, String> = input.schema.metadata().clone().into_iter().collect();
    if let Some(id) = &options.id {
        table.insert(schema::SOURCE_ID.to_owned(), id.clone());
    }
    if let Some(records) = episode::records_json(input.episodes) {
        table.insert(schema::EPISODE_RECORDS.to_owned(), records);
    }
    let mapping = BTreeMap::from([(MAPPING_ENTRY.to_owned(), groups::mapping_toml(groups))]);
    let records = [
        (MAPPING_RECORD, mapping),
        (SCHEMA_RECORD, table),
        numbered::record(input.episodes),
    ];
    for (name, metadata) in records {
        let name = name.to_owned();
        writer
            .write_metadata(&Metadata { name, metadata })
            .map_err(write_error)?;
    }
    Ok(())
}

fn recorded_fps(table: &SchemaRef) -> Option<f64> {
    let fps: f64 = table.metadata().get(schema::FPS)?.parse().ok()?;
    (fps.is_finite() && fps > 0.0).then_some(fps)
}

fn write_error(error: mcap::McapError) -> DatasetError {
    match error {
        mcap::McapError::Io(source) => DatasetError::io("write", source),
        other => DatasetError::io("write", io::Error::other(other)),
    }
}
