//! Attachments and metadata records.

use super::body::Body;
use super::chunk::bad_crc;
use super::frames::{Frame, Frames};
use super::types::{AttachmentEntry, Metadata};
use crate::error::Result;

/// Bytes in which the names of an attachment must be found.
const HEAD: u64 = 64 * 1024;

pub(super) fn metadata(bytes: &[u8], offset: u64) -> Result<Metadata> {
    let mut body = Body::new(bytes, "metadata record", offset);
    Ok(Metadata {
        name: body.text()?,
        entries: body.text_map()?,
    })
}

/// Reads the front of an attachment record.
pub(super) fn entry(
    frames: &mut Frames,
    frame: &Frame,
    buffer: &mut Vec<u8>,
) -> Result<AttachmentEntry> {
    frames.body(frame, HEAD, buffer)?;
    let (entry, start) = parse(buffer, frame.offset)?;
    let whole = (start as u64)
        .checked_add(entry.size)
        .and_then(|n| n.checked_add(4));
    if whole != Some(frame.length) {
        let body = Body::new(buffer, "attachment", frame.offset);
        return Err(body.error(&format!(
            "declares {} bytes of data in a record of {} bytes",
            entry.size, frame.length
        )));
    }
    Ok(entry)
}

/// The front of an attachment record and where its data starts.
fn parse(bytes: &[u8], offset: u64) -> Result<(AttachmentEntry, usize)> {
    let mut body = Body::new(bytes, "attachment", offset);
    let (log_time, create_time) = (body.u64()?, body.u64()?);
    let entry = AttachmentEntry {
        name: body.text()?,
        media_type: body.text()?,
        log_time,
        create_time,
        size: body.u64()?,
        offset,
    };
    Ok((entry, bytes.len() - body.rest().len()))
}

/// Takes the data out of a whole attachment record.
pub(super) fn data(mut record: Vec<u8>, offset: u64) -> Result<Vec<u8>> {
    let (entry, start) = parse(&record, offset)?;
    let mut rest = Body::new(&record, "attachment", offset);
    let n = usize::try_from(entry.size).unwrap_or(usize::MAX);
    let summed = rest.bytes(start.saturating_add(n))?;
    let found = crc32fast::hash(summed);
    let crc = rest.u32()?;
    if crc != 0 && crc != found {
        return Err(rest.error(&bad_crc(crc, found)));
    }
    record.truncate(start + n);
    record.drain(..start);
    Ok(record)
}
