//! The container: records, chunks and summary of an MCAP file, each checked before it is used.

mod attachment;
mod body;
mod chunk;
mod frames;
mod ledger;
mod messages;
mod registry;
mod summary;
#[cfg(test)]
mod tests;
mod types;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ::mcap::records::op;

use crate::error::{DatasetError, Result};
use crate::source::Warning;
use body::Body;
use frames::{Frame, Frames, MAGIC, Step};
use summary::frame_at;

pub use messages::Messages;
pub use types::{
    AttachmentEntry, Channel, ChunkEntry, Message, MessageSchema, Metadata, Statistics, Summary,
};

/// One MCAP file, open for reading.
///
/// Opening reads the header and, where there is one, the summary. Messages are read by [`Self::messages`], as
/// often as wanted; each pass has its own file handle. Errors hold the path.
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    recover: bool,
    profile: String,
    library: String,
    summary: Option<Summary>,
    /// CRC of the data section; 0 if not noted.
    data_crc: u32,
    warnings: Vec<Warning>,
}

impl Recording {
    /// Opens a file.
    ///
    /// With `recover`, what is damaged is left out, here and in every pass over the messages, and each loss is
    /// a [`Warning::Lost`]. Without, damage is an error, before any message of the damaged part is given out.
    /// A file that ends after a whole record but without a footer (its writer crashed) is read with a warning
    /// either way; a file with a footer but no summary is fine.
    ///
    /// # Errors
    /// Not MCAP, a damaged header or summary, or the system refuses.
    pub fn open(path: &Path, recover: bool) -> Result<Self> {
        Self::open_file(path, recover).map_err(|error| error.in_file(path))
    }

