//! A pass over the messages of a file.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;

use super::attachment;
use super::body::Body;
use super::chunk::{ChunkHead, MAX_CHUNK, Records, Unpacker, bad_crc};
use super::frames::{Frame, Frames, MAGIC, RECORD_HEAD, Step};
use super::ledger::Ledger;
use super::op;
use super::registry::Registry;
use super::types::{AttachmentEntry, Channel, Message, Metadata, Statistics};
use super::{MessageOptions, Recording};
use crate::error::{DatasetError, Result};
use crate::source::Warning;

/// A pass over the messages of a [`Recording`].
///
/// Memory: one chunk, compressed and not, and the definitions; records and chunks of more than 1 GiB are
/// refused. A chunk is checked whole (its CRC, and that it
/// is records from end to end) before the first of its messages is given out. The messages of a file without
/// chunks are checked by the CRC of the whole data section, where it has one: when they have been read.
#[derive(Debug)]
pub struct Messages {
    path: PathBuf,
    frames: Frames,
    /// Body of the record that was read last.
    buffer: Vec<u8>,
    /// Records of the chunk that was read last, and where that is.
    records: Records,
    records_offset: u64,
    unpacker: Unpacker,
    ledger: Ledger,
    /// Offsets and lengths of the chunks that hold nothing wanted.
    passed: BTreeMap<u64, u64>,
    statistics: Option<Statistics>,
    phase: Phase,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Reading,
    Done,
    Failed,
}

/// A message that was found, before it is borrowed.
struct Found {
    place: usize,
    sequence: u32,
    log_time: u64,
    publish_time: u64,
    in_chunk: bool,
    data: Range<usize>,
}

impl Messages {
    pub(super) fn open(recording: &Recording, options: &MessageOptions) -> Result<Self> {
        let summary = recording.summary.as_ref();
        let passed = options
            .topics
            .as_ref()
            .and_then(|topics| Some(unwanted_chunks(summary?, topics)))
            .unwrap_or_default();
        // Without these, a definition in a chunk that is damaged or passed over would be missing.
        let known = match summary {
            Some(summary) if recording.recover || !passed.is_empty() => {
                Registry::new(&summary.schemas, &summary.channels)
            }
            _ => Registry::default(),
        };
        let mut frames = Frames::open(&recording.path)?;
        if recording.data_crc != 0 && passed.is_empty() {
            frames.hash_from_start()?;
        } else {
            frames.seek(MAGIC.len() as u64)?;
        }
        Ok(Self {
            path: recording.path.clone(),
            frames,
            buffer: Vec::new(),
            records: Records::default(),
            records_offset: 0,
            unpacker: Unpacker::default(),
            ledger: Ledger::new(known, options.topics.clone(), recording.recover),
            passed,
            statistics: summary.and_then(|summary| summary.statistics.clone()),
            phase: Phase::Reading,
        })
    }

