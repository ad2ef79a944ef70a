//! Where the messages of an IPC file lie: by its footer, or one after another if that is lost.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::ipc::convert::fb_to_schema;
use arrow::ipc::{Block, Message, MetadataVersion, root_as_footer, root_as_message};

use super::check::check_schema;
use crate::error::{DatasetError, Result};
use crate::guard;

const MAGIC: &[u8; 6] = b"ARROW1";
/// The magic and its padding at the start of a file.
pub(super) const HEAD: u64 = 8;
/// Where the first message starts, at the latest.
const LARGEST_HEAD: u64 = 64;
/// Length of the footer and the magic at the end.
const TAIL: u64 = 10;
/// Marks a message whose length follows; older writers leave it out.
const CONTINUATION: [u8; 4] = [0xFF; 4];

/// The messages of a file.
pub(super) struct Messages {
    pub(super) schema: SchemaRef,
    pub(super) version: MetadataVersion,
    pub(super) dictionaries: Vec<Block>,
    pub(super) batches: Vec<Block>,
    /// Where the messages end, at the latest.
    pub(super) end: u64,
}

impl Messages {
    /// As the footer has them.
    ///
    /// # Errors
    /// There is no whole footer.
    pub(super) fn of_footer(file: &mut File, size: u64) -> Result<Self> {
        let footer = footer_bytes(file, size)?;
        let footer = root_as_footer(&footer)
            .map_err(|e| DatasetError::corrupt(format!("the Arrow footer is damaged: {e}")))?;
        let schema = footer
            .schema()
            .ok_or_else(|| DatasetError::corrupt("the Arrow footer has no schema"))?;
        check_schema(schema)?;
        Ok(Self {
            schema: guard::decode(|| Ok(Arc::new(fb_to_schema(schema))))?,
            version: footer.version(),
            dictionaries: footer.dictionaries().iter().flatten().copied().collect(),
            batches: footer.recordBatches().iter().flatten().copied().collect(),
            end: size - TAIL,
        })
    }

    /// The whole messages from the start of the file up to the first that is not.
    ///
    /// # Errors
    /// Not even the schema is whole.
    pub(super) fn in_order(file: &mut File, size: u64) -> Result<Self> {
        let no_schema = || {
            DatasetError::corrupt(format!(
                "the Arrow file is cut off in its schema: {size} bytes"
            ))
        };
        check_magic(file, size)?;
        let mut start = HEAD;
        // Some writers pad the magic to more than its 8 bytes.
        while start < LARGEST_HEAD && start + 8 <= size && read_at(file, start, 8)? == [0; 8] {
            start += 8;
        }
        let (head, mut at) = next_message(file, start, size)?.ok_or_else(no_schema)?;
        let message = message(&head).ok_or_else(no_schema)?;
        let schema = message.header_as_schema().ok_or_else(no_schema)?;
        check_schema(schema)?;
        let mut messages = Self {
            schema: guard::decode(|| Ok(Arc::new(fb_to_schema(schema))))?,
            version: message.version(),
            dictionaries: Vec::new(),
            batches: Vec::new(),
            end: at,
        };
        while let Some((head, end)) = next_message(file, at, size)? {
            let Some(block) = block(&head, at, end) else {
                break;
            };
            let Some(message) = self::message(&head) else {
                break;
            };
            if message.header_as_record_batch().is_some() {
                messages.batches.push(block);
            } else if message.header_as_dictionary_batch().is_some() {
                messages.dictionaries.push(block);
            } else {
                break;
            }
            (at, messages.end) = (end, end);
        }
        Ok(messages)
    }
}

/// Head of the message at an offset and the end of its body, or `None` if the file does not hold all of it.
fn next_message(file: &mut File, at: u64, size: u64) -> Result<Option<(Vec<u8>, u64)>> {
    let left = size.saturating_sub(at);
    if left < HEAD {
        return Ok(None);
    }
    let start = read_at(file, at, 8)?;
    let (prefix, length) = match start.split_at(4) {
        (first, second) if first == CONTINUATION => (8, second),
        (first, _) => (4, first),
    };
    let length = length
        .iter()
        .rev()
        .fold(0, |n, &byte| n << 8 | u64::from(byte));
    if length == 0 || length > left - prefix {
        return Ok(None);
    }
    let Ok(head_length) = usize::try_from(prefix + length) else {
        return Ok(None);
    };
    let head = read_at(file, at, head_length)?;
    let Some(message) = message(&head) else {
        return Ok(None);
    };
    let body = u64::try_from(message.bodyLength()).ok();
    let end = body.and_then(|body| (at + prefix + length).checked_add(body));
    Ok(end.filter(|end| *end <= size).map(|end| (head, end)))
}

fn block(head: &[u8], at: u64, end: u64) -> Option<Block> {
    let body = end.checked_sub(at)?.checked_sub(head.len() as u64)?;
    Some(Block::new(
        i64::try_from(at).ok()?,
        i32::try_from(head.len()).ok()?,
        i64::try_from(body).ok()?,
    ))
}

/// The message in the head of a block.
pub(super) fn message(head: &[u8]) -> Option<Message<'_>> {
    let prefix = if head.starts_with(&CONTINUATION) {
        8
    } else {
        4
    };
    root_as_message(head.get(prefix..)?).ok()
}

/// Start, and lengths of head and body.
pub(super) fn block_parts(block: &Block) -> Option<(u64, u64, u64)> {
    Some((
        u64::try_from(block.offset()).ok()?,
        u64::try_from(block.metaDataLength()).ok()?,
        u64::try_from(block.bodyLength()).ok()?,
    ))
}

fn check_magic(file: &mut File, size: u64) -> Result<()> {
    if size < HEAD || !read_at(file, 0, MAGIC.len())?.starts_with(MAGIC) {
        return Err(DatasetError::corrupt(
            "no Arrow file: it does not start with ARROW1",
        ));
    }
    Ok(())
}

fn footer_bytes(file: &mut File, size: u64) -> Result<Vec<u8>> {
    let no_footer = || {
        DatasetError::corrupt(format!(
            "the Arrow file is cut off: {size} bytes without a footer at the end"
        ))
    };
    if size < HEAD + TAIL {
        return Err(no_footer());
    }
    check_magic(file, size)?;
    let tail = read_at(file, size - TAIL, 10)?;
    let (length, magic) = tail.split_at(4);
    if magic != MAGIC {
        return Err(no_footer());
    }
    let length = length
        .iter()
        .rev()
        .fold(0, |n, &byte| n << 8 | u64::from(byte));
    if length > size - TAIL - HEAD {
        return Err(no_footer());
    }
    let bytes = usize::try_from(length).map_err(|_| no_footer())?;
    read_at(file, size - TAIL - length, bytes)
}

/// `length` bytes, which the caller knows to be in the file.
pub(super) fn read_at(file: &mut File, start: u64, length: usize) -> Result<Vec<u8>> {
    let mut bytes = vec![0; length];
    read_into(file, start, &mut bytes)?;
    Ok(bytes)
}

/// As [`read_at`], to a place that is there already.
pub(super) fn read_into(file: &mut File, start: u64, bytes: &mut [u8]) -> Result<()> {
    file.seek(SeekFrom::Start(start))
        .and_then(|_| file.read_exact(bytes))
        .map_err(|e| DatasetError::io("read", e))
}