    fn open_file(path: &Path, recover: bool) -> Result<Self> {
        let mut frames = Frames::open(path)?;
        let (profile, library) = read_header(&mut frames)?;
        let data_start = frames.length() - frames.left();
        let mut warnings = Vec::new();
        let tail = match summary::read_tail(&mut frames, data_start) {
            Err(DatasetError::Corrupt { what }) if recover => {
                warnings.push(Warning::Lost {
                    what: format!("the summary: {what}"),
                });
                summary::Tail::default()
            }
            tail => {
                let tail = tail?;
                if !tail.closed {
                    warnings.push(Warning::Lost {
                        what:
                            "the file was not closed (it has no footer): what its writer still held"
                                .to_owned(),
                    });
                }
                tail
            }
        };
        Ok(Self {
            path: path.to_owned(),
            recover,
            profile,
            library,
            summary: tail.summary,
            data_crc: tail.data_crc,
            warnings,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What the messages are, as the header says: `ros1`, `ros2` or nothing, mostly.
    pub fn profile(&self) -> &str {
        &self.profile
    }

    /// The program that wrote the file.
    pub fn library(&self) -> &str {
        &self.library
    }

    /// Whether damaged parts are left out.
    pub fn recovers(&self) -> bool {
        self.recover
    }

    /// The summary, if the file has one.
    pub fn summary(&self) -> Option<&Summary> {
        self.summary.as_ref()
    }

    /// What was odd about the file when it was opened: no footer, or (recovering) a damaged summary.
    pub fn warnings(&self) -> &[Warning] {
        &self.warnings
    }

    /// All channels, by id: from the summary if it has them, else from a pass over the whole file.
    ///
    /// # Errors
    /// Those of [`Messages::next`].
    pub fn channels(&self) -> Result<Vec<Arc<Channel>>> {
        if let Some(summary) = &self.summary
            && let Some(statistics) = &summary.statistics
            && usize::try_from(statistics.channel_count) == Ok(summary.channels.len())
        {
            return Ok(summary.channels.clone());
        }
        let mut messages = self.messages(&MessageOptions::default())?;
        while messages.next()?.is_some() {}
        Ok(messages.channels().to_vec())
    }

    /// All metadata records, in file order. Chunks are not read.
    ///
    /// # Errors
    /// A damaged record, or a file cut short (if not recovering).
    pub fn metadata(&self) -> Result<Vec<Metadata>> {
        self.metadata_in_file()
            .map_err(|error| error.in_file(&self.path))
    }

    fn metadata_in_file(&self) -> Result<Vec<Metadata>> {
        let offsets = self.indexed(|summary, statistics| {
            let offsets: Vec<u64> = summary.metadata.iter().map(|(_, offset)| *offset).collect();
            (offsets, statistics.metadata_count)
        });
        let mut buffer = Vec::new();
        self.collect(op::METADATA, offsets, |frames, frame| {
            frames.body(frame, u64::MAX, &mut buffer)?;
            attachment::metadata(&buffer, frame.offset)
        })
    }

    /// All attachments, in file order, without their data. Chunks are not read.
    ///
    /// # Errors
    /// A damaged record, or a file cut short (if not recovering).
    pub fn attachments(&self) -> Result<Vec<AttachmentEntry>> {
        self.attachments_in_file()
            .map_err(|error| error.in_file(&self.path))
    }

    fn attachments_in_file(&self) -> Result<Vec<AttachmentEntry>> {
        let offsets = self.indexed(|summary, statistics| {
            let offsets = summary.attachments.iter().map(|entry| entry.offset);
            (offsets.collect(), statistics.attachment_count)
        });
        let mut buffer = Vec::new();
        self.collect(op::ATTACHMENT, offsets, |frames, frame| {
            attachment::entry(frames, frame, &mut buffer)
        })
    }

    /// The offsets that an index lists, if it is as long as the statistics say.
    fn indexed(
        &self,
        index: impl Fn(&Summary, &Statistics) -> (Vec<u64>, u32),
    ) -> Option<Vec<u64>> {
        let summary = self.summary.as_ref()?;
        let (offsets, n) = index(summary, summary.statistics.as_ref()?);
        (usize::try_from(n) == Ok(offsets.len())).then_some(offsets)
    }

    /// Reads the records of one kind: those at `offsets`, or else all in the file.
    fn collect<T>(
        &self,
        opcode: u8,
        offsets: Option<Vec<u64>>,
        mut read: impl FnMut(&mut Frames, &Frame) -> Result<T>,
    ) -> Result<Vec<T>> {
        let mut frames = Frames::open(&self.path)?;
        let mut found = Vec::new();
        let mut take = |frames: &mut Frames, frame: &Frame| match read(frames, frame) {
            Ok(item) => {
                found.push(item);
                Ok(())
            }
            Err(DatasetError::Corrupt { .. }) if self.recover => Ok(()),
            Err(error) => Err(error),
        };
        let Some(offsets) = offsets else {
            frames.seek(MAGIC.len() as u64)?;
            self.walk(&mut frames, |frames, frame| {
                if frame.opcode == opcode {
                    take(frames, frame)?;
                }
                Ok(())
            })?;
            return Ok(found);
        };
        for offset in offsets {
            match frame_at(&mut frames, offset) {
                Ok(frame) if frame.opcode == opcode => take(&mut frames, &frame)?,
                Ok(_) | Err(DatasetError::Corrupt { .. }) if self.recover => {}
                Ok(frame) => {
                    return Err(DatasetError::corrupt(format!(
                        "the index names the record at offset {offset} as of kind {opcode:#04x}, it is {:#04x}",
                        frame.opcode
                    )));
                }
                Err(error) => return Err(error),
            }
        }
        Ok(found)
    }

    /// Shows all records up to the end of the data.
    fn walk(
        &self,
        frames: &mut Frames,
        mut visit: impl FnMut(&mut Frames, &Frame) -> Result<()>,
    ) -> Result<()> {
        loop {
            match frames.step()? {
                Step::Record(frame) if matches!(frame.opcode, op::DATA_END | op::FOOTER) => {
                    return Ok(());
                }
                Step::Record(frame) => {
                    visit(frames, &frame)?;
                    frames.skip(&frame)?;
                }
                Step::Cut(frame) if !self.recover => {
                    return Err(DatasetError::corrupt(format!(
                        "the file ends inside the record at offset {}",
                        frame.offset
                    )));
                }
                Step::End | Step::Cut(_) => return Ok(()),
            }
        }
    }

    /// The bytes of an attachment, checked by its CRC. Names of attachments are not to be trusted as paths.
    ///
    /// Memory: the attachment.
    ///
    /// # Errors
    /// A damaged record, or the system refuses.
    pub fn attachment_data(&self, entry: &AttachmentEntry) -> Result<Vec<u8>> {
        let read = || {
            let mut frames = Frames::open(&self.path)?;
            let frame = frame_at(&mut frames, entry.offset)?;
            let mut buffer = Vec::new();
            frames.body(&frame, u64::MAX, &mut buffer)?;
            attachment::data(buffer, entry.offset)
        };
        read().map_err(|error| error.in_file(&self.path))
    }

    /// Starts a pass over the messages, in file order (which need not be the order of any clock).
    ///
    /// # Errors
    /// The file cannot be opened again.
    pub fn messages(&self, options: &MessageOptions) -> Result<Messages> {
        Messages::open(self, options).map_err(|error| error.in_file(&self.path))
    }
}

/// Profile and library.
fn read_header(frames: &mut Frames) -> Result<(String, String)> {
    let mut buffer = Vec::new();
    let magic = Frame {
        opcode: 0,
        offset: 0,
        length: MAGIC.len() as u64,
    };
    frames.body(&magic, magic.length, &mut buffer)?;
    if buffer.is_empty() {
        return Err(DatasetError::corrupt("the file is empty (0 bytes)"));
    }
    if buffer != MAGIC {
        return Err(DatasetError::corrupt(format!(
            "the file starts with \"{}\", not with the magic of MCAP",
            buffer.escape_ascii()
        )));
    }
    match frames.step()? {
        Step::Record(frame) if frame.opcode == op::HEADER => {
            frames.body(&frame, u64::MAX, &mut buffer)?;
            let mut body = Body::new(&buffer, "header", frame.offset);
            Ok((body.text()?, body.text()?))
        }
        _ => Err(DatasetError::corrupt("no whole header at offset 8")),
    }
}

/// Which messages to read.
#[derive(Debug, Clone, Default)]
pub struct MessageOptions {
    /// Topics to read; `None` reads all. Chunks without them are not touched where an index says so.
    pub topics: Option<BTreeSet<String>>,
}