    /// The next message, or `None` at the end of the data.
    ///
    /// # Errors
    /// Damage (if not recovering), a message of a channel that was not announced, a channel or schema that is
    /// announced again with another meaning. Do not read on after an error: what follows is another error.
    #[expect(
        clippy::should_implement_trait,
        reason = "a message borrows the reader"
    )]
    pub fn next(&mut self) -> Result<Option<Message<'_>>> {
        match self.advance() {
            Ok(None) => Ok(None),
            Ok(Some(found)) => Ok(self.message(found)),
            Err(error) => {
                self.phase = Phase::Failed;
                Err(error.in_file(&self.path))
            }
        }
    }

    /// What is odd so far; all of it once [`Self::next`] gave `None`. Losses ([`Warning::Lost`], recovering
    /// only), and counts of the summary that differ from what was read ([`Warning::CountMismatch`]).
    pub fn warnings(&self) -> &[Warning] {
        &self.ledger.warnings
    }

    /// Channels announced so far, by id. Recovering or with a choice of topics also those of the summary.
    pub fn channels(&self) -> &[Arc<Channel>] {
        self.ledger.channels()
    }

    /// Metadata records met so far.
    pub fn metadata(&self) -> &[Metadata] {
        &self.ledger.metadata
    }

    /// Attachments met so far.
    pub fn attachments(&self) -> &[AttachmentEntry] {
        &self.ledger.attachments
    }

    fn message(&self, found: Found) -> Option<Message<'_>> {
        let channel = self.ledger.channels().get(found.place)?;
        let data = if found.in_chunk {
            self.records.slice(found.data)
        } else {
            self.buffer.get(found.data).unwrap_or_default()
        };
        Some(Message {
            channel,
            sequence: found.sequence,
            log_time: found.log_time,
            publish_time: found.publish_time,
            data,
        })
    }

    fn advance(&mut self) -> Result<Option<Found>> {
        loop {
            if let Some((opcode, range)) = self.records.pop() {
                if let Some(found) = self.chunk_record(opcode, range)? {
                    return Ok(Some(found));
                }
                continue;
            }
            match self.phase {
                Phase::Reading => {}
                Phase::Done => return Ok(None),
                Phase::Failed => {
                    return Err(DatasetError::corrupt("reading stopped at an error before"));
                }
            }
            let found = match self.frames.step()? {
                Step::Record(frame) => self.record(&frame)?,
                Step::End => {
                    self.finish();
                    None
                }
                Step::Cut(frame) => {
                    self.cut(&frame)?;
                    None
                }
            };
            if found.is_some() {
                return Ok(found);
            }
        }
    }

    fn finish(&mut self) {
        self.phase = Phase::Done;
        self.ledger.finish(self.statistics.as_ref());
    }

    /// A record between the chunks.
    fn record(&mut self, frame: &Frame) -> Result<Option<Found>> {
        let offset = frame.offset;
        let is_data = |opcode| opcode != op::ATTACHMENT && opcode <= op::DATA_END;
        if frame.length > MAX_CHUNK && is_data(frame.opcode) {
            let large = DatasetError::corrupt(format!(
                "the record at offset {offset} has {} bytes, more than the {MAX_CHUNK} that are read",
                frame.length
            ));
            self.ledger.survive::<()>(Err(large))?;
            return self.frames.skip(frame).map(|()| None);
        }
        match frame.opcode {
            op::CHUNK => self.chunk(frame)?,
            op::MESSAGE => {
                self.read_body(frame)?;
                let message = parse_message(&self.buffer, offset, 0);
                return self.take(message, offset, false);
            }
            op::SCHEMA => {
                self.read_body(frame)?;
                self.ledger.add_schema(&self.buffer, offset)?;
            }
            op::CHANNEL => {
                self.read_body(frame)?;
                self.ledger.add_channel(&self.buffer, offset)?;
            }
            op::METADATA => {
                self.read_body(frame)?;
                let metadata = attachment::metadata(&self.buffer, offset);
                let metadata = self.ledger.survive(metadata)?;
                self.ledger.metadata.extend(metadata);
            }
            op::ATTACHMENT => {
                let entry = attachment::entry(&mut self.frames, frame, &mut self.buffer);
                let entry = self.ledger.survive(entry)?;
                self.ledger.attachments.extend(entry);
                self.frames.skip(frame)?;
            }
            op::DATA_END => {
                self.check_data(frame)?;
                self.finish();
            }
            op::FOOTER => self.finish(),
            _ => self.frames.skip(frame)?,
        }
        Ok(None)
    }

    fn read_body(&mut self, frame: &Frame) -> Result<()> {
        self.frames.body(frame, u64::MAX, &mut self.buffer)
    }

    fn chunk(&mut self, frame: &Frame) -> Result<()> {
        self.ledger.add_chunk();
        if self.passed.get(&frame.offset) == Some(&(RECORD_HEAD + frame.length)) {
            self.ledger.n_chunks_passed += 1;
            self.frames.stop_hashing();
            return self.frames.skip(frame);
        }
        self.read_body(frame)?;
        self.records_offset = frame.offset;
        let unpacked = self
            .unpacker
            .unpack(&self.buffer, frame.offset, &mut self.records);
        self.ledger.survive(unpacked).map(|_| ())
    }

    /// A record of the current chunk.
    fn chunk_record(&mut self, opcode: u8, range: Range<usize>) -> Result<Option<Found>> {
        let offset = self.records_offset;
        let bytes = self.records.slice(range.clone());
        match opcode {
            op::MESSAGE => {
                let message = parse_message(bytes, offset, range.start);
                return self.take(message, offset, true);
            }
            op::SCHEMA => self.ledger.add_schema(bytes, offset)?,
            op::CHANNEL => self.ledger.add_channel(bytes, offset)?,
            0x80.. => {}
            _ => {
                let odd = DatasetError::corrupt(format!(
                    "the chunk at offset {offset} holds a record of kind {opcode:#04x}"
                ));
                self.ledger.survive::<()>(Err(odd))?;
            }
        }
        Ok(None)
    }

    fn take(
        &mut self,
        message: Result<(u16, Found)>,
        offset: u64,
        in_chunk: bool,
    ) -> Result<Option<Found>> {
        let Some((channel, mut found)) = self.ledger.survive(message)? else {
            return Ok(None);
        };
        found.in_chunk = in_chunk;
        let place = self.ledger.add_message(channel, found.log_time, offset)?;
        Ok(place.map(|place| Found { place, ..found }))
    }

    /// The file ends inside a record.
    fn cut(&mut self, frame: &Frame) -> Result<()> {
        let (offset, left) = (frame.offset, self.frames.left());
        let what = match frame.opcode {
            0 => format!("the file ends inside the head of a record at offset {offset}"),
            kind => format!(
                "the file is cut off or damaged: the record of kind {kind:#04x} at offset {offset} \
                 declares {} bytes, {left} are left",
                frame.length
            ),
        };
        if !self.ledger.recovers() {
            return Err(DatasetError::corrupt(what));
        }
        if frame.opcode == op::CHUNK {
            self.read_body(frame)?;
            self.records_offset = offset;
            Unpacker::unpack_part(&self.buffer, frame.length, offset, &mut self.records);
            let place = ChunkHead::parse(&self.buffer, offset)
                .map_or_else(|_| "a chunk".to_owned(), |(head, _)| head.place());
            self.ledger.lose(format!(
                "{what}: all but the first {} messages of {place}; these could not be checked",
                self.records.n_messages()
            ));
        } else {
            self.ledger.lose(format!("{what}, and what followed"));
        }
        self.finish();
        Ok(())
    }

    /// Compares the bytes with the checksum of the data section.
    fn check_data(&mut self, frame: &Frame) -> Result<()> {
        let hash = self.frames.take_hash();
        self.read_body(frame)?;
        let crc = Body::new(&self.buffer, "data-end record", frame.offset).u32();
        let crc = self.ledger.survive(crc)?.unwrap_or_default();
        match hash {
            // A part that was lost explains it.
            Some(found) if crc != 0 && found != crc && !self.ledger.has_losses() => {
                let damage =
                    DatasetError::corrupt(format!("the data section {}", bad_crc(crc, found)));
                self.ledger.survive::<()>(Err(damage)).map(|_| ())
            }
            _ => Ok(()),
        }
    }
}

