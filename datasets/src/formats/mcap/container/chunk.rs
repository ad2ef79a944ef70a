//! Unpacking chunks.

use mcap::McapError;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::body::Body;
use super::frames::RECORD_HEAD;
use super::op;
use crate::error::{DatasetError, Result};

/// No larger chunk is read, whatever it declares: 1 GiB of records.
pub(super) const MAX_CHUNK: u64 = 1 << 30;
/// Up to this size (64 MiB) the room a chunk declares is made at once; beyond, memory grows with what really
/// comes out of the decompressor.
const BELIEVED: u64 = 64 << 20;

/// The front of a chunk record.
#[derive(Debug, Clone)]
pub(super) struct ChunkHead {
    pub(super) offset: u64,
    pub(super) start_time: u64,
    pub(super) end_time: u64,
    uncompressed_size: u64,
    crc: u32,
    compression: String,
    compressed_size: u64,
}

impl ChunkHead {
    /// Reads the head from a chunk's body; gives the rest of the body.
    pub(super) fn parse(bytes: &[u8], offset: u64) -> Result<(Self, &[u8])> {
        let mut body = Body::new(bytes, "chunk", offset);
        let head = Self {
            offset,
            start_time: body.u64()?,
            end_time: body.u64()?,
            uncompressed_size: body.u64()?,
            crc: body.u32()?,
            compression: body.text()?,
            compressed_size: body.u64()?,
        };
        Ok((head, body.rest()))
    }

    /// Where it is, for messages.
    pub(super) fn place(&self) -> String {
        format!(
            "the chunk at offset {} (log times {} to {} ns)",
            self.offset, self.start_time, self.end_time
        )
    }

    fn error(&self, reason: &str) -> DatasetError {
        DatasetError::corrupt(format!("{} {reason}", self.place()))
    }
}

/// The records of a chunk.
#[derive(Debug, Default)]
pub(super) struct Records {
    bytes: Vec<u8>,
    /// Opcode and end in `bytes` of each record.
    ends: Vec<(u8, usize)>,
    next: usize,
}

impl Records {
    pub(super) fn clear(&mut self) {
        self.bytes.clear();
        self.ends.clear();
        self.next = 0;
    }

    fn push(&mut self, opcode: u8, data: &[u8]) {
        self.bytes.extend_from_slice(data);
        self.ends.push((opcode, self.bytes.len()));
    }

    /// Opcode of the next record and where its bytes are.
    pub(super) fn pop(&mut self) -> Option<(u8, std::ops::Range<usize>)> {
        let &(opcode, end) = self.ends.get(self.next)?;
        let start = match self.next.checked_sub(1) {
            Some(before) => self.ends.get(before)?.1,
            None => 0,
        };
        self.next += 1;
        Some((opcode, start..end))
    }

    pub(super) fn slice(&self, range: std::ops::Range<usize>) -> &[u8] {
        self.bytes.get(range).unwrap_or_default()
    }

    pub(super) fn n_messages(&self) -> usize {
        let messages = self
            .ends
            .iter()
            .filter(|(opcode, _)| *opcode == op::MESSAGE);
        messages.count()
    }
}

/// Unpacks chunks one after another, with the same buffers.
#[derive(Default)]
pub(super) struct Unpacker {
    /// Whether the reader checks the CRC first, and the reader, which stands between two chunks.
    reader: Option<(bool, LinearReader)>,
}

impl std::fmt::Debug for Unpacker {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Unpacker").finish_non_exhaustive()
    }
}

impl Unpacker {
    /// Unpacks a whole chunk from its body. `records` holds nothing after an error.
    pub(super) fn unpack(
        &mut self,
        bytes: &[u8],
        offset: u64,
        records: &mut Records,
    ) -> Result<()> {
        records.clear();
        let done = self.unpack_checked(bytes, offset, records);
        if done.is_err() {
            records.clear();
            self.reader = None;
        }
        done
    }

    fn unpack_checked(&mut self, bytes: &[u8], offset: u64, records: &mut Records) -> Result<()> {
        let (head, rest) = ChunkHead::parse(bytes, offset)?;
        let n = usize::try_from(head.compressed_size).unwrap_or(usize::MAX);
        let Some(data) = rest.get(..n) else {
            return Err(head.error(&format!(
                "declares {} bytes of data but has {}",
                head.compressed_size,
                rest.len()
            )));
        };
        if head.uncompressed_size > MAX_CHUNK {
            return Err(head.error(&format!(
                "declares {} bytes of records, more than the {MAX_CHUNK} that are read",
                head.uncompressed_size
            )));
        }
        if head.compression.is_empty() {
            check_crc(&head, data)?;
            split(data, records).map_err(|reason| head.error(&reason))?;
        } else {
            self.decompress(&head, bytes, records)?;
        }
        let framing = records.ends.len() as u64 * RECORD_HEAD;
        let found = records.bytes.len() as u64 + framing;
        if found != head.uncompressed_size {
            return Err(head.error(&format!(
                "declares {} bytes of records but holds {found}",
                head.uncompressed_size
            )));
        }
        Ok(())
    }

