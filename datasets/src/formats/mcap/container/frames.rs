//! Walking the records of a file.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use crc32fast::Hasher;

use crate::error::{DatasetError, Result};

/// What a file starts and ends with.
pub(super) const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Opcode and length before each record.
pub(super) const RECORD_HEAD: u64 = 9;
/// Bytes read at a time.
const BUFFER: usize = 256 * 1024;

/// Where a record is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Frame {
    pub(super) opcode: u8,
    /// Of its first byte in the file.
    pub(super) offset: u64,
    /// Of its body.
    pub(super) length: u64,
}

/// What comes next in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    Record(Frame),
    /// The file ends between two records.
    End,
    /// The file ends inside this record: its opcode (0 if that is missing) and declared length.
    Cut(Frame),
}

/// The records of a file, one after another. No declared length beyond the end of the file is believed.
#[derive(Debug)]
pub(super) struct Frames {
    file: BufReader<File>,
    /// Of the file.
    length: u64,
    /// Where the next record starts, or the body of the current one.
    position: u64,
    /// Of all bytes up to `position`, if they are to be checked.
    hasher: Option<Hasher>,
}

impl Frames {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(|e| DatasetError::io("open", e))?;
        let length = file
            .metadata()
            .map_err(|e| DatasetError::io("open", e))?
            .len();
        Ok(Self {
            file: BufReader::with_capacity(BUFFER, file),
            length,
            position: 0,
            hasher: None,
        })
    }

    pub(super) fn length(&self) -> u64 {
        self.length
    }

    pub(super) fn seek(&mut self, position: u64) -> Result<()> {
        let by = i64::try_from(i128::from(position) - i128::from(self.position))
            .map_err(|_| DatasetError::corrupt(format!("offset {position} is out of range")))?;
        self.file
            .seek_relative(by)
            .map_err(|e| DatasetError::io("seek", e))?;
        self.position = position;
        Ok(())
    }

    /// Goes back to the start and checks the bytes from there.
    pub(super) fn hash_from_start(&mut self) -> Result<()> {
        self.file
            .seek(SeekFrom::Start(0))
            .map_err(|e| DatasetError::io("seek", e))?;
        self.position = 0;
        self.hasher = Some(Hasher::new());
        let mut magic = [0; MAGIC.len()];
        self.read(&mut magic)
    }

    /// CRC of all bytes up to the record given out last, if every byte was read.
    pub(super) fn take_hash(&mut self) -> Option<u32> {
        self.hasher.take().map(Hasher::finalize)
    }

    fn read(&mut self, buffer: &mut [u8]) -> Result<()> {
        self.file
            .read_exact(buffer)
            .map_err(|e| DatasetError::io("read", e))?;
        self.position += buffer.len() as u64;
        if let Some(hasher) = &mut self.hasher {
            hasher.update(buffer);
        }
        Ok(())
    }

    /// Bytes up to the end of the file.
    pub(super) fn left(&self) -> u64 {
        self.length.saturating_sub(self.position)
    }

    /// The next record; then [`Self::body`] or [`Self::skip`] must follow. The head of the data-end record does
    /// not count for the hash.
    pub(super) fn step(&mut self) -> Result<Step> {
        let offset = self.position;
        let left = self.left();
        let mut frame = Frame {
            opcode: 0,
            offset,
            length: 0,
        };
        if left == 0 {
            return Ok(Step::End);
        }
        if left < RECORD_HEAD {
            return Ok(Step::Cut(frame));
        }
        let hasher = self.hasher.clone();
        let mut head = [0; RECORD_HEAD as usize];
        self.read(&mut head)?;
        let [opcode, length @ ..] = head;
        frame.opcode = opcode;
        frame.length = u64::from_le_bytes(length);
        if opcode == super::op::DATA_END {
            self.hasher = hasher;
        }
        Ok(if frame.length > self.left() {
            Step::Cut(frame)
        } else {
            Step::Record(frame)
        })
    }

    /// Reads the body, or the first `at_most` bytes of it, which is no more than the file has.
    pub(super) fn body(&mut self, frame: &Frame, at_most: u64, buffer: &mut Vec<u8>) -> Result<()> {
        let n = frame.length.min(at_most).min(self.left());
        let n = usize::try_from(n)
            .map_err(|_| DatasetError::corrupt("a record does not fit into memory"))?;
        buffer.clear();
        buffer.resize(n, 0);
        self.read(buffer)
    }

    /// Goes on behind the record, wherever in it the reading stands.
    pub(super) fn skip(&mut self, frame: &Frame) -> Result<()> {
        let end = frame
            .offset
            .saturating_add(RECORD_HEAD)
            .saturating_add(frame.length);
        if self.hasher.is_none() {
            return self.seek(end);
        }
        let mut block = vec![0; BUFFER.min(usize::try_from(end - self.position).unwrap_or(BUFFER))];
        while self.position < end {
            let n =
                usize::try_from(end - self.position).map_or(block.len(), |n| n.min(block.len()));
            let (part, _) = block.split_at_mut(n);
            self.read(part)?;
        }
        Ok(())
    }

    /// Gives up on checking the bytes: some are passed over.
    pub(super) fn stop_hashing(&mut self) {
        self.hasher = None;
    }
}
