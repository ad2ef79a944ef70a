//! The end of a file: footer and summary.

use super::body::Body;
use super::chunk::{MAX_CHUNK, bad_crc};
use super::frames::{Frame, Frames, MAGIC, RECORD_HEAD, Step};
use super::op;
use super::registry::Registry;
use super::types::{AttachmentEntry, ChunkEntry, Statistics, Summary};
use crate::error::{DatasetError, Result};

/// Bytes of the footer's body.
const FOOTER: u64 = 20;
/// Bytes of the data-end record.
const DATA_END: u64 = RECORD_HEAD + 4;

/// What the end of a file says.
#[derive(Debug, Default)]
pub(super) struct Tail {
    /// Whether the file has the magic at its end, as a closed file has.
    pub(super) closed: bool,
    pub(super) summary: Option<Summary>,
    /// CRC of all bytes before the data-end record; 0 if not noted.
    pub(super) data_crc: u32,
}

/// Reads the end of a file whose header ends at `data_start`.
pub(super) fn read_tail(frames: &mut Frames, data_start: u64) -> Result<Tail> {
    let mut tail = Tail::default();
    let magic = MAGIC.len() as u64;
    let Some(footer_offset) = frames
        .length()
        .checked_sub(RECORD_HEAD + FOOTER + magic)
        .filter(|&offset| offset >= data_start)
    else {
        return Ok(tail);
    };
    let mut buffer = Vec::new();
    read_at(frames, frames.length() - magic, magic, &mut buffer)?;
    if buffer != MAGIC {
        return Ok(tail);
    }
    tail.closed = true;
    let frame = frame_at(frames, footer_offset)?;
    if frame.opcode != op::FOOTER || frame.length != FOOTER {
        return Err(DatasetError::corrupt(format!(
            "no footer at offset {footer_offset}, before the magic at the end"
        )));
    }
    frames.body(&frame, FOOTER, &mut buffer)?;
    let mut body = Body::new(&buffer, "footer", footer_offset);
    let (start, _offsets, crc) = (body.u64()?, body.u64()?, body.u32()?);
    let data_end = if start == 0 { footer_offset } else { start };
    if data_end < data_start || data_end > footer_offset {
        return Err(body.error(&format!("says that the summary starts at {start}")));
    }
    tail.data_crc = data_crc(frames, data_end, data_start)?;
    if start != 0 {
        check_crc(frames, start, footer_offset, crc)?;
        tail.summary = Some(read_summary(frames, start, footer_offset)?);
    }
    Ok(tail)
}

fn read_at(frames: &mut Frames, offset: u64, n: u64, buffer: &mut Vec<u8>) -> Result<()> {
    let raw = Frame {
        opcode: 0,
        offset,
        length: n,
    };
    frames.seek(offset)?;
    frames.body(&raw, n, buffer)
}

/// The record at an offset that something in the file points at.
pub(super) fn frame_at(frames: &mut Frames, offset: u64) -> Result<Frame> {
    if offset < frames.length() {
        frames.seek(offset)?;
        if let Step::Record(frame) = frames.step()? {
            return Ok(frame);
        }
    }
    Err(DatasetError::corrupt(format!(
        "no whole record at offset {offset}, which the index names"
    )))
}

/// The CRC in the data-end record, which comes right before `end`; 0 if there is none.
fn data_crc(frames: &mut Frames, end: u64, data_start: u64) -> Result<u32> {
    let Some(offset) = end.checked_sub(DATA_END).filter(|&o| o >= data_start) else {
        return Ok(0);
    };
    let frame = frame_at(frames, offset);
    match frame {
        Ok(frame) if frame.opcode == op::DATA_END && frame.length == 4 => {
            let mut buffer = Vec::new();
            frames.body(&frame, 4, &mut buffer)?;
            Body::new(&buffer, "data-end record", offset).u32()
        }
        _ => Ok(0),
    }
}

/// The checksum runs from the summary's start to the checksum's own field in the footer.
fn check_crc(frames: &mut Frames, start: u64, footer_offset: u64, crc: u32) -> Result<()> {
    const BLOCK: u64 = 256 * 1024;
    if crc == 0 {
        return Ok(());
    }
    let end = footer_offset + RECORD_HEAD + FOOTER - 4;
    let mut hasher = crc32fast::Hasher::new();
    let mut buffer = Vec::new();
    let mut position = start;
    while position < end {
        let n = BLOCK.min(end - position);
        read_at(frames, position, n, &mut buffer)?;
        hasher.update(&buffer);
        position += n;
    }
    let found = hasher.finalize();
    if found != crc {
        return Err(DatasetError::corrupt(format!(
            "the summary at offset {start} {}",
            bad_crc(crc, found)
        )));
    }
    Ok(())
}