    fn decompress(&mut self, head: &ChunkHead, bytes: &[u8], records: &mut Records) -> Result<()> {
        let believed = head.uncompressed_size <= BELIEVED;
        let mut reader = match self.reader.take() {
            Some((checks_first, reader)) if checks_first == believed => reader,
            _ => inner_reader(believed),
        };
        feed(&mut reader, bytes, bytes.len() as u64);
        drain(&mut reader, records).map_err(|error| head.error(&describe(&error)))?;
        self.reader = Some((believed, reader));
        Ok(())
    }

    /// Takes what can be had of a chunk whose end is missing: its whole records. Their CRC cannot be checked.
    /// `length` is what the chunk's record declares.
    pub(super) fn unpack_part(bytes: &[u8], length: u64, offset: u64, records: &mut Records) {
        records.clear();
        let Ok((head, data)) = ChunkHead::parse(bytes, offset) else {
            return;
        };
        // What is wrong with it is known already: it is cut off.
        if head.compression.is_empty() {
            let _ = split(data, records);
        } else {
            let mut reader = inner_reader(false);
            feed(&mut reader, bytes, length);
            let _ = drain(&mut reader, records);
        }
    }
}

fn inner_reader(checks_first: bool) -> LinearReader {
    let mut options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_prevalidate_chunk_crcs(checks_first);
    options.record_length_limit = usize::try_from(MAX_CHUNK).ok();
    LinearReader::new_with_options(options)
}

fn feed(reader: &mut LinearReader, bytes: &[u8], length: u64) {
    let head = [op::CHUNK].into_iter().chain(length.to_le_bytes());
    let n = RECORD_HEAD as usize + bytes.len();
    let room = reader.insert(n);
    for (to, from) in room.iter_mut().zip(head) {
        *to = from;
    }
    if let Some(to) = room.get_mut(RECORD_HEAD as usize..n) {
        to.copy_from_slice(bytes);
    }
    reader.notify_read(n);
}

/// Takes records until the reader wants more bytes than it was given.
fn drain(reader: &mut LinearReader, records: &mut Records) -> std::result::Result<(), McapError> {
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::Record { data, opcode } => {
                records.push(opcode, data);
                if records.bytes.len() as u64 > MAX_CHUNK {
                    return Err(McapError::ChunkTooLarge(records.bytes.len() as u64));
                }
            }
            LinearReadEvent::ReadRequest(_) => break,
        }
    }
    Ok(())
}

/// Cuts plain bytes into records.
fn split(mut data: &[u8], records: &mut Records) -> std::result::Result<(), String> {
    while let Some((head, rest)) = data.split_first_chunk::<{ RECORD_HEAD as usize }>() {
        let [opcode, length @ ..] = *head;
        let length = usize::try_from(u64::from_le_bytes(length)).unwrap_or(usize::MAX);
        let Some((body, rest)) = rest.split_at_checked(length) else {
            return Err(format!(
                "holds a record of {length} bytes where {} are left",
                rest.len()
            ));
        };
        records.push(opcode, body);
        data = rest;
    }
    match data.len() {
        0 => Ok(()),
        n => Err(format!("ends with {n} bytes that are no record")),
    }
}

fn check_crc(head: &ChunkHead, data: &[u8]) -> Result<()> {
    let found = crc32fast::hash(data);
    if head.crc != 0 && head.crc != found {
        return Err(head.error(&bad_crc(head.crc, found)));
    }
    Ok(())
}

/// What a checksum that does not fit is called.
pub(super) fn bad_crc(saved: u32, found: u32) -> String {
    format!("is damaged: its CRC is {found:#010x}, the file says {saved:#010x}")
}

fn describe(error: &McapError) -> String {
    match error {
        McapError::BadChunkCrc { saved, calculated } => bad_crc(*saved, *calculated),
        McapError::UnsupportedCompression(name) => {
            format!("has compression \"{name}\", which is not read")
        }
        other => format!("cannot be unpacked: {other}"),
    }
}
