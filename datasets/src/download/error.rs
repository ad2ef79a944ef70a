//! What can go wrong while fetching.

use std::path::PathBuf;
use std::time::Duration;

/// Why a dataset could not be fetched; the address is in [`crate::DatasetError::Download`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DownloadError {
    /// The name leads to no published dataset.
    #[error("no published dataset of this name is known{}", or_these(alternatives))]
    UnknownName {
        /// Ids it may be meant for.
        alternatives: Vec<String>,
    },
    /// There is no folder to put it into.
    #[error("no folder for it is known: set {variable}")]
    NoFolder {
        /// The environment variable that names one.
        variable: &'static str,
    },
    /// A base address that is none.
    #[error("base address \"{base}\" is refused: expected http://… or https://…")]
    BadBase {
        /// The address.
        base: String,
    },
    /// No connection at all.
    #[error(
        "cannot reach the server ({what}); is there a network? Behind a proxy, set HTTPS_PROXY; for a mirror, give its base address"
    )]
    Offline {
        /// What the system said.
        what: String,
    },
    /// The server does not give the file.
    #[error("the server answers {status}{hint}")]
    Status {
        /// The HTTP status.
        status: u16,
        /// What to do about it.
        hint: String,
    },
    /// Every attempt failed.
    #[error("gave up after {attempts} failed attempts in a row, the last with: {what}")]
    GaveUp {
        /// Attempts since the last that brought something.
        attempts: u32,
        /// The last failure.
        what: String,
    },
    /// The exchange failed in a way that trying again does not mend.
    #[error("the connection failed: {what}")]
    Connection {
        /// What the HTTP or TLS library said.
        what: String,
    },
    /// A redirection that must not be followed.
    #[error("refused a redirection to {to}: {reason}")]
    Redirect {
        /// Where it leads.
        to: String,
        /// Why not.
        reason: &'static str,
    },
    /// The server has another file than the one that was published.
    #[error("the server has {found} bytes, expected {expected}")]
    Size {
        /// Bytes of the server's file, or received so far if it gave more than expected.
        found: u64,
        /// Bytes there should be.
        expected: u64,
    },
    /// More than is allowed.
    #[error("{found} bytes are over the limit of {limit}")]
    TooLarge {
        /// Bytes announced or received.
        found: u64,
        /// The limit.
        limit: u64,
    },
    /// The bytes are not those that were published.
    #[error("SHA-256 is {found}, expected {expected}")]
    Checksum {
        /// Hash of what was received.
        found: String,
        /// Hash that was published.
        expected: String,
    },
    /// Something else than data, such as an error page.
    #[error("the server sent {found}, expected {expected}")]
    WrongContent {
        /// What came.
        found: String,
        /// What should come.
        expected: &'static str,
    },
    /// A listing of files that cannot be used.
    #[error("the listing of files is refused: {what}")]
    BadListing {
        /// What is wrong with it.
        what: String,
    },
    /// What is there already is not what is published.
    #[error("{} is there already, but {what}; fetch it again with `force`", path.display())]
    Differs {
        /// The file or folder.
        path: PathBuf,
        /// In which way.
        what: String,
    },
    /// Another process is at it.
    #[error("another process is fetching it into {}", path.display())]
    Busy {
        /// The destination.
        path: PathBuf,
    },
    /// The disk refused.
    #[error("cannot {operation}")]
    Disk {
        /// What was tried.
        operation: &'static str,
        /// The system's error.
        source: std::io::Error,
    },
}

impl DownloadError {
    pub(super) fn disk(operation: &'static str) -> impl Fn(std::io::Error) -> Self {
        move |source| Self::Disk { operation, source }
    }

    /// The error of a status that is no success, with what is known about it in general.
    pub(super) fn status(status: u16) -> Self {
        let hint = match status {
            401 | 403 => {
                ": it may be gated or private; accept its terms on its web page and fetch it with \
                 its own tool, or give the base address of a mirror"
            }
            404 | 410 => " (not found)",
            _ => "",
        };
        Self::Status {
            status,
            hint: hint.to_owned(),
        }
    }

    /// The error of a server that asks for more patience than there is.
    pub(super) fn asked_to_wait(status: u16, wait: Duration) -> Self {
        Self::Status {
            status,
            hint: format!(" and asks to come back in {} s", wait.as_secs()),
        }
    }

    /// Adds the ids one may have meant to a "not found".
    pub(super) fn or_meant(mut self, id: &str) -> Self {
        if let Self::Status { status: 404, hint } = &mut self {
            let known: Vec<String> = known(id);
            hint.push_str(&or_these(&known));
        }
        self
    }
}

/// Listed ids one may have meant.
pub(super) fn known(id: &str) -> Vec<String> {
    let ids = crate::registry::alternatives(id).into_iter();
    ids.map(str::to_owned).collect()
}

fn or_these(ids: &[String]) -> String {
    match ids {
        [] => "; `ksim dataset list --known` shows those that are known".to_owned(),
        _ => format!("; there are {}", ids.join(", ")),
    }
}
