//! One IPC file.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::Arc;

use arrow::array::RecordBatch;
use arrow::buffer::Buffer;
use arrow::datatypes::SchemaRef;
use arrow::ipc::convert::fb_to_schema;
use arrow::ipc::reader::FileDecoder;
use arrow::ipc::{Block, MetadataVersion, root_as_footer, root_as_message};

use super::check::{check_batch, check_schema};
use crate::error::{DatasetError, Result};
use crate::guard;

const MAGIC: &[u8; 6] = b"ARROW1";
/// The magic and its padding at the start of a file.
const HEAD: u64 = 8;
/// Length of the footer and the magic at the end.
const TAIL: u64 = 10;
/// Marks a message whose length follows; older writers leave it out.
const CONTINUATION: [u8; 4] = [0xFF; 4];

/// An open IPC file ("Feather version 2") of uncompressed record batches.
pub(crate) struct IpcFile {
    file: File,
    schema: SchemaRef,
    version: MetadataVersion,
    blocks: Vec<Block>,
    /// Rows of each block.
    n_rows: Vec<u64>,
}

impl IpcFile {
    /// Opens a file: reads the footer and the head of every record batch.
    ///
    /// # Errors
    /// The file is cut off or damaged, or has types or packing that are not read.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let mut file = File::open(path).map_err(|e| DatasetError::io("open", e))?;
        let size = file
            .metadata()
            .map_err(|e| DatasetError::io("open", e))?
            .len();
        let footer = footer_bytes(&mut file, size)?;
        let footer = root_as_footer(&footer)
            .map_err(|e| DatasetError::corrupt(format!("the Arrow footer is damaged: {e}")))?;
        let schema = footer
            .schema()
            .ok_or_else(|| DatasetError::corrupt("the Arrow footer has no schema"))?;
        check_schema(schema)?;
        if footer
            .dictionaries()
            .is_some_and(|blocks| !blocks.is_empty())
        {
            return Err(DatasetError::Unsupported {
                what: "an Arrow file with dictionaries".to_owned(),
            });
        }
        let mut ipc = Self {
            file,
            schema: guard::decode(|| Ok(Arc::new(fb_to_schema(schema))))?,
            version: footer.version(),
            blocks: footer.recordBatches().iter().flatten().copied().collect(),
            n_rows: Vec::new(),
        };
        for place in 0..ipc.blocks.len() {
            let n_rows = ipc.check_block(place, size)?;
            ipc.n_rows.push(n_rows);
        }
        Ok(ipc)
    }

    pub(crate) fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    pub(crate) fn n_batches(&self) -> usize {
        self.blocks.len()
    }

    /// Rows of all record batches.
    pub(crate) fn n_rows(&self) -> u64 {
        self.n_rows.iter().fold(0, |sum, n| sum.saturating_add(*n))
    }

    /// Reads one record batch, only the columns whose places are in `columns`.
    ///
    /// # Errors
    /// The bytes are no such batch.
    pub(crate) fn read(&mut self, place: usize, columns: &[usize]) -> Result<RecordBatch> {
        let block = *self.block(place)?;
        let length = block_parts(&block).map(|(_, metadata, body)| metadata + body);
        let bytes = self.bytes(&block, length)?;
        guard::decode(|| {
            FileDecoder::new(Arc::clone(&self.schema), self.version)
                .with_projection(columns.to_vec())
                .read_record_batch(&block, &Buffer::from(bytes))
                .map_err(DatasetError::arrow("read a record batch"))?
                .ok_or_else(|| DatasetError::corrupt("a record batch is missing"))
        })
    }

    fn block(&self, place: usize) -> Result<&Block> {
        self.blocks
            .get(place)
            .ok_or_else(|| DatasetError::corrupt("a record batch vanished"))
    }

    fn bytes(&mut self, block: &Block, length: Option<u64>) -> Result<Vec<u8>> {
        let length = length.and_then(|length| usize::try_from(length).ok());
        let start = u64::try_from(block.offset()).ok();
        let (Some(length), Some(start)) = (length, start) else {
            return Err(DatasetError::corrupt(
                "a record batch lies outside the file",
            ));
        };
        read_at(&mut self.file, start, length)
    }

    /// Checks place and contents of a block and returns its number of rows.
    fn check_block(&mut self, place: usize, size: u64) -> Result<u64> {
        let block = *self.block(place)?;
        let outside = || {
            DatasetError::corrupt(format!(
                "record batch {place} lies outside the file ({size} bytes)"
            ))
        };
        let (start, metadata, body) = block_parts(&block).ok_or_else(outside)?;
        let end = start
            .checked_add(metadata)
            .and_then(|end| end.checked_add(body));
        if start < HEAD || metadata < HEAD || end.is_none_or(|end| end > size.saturating_sub(TAIL))
        {
            return Err(outside());
        }
        let head = self.bytes(&block, Some(metadata))?;
        let damaged =
            || DatasetError::corrupt(format!("the head of record batch {place} is damaged"));
        let message = if head.starts_with(&CONTINUATION) {
            8
        } else {
            4
        };
        let message = root_as_message(&head[message..]).map_err(|_| damaged())?;
        let batch = message.header_as_record_batch().ok_or_else(damaged)?;
        check_batch(batch, self.schema.fields(), body)?;
        u64::try_from(batch.length()).map_err(|_| damaged())
    }
}

/// Start, and lengths of head and body.
fn block_parts(block: &Block) -> Option<(u64, u64, u64)> {
    Some((
        u64::try_from(block.offset()).ok()?,
        u64::try_from(block.metaDataLength()).ok()?,
        u64::try_from(block.bodyLength()).ok()?,
    ))
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
    if !read_at(file, 0, MAGIC.len())?.starts_with(MAGIC) {
        return Err(DatasetError::corrupt(
            "no Arrow file: it does not start with ARROW1",
        ));
    }
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
fn read_at(file: &mut File, start: u64, length: usize) -> Result<Vec<u8>> {
    let mut bytes = vec![0; length];
    file.seek(SeekFrom::Start(start))
        .and_then(|_| file.read_exact(&mut bytes))
        .map_err(|e| DatasetError::io("read", e))?;
    Ok(bytes)
}