/// The head of a message record and where its data is; `start` is where the record's bytes start.
fn parse_message(bytes: &[u8], offset: u64, start: usize) -> Result<(u16, Found)> {
    let mut body = Body::new(bytes, "message in or", offset);
    let channel = body.u16()?;
    let sequence = body.u32()?;
    let (log_time, publish_time) = (body.u64()?, body.u64()?);
    let found = Found {
        place: 0,
        sequence,
        log_time,
        publish_time,
        in_chunk: false,
        data: start + bytes.len() - body.rest().len()..start + bytes.len(),
    };
    Ok((channel, found))
}

/// Chunks of which the index says that none of the topics is in them. None if the index is not complete.
fn unwanted_chunks(summary: &super::Summary, topics: &BTreeSet<String>) -> BTreeMap<u64, u64> {
    let is_unwanted = |id: &u16| {
        let place = summary.channels.binary_search_by_key(id, |c| c.id);
        let channel = place.ok().and_then(|place| summary.channels.get(place));
        channel.is_some_and(|channel| !topics.contains(&channel.topic))
    };
    let unwanted = summary
        .chunks
        .iter()
        .filter(|chunk| !chunk.channels.is_empty() && chunk.channels.iter().all(is_unwanted));
    unwanted.map(|chunk| (chunk.offset, chunk.length)).collect()
}
