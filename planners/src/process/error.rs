//! What can go wrong with a planner in a process.

use std::fmt;
use std::io;
use std::time::Duration;

use arrow::error::ArrowError;

/// What a planner process did wrong, and what it said on stderr last.
#[derive(Debug, thiserror::Error)]
#[error("planner process `{command}`: {kind}{}", Said(said))]
pub struct ProcessError {
    /// The command as it was given.
    pub command: String,
    /// What went wrong.
    pub kind: ProcessErrorKind,
    /// The end of what it wrote to stderr; may be empty.
    pub said: String,
}

/// Which way it went wrong.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProcessErrorKind {
    /// A command that cannot be split into words.
    #[error("the command is empty or has an open quote")]
    Command,
    /// It could not be started.
    #[error("cannot be started: {0}")]
    Start(io::Error),
    /// It ended, or closed its stdout.
    #[error("ended ({status}) instead of answering")]
    Ended {
        /// Exit status, as far as it is known.
        status: String,
    },
    /// It ended in the middle of a message.
    #[error("ended ({status}) in the middle of a message")]
    Cut {
        /// Exit status, as far as it is known.
        status: String,
    },
    /// It took too long.
    #[error("did not answer within {} s", limit.as_secs_f64())]
    Timeout {
        /// The time it had.
        limit: Duration,
    },
    /// Its stdout is no Arrow IPC stream, or something was printed between two messages.
    #[error(
        "wrote {found} to stdout, expected an Arrow IPC message; what is not part of the protocol belongs on stderr"
    )]
    Garbage {
        /// The first bytes.
        found: String,
    },
    /// A message of an impossible size.
    #[error("announced a message with {found} bytes of {part}, expected at most {limit}")]
    Size {
        /// `metadata` or `data`.
        part: &'static str,
        /// Bytes announced.
        found: i64,
        /// Bytes allowed.
        limit: u64,
    },
    /// A message that cannot be read.
    #[error("wrote a message that is no Arrow record batch: {0}")]
    Message(String),
    /// A failed read or write.
    #[error("cannot be talked to: {0}")]
    Io(io::Error),
    /// Arrow could not read or write.
    #[error("cannot be talked to: {0}")]
    Arrow(#[from] ArrowError),
    /// The handshake lacks something.
    #[error("the handshake has {found} for \"{key}\", expected {expected}")]
    Handshake {
        /// Key of the schema's metadata.
        key: &'static str,
        /// What was expected.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A planner for other observations or actions.
    #[error("has {what} = {found}, the environment has {expected}")]
    Width {
        /// Which width.
        what: &'static str,
        /// The environment's.
        expected: usize,
        /// The planner's.
        found: usize,
    },
    /// A column that is missing or of another type.
    #[error("column \"{column}\" of an answer: expected {expected}, found {found}")]
    Column {
        /// Its name.
        column: &'static str,
        /// What was expected.
        expected: String,
        /// What is there.
        found: String,
    },
    /// An answer of another number of rows.
    #[error("the answer to a {of} has {found} rows, expected {expected}")]
    Rows {
        /// `reset` or `plan`.
        of: &'static str,
        /// What was expected.
        expected: String,
        /// Rows there are.
        found: usize,
    },
    /// An answer that does not choose one candidate for every slot.
    #[error("the answer chooses {found} candidates for slot {slot}, expected 1")]
    Chosen {
        /// The slot.
        slot: usize,
        /// Candidates chosen.
        found: usize,
    },
    /// It said in its answer that it cannot.
    #[error("refused: {0}")]
    Refused(String),
    /// It was given up after an earlier error.
    #[error("was ended after an earlier error")]
    Over,
}

/// What was said, if anything was.
struct Said<'a>(&'a str);

impl fmt::Display for Said<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0.trim() {
            "" => Ok(()),
            said => write!(f, "; its stderr ends with:\n{said}"),
        }
    }
}