fn read_summary(frames: &mut Frames, start: u64, end: u64) -> Result<Summary> {
    let mut summary = Summary::default();
    let mut registry = Registry::default();
    let mut buffer = Vec::new();
    frames.seek(start)?;
    loop {
        let frame = match frames.step()? {
            Step::Record(frame) if frame.offset < end => frame,
            Step::Record(_) => break,
            Step::End | Step::Cut(_) => {
                return Err(DatasetError::corrupt(format!(
                    "the summary at offset {start} is not made of records"
                )));
            }
        };
        if frame.length > MAX_CHUNK {
            return Err(DatasetError::corrupt(format!(
                "the summary record at offset {} has {} bytes, more than the {MAX_CHUNK} that are read",
                frame.offset, frame.length
            )));
        }
        frames.body(&frame, u64::MAX, &mut buffer)?;
        add_record(&mut summary, &mut registry, &frame, &buffer)?;
    }
    summary.channels = registry.channels().to_vec();
    summary.schemas = registry.schemas().cloned().collect();
    summary.chunks.sort_by_key(|chunk| chunk.offset);
    summary.attachments.sort_by_key(|entry| entry.offset);
    summary.metadata.sort_by_key(|(_, offset)| *offset);
    Ok(summary)
}

fn add_record(
    summary: &mut Summary,
    registry: &mut Registry,
    frame: &Frame,
    bytes: &[u8],
) -> Result<()> {
    let offset = frame.offset;
    match frame.opcode {
        op::SCHEMA => registry.add_schema(bytes, offset).map(|_| ())?,
        op::CHANNEL => registry.add_channel(bytes, offset).map(|_| ())?,
        op::STATISTICS => summary.statistics = Some(statistics(bytes, offset)?),
        op::CHUNK_INDEX => summary.chunks.push(chunk_entry(bytes, offset)?),
        op::ATTACHMENT_INDEX => summary.attachments.push(attachment_entry(bytes, offset)?),
        op::METADATA_INDEX => {
            let mut body = Body::new(bytes, "metadata index", offset);
            let (at, _length) = (body.u64()?, body.u64()?);
            summary.metadata.push((body.text()?, at));
        }
        // Summary offsets, and records of kinds that are not known.
        _ => {}
    }
    Ok(())
}

fn statistics(bytes: &[u8], offset: u64) -> Result<Statistics> {
    let mut body = Body::new(bytes, "statistics record", offset);
    Ok(Statistics {
        message_count: body.u64()?,
        schema_count: body.u16()?,
        channel_count: body.u32()?,
        attachment_count: body.u32()?,
        metadata_count: body.u32()?,
        chunk_count: body.u32()?,
        message_start_time: body.u64()?,
        message_end_time: body.u64()?,
        channel_message_counts: body.map(|body| Ok((body.u16()?, body.u64()?)))?,
    })
}

fn chunk_entry(bytes: &[u8], offset: u64) -> Result<ChunkEntry> {
    let mut body = Body::new(bytes, "chunk index", offset);
    let (message_start_time, message_end_time) = (body.u64()?, body.u64()?);
    let (chunk_offset, length) = (body.u64()?, body.u64()?);
    let channels = body.map(|body| Ok((body.u16()?, body.u64()?)))?;
    let _index_length = body.u64()?;
    Ok(ChunkEntry {
        offset: chunk_offset,
        length,
        message_start_time,
        message_end_time,
        compression: body.text()?,
        compressed_size: body.u64()?,
        uncompressed_size: body.u64()?,
        channels: channels.into_keys().collect(),
    })
}

fn attachment_entry(bytes: &[u8], offset: u64) -> Result<AttachmentEntry> {
    let mut body = Body::new(bytes, "attachment index", offset);
    let (at, _length) = (body.u64()?, body.u64()?);
    let (log_time, create_time, size) = (body.u64()?, body.u64()?, body.u64()?);
    Ok(AttachmentEntry {
        name: body.text()?,
        media_type: body.text()?,
        log_time,
        create_time,
        size,
        offset: at,
    })
}
