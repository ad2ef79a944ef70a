//! One message after the other out of a stream that nobody vouches for.
//!
//! Arrow's own reader takes the length of a message as it stands, so that four bytes of printed text would be a
//! gigabyte to wait for. Here every length is looked at first, and what is no message is shown.

use std::io::{BufReader, Cursor, Read};

use arrow::array::RecordBatch;
use arrow::datatypes::SchemaRef;
use arrow::ipc::reader::StreamReader;
use arrow::ipc::{MessageHeader, root_as_message};

use super::error::ProcessErrorKind;

/// What every message begins with.
const CONTINUATION: [u8; 4] = [0xff; 4];
/// Continuation marker and a length of 0.
const END: [u8; 8] = [0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0];
/// Most bytes of a message's metadata, and of its data.
const MAX_METADATA: u64 = 1 << 20;
const MAX_DATA: u64 = 1 << 30;
/// Bytes of garbage that are shown.
const SHOWN: usize = 60;

/// Why there is no message.
#[derive(Debug)]
pub(super) enum FrameError {
    /// The stream is over, between two messages.
    Ended,
    /// The stream is over, in the middle of one.
    Cut,
    /// Everything else.
    Kind(ProcessErrorKind),
}

impl From<ProcessErrorKind> for FrameError {
    fn from(kind: ProcessErrorKind) -> Self {
        Self::Kind(kind)
    }
}

/// A stream of messages, the schema first.
pub(super) struct Frames<R> {
    stream: BufReader<R>,
    /// The bytes of the schema's message, which stand before every other one when it is read.
    head: Vec<u8>,
}

impl<R: Read> Frames<R> {
    /// Reads the schema.
    pub(super) fn new(stream: R) -> Result<(Self, SchemaRef), FrameError> {
        let mut frames = Self {
            stream: BufReader::new(stream),
            head: Vec::new(),
        };
        frames.head = frames.message(MessageHeader::Schema)?;
        let reader = frames.reader(&[])?;
        let schema = reader.schema();
        Ok((frames, schema))
    }

    /// Reads the next record batch.
    pub(super) fn batch(&mut self) -> Result<RecordBatch, FrameError> {
        let message = self.message(MessageHeader::RecordBatch)?;
        let mut reader = self.reader(&message)?;
        match reader.next() {
            Some(Ok(batch)) => Ok(batch),
            Some(Err(error)) => Err(ProcessErrorKind::Message(error.to_string()).into()),
            None => Err(ProcessErrorKind::Message("it is empty".to_owned()).into()),
        }
    }

    /// Arrow's reader on the schema and one message.
    fn reader(&self, message: &[u8]) -> Result<StreamReader<Cursor<Vec<u8>>>, FrameError> {
        let bytes = [&self.head, message, &END].concat();
        StreamReader::try_new(Cursor::new(bytes), None)
            .map_err(|error| ProcessErrorKind::Message(error.to_string()).into())
    }

    /// The bytes of a message, which must be of this kind.
    fn message(&mut self, expected: MessageHeader) -> Result<Vec<u8>, FrameError> {
        let mut bytes = self.exactly(4, true)?;
        if bytes != CONTINUATION {
            return Err(self.garbage(bytes));
        }
        let length = self.exactly(4, false)?;
        bytes.extend(&length);
        let length = u64::from(u32::from_le_bytes([
            length[0], length[1], length[2], length[3],
        ]));
        if length == 0 {
            return Err(FrameError::Ended);
        }
        check_size(
            "metadata",
            i64::try_from(length).unwrap_or(i64::MAX),
            MAX_METADATA,
        )?;
        let metadata = self.exactly(length, false)?;
        let message = root_as_message(&metadata)
            .map_err(|error| ProcessErrorKind::Message(error.to_string()))?;
        let found = message.header_type();
        if found != expected {
            let name = |header: MessageHeader| header.variant_name().unwrap_or("unknown");
            let text = format!("expected a {}, found a {}", name(expected), name(found));
            return Err(ProcessErrorKind::Message(text).into());
        }
        let data = message.bodyLength();
        check_size("data", data, MAX_DATA)?;
        bytes.extend(&metadata);
        bytes.extend(self.exactly(data.unsigned_abs(), false)?);
        Ok(bytes)
    }

    /// So many bytes, of which none is allocated before it has come.
    fn exactly(&mut self, n: u64, is_start: bool) -> Result<Vec<u8>, FrameError> {
        let mut bytes = Vec::new();
        let read = self.stream.by_ref().take(n).read_to_end(&mut bytes);
        read.map_err(ProcessErrorKind::Io)?;
        match bytes.len() as u64 {
            found if found == n => Ok(bytes),
            0 if is_start => Err(FrameError::Ended),
            // The beginning of a message, or a word and the end.
            _ if is_start && !CONTINUATION.starts_with(&bytes) => Err(self.garbage(bytes)),
            _ => Err(FrameError::Cut),
        }
    }

    /// What came instead of a message, as far as it is here already.
    fn garbage(&self, mut bytes: Vec<u8>) -> FrameError {
        let more = self.stream.buffer();
        bytes.extend(&more[..more.len().min(SHOWN)]);
        bytes.truncate(SHOWN);
        let text = String::from_utf8_lossy(&bytes);
        let found = format!("{text:?}");
        ProcessErrorKind::Garbage { found }.into()
    }
}

fn check_size(part: &'static str, found: i64, limit: u64) -> Result<(), ProcessErrorKind> {
    match u64::try_from(found) {
        Ok(size) if size <= limit => Ok(()),
        _ => Err(ProcessErrorKind::Size { part, found, limit }),
    }
}
