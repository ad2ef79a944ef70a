//! The container: records, chunks and summary of an MCAP file, each checked before it is used.

mod types;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::error::{DatasetError, Result};
use crate::source::Warning;

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
        let _ = recover;
        Err(unsupported().in_file(path))
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
        Err(unsupported())
    }

    /// All metadata records, in file order. Chunks are not read.
    ///
    /// # Errors
    /// A damaged record, or a file cut short (if not recovering).
    pub fn metadata(&self) -> Result<Vec<Metadata>> {
        Err(unsupported())
    }

    /// All attachments, in file order, without their data. Chunks are not read.
    ///
    /// # Errors
    /// A damaged record, or a file cut short (if not recovering).
    pub fn attachments(&self) -> Result<Vec<AttachmentEntry>> {
        Err(unsupported())
    }

    /// The bytes of an attachment, checked by its CRC. Names of attachments are not to be trusted as paths.
    ///
    /// # Errors
    /// A damaged record, or the system refuses.
    pub fn attachment_data(&self, _entry: &AttachmentEntry) -> Result<Vec<u8>> {
        Err(unsupported())
    }

    /// Starts a pass over the messages, in file order (which need not be the order of any clock).
    ///
    /// # Errors
    /// The file cannot be opened again.
    pub fn messages(&self, _options: &MessageOptions) -> Result<Messages> {
        Err(unsupported())
    }
}

fn unsupported() -> DatasetError {
    DatasetError::Unsupported {
        what: "MCAP".to_owned(),
    }
}

/// Which messages to read.
#[derive(Debug, Clone, Default)]
pub struct MessageOptions {
    /// Topics to read; `None` reads all. Chunks without them are not touched where an index says so.
    pub topics: Option<BTreeSet<String>>,
}

/// A pass over the messages of a [`Recording`].
///
/// Memory: one chunk, compressed and not. A chunk is checked whole (its CRC, and that it is records from end
/// to end) before the first of its messages is given out.
#[derive(Debug)]
pub struct Messages {
    channels: Vec<Arc<Channel>>,
    warnings: Vec<Warning>,
    metadata: Vec<Metadata>,
    attachments: Vec<AttachmentEntry>,
}

impl Messages {
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
        Err(unsupported())
    }

    /// What is odd so far; all of it once [`Self::next`] gave `None`. Losses (`Warning::Lost`, recovering
    /// only), and counts of the summary that differ from what was read (`Warning::CountMismatch`).
    pub fn warnings(&self) -> &[Warning] {
        &self.warnings
    }

    /// Channels announced so far, by id.
    pub fn channels(&self) -> &[Arc<Channel>] {
        &self.channels
    }

    /// Metadata records met so far.
    pub fn metadata(&self) -> &[Metadata] {
        &self.metadata
    }

    /// Attachments met so far.
    pub fn attachments(&self) -> &[AttachmentEntry] {
        &self.attachments
    }
}
