//! Fetching datasets by name into the folders where their own tools look for them.
//!
//! A D4RL dataset is one file below D4RL's base address, a Minari dataset a folder in a repository of the Hugging
//! Face hub; [`registry`](crate::registry) knows which are published. A download grows in a hidden folder
//! `.NAME.part` beside its destination and appears there whole, checked, or not at all:
//!
//! * What is published with a SHA-256 must have it. Else the length must be the declared one, and the file must open.
//! * A download that broke off goes on where it stopped, if the server still has the same file (`Range` with
//!   `If-Range`); else it starts over.
//! * Lost connections, time-outs, 429 and 5xx are tried again with growing delays. No connection at all is an error
//!   at once.
//! * Web pages, files of another length and paths that would leave the dataset's folder are refused.
//! * What is there already is checked and kept, unless [`DownloadOptions::force`].
//!
//! No tokens are sent: gated datasets must be fetched with their own tools.

mod error;
mod fetch;
mod http;
mod hub;
mod minari;
mod partial;
mod plan;

use std::path::{Path, PathBuf};
use std::time::Duration;

pub use error::DownloadError;
pub use plan::{Plan, plan};

use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::registry::Store;
use crate::resolve::SearchRoots;
use fetch::{Wanted, Watch};
use http::Client;
use partial::Partial;

/// How to fetch.
#[derive(Debug, Clone)]
pub struct DownloadOptions {
    /// Where datasets go.
    pub roots: SearchRoots,
    /// Base address to use instead of the store's own: a mirror.
    pub base_url: Option<String>,
    /// Base address of the hub, as in `HF_ENDPOINT`; [`Self::base_url`] wins.
    pub hub_url: Option<String>,
    /// Fetch again, and replace what is there.
    pub force: bool,
    /// Bytes of a dataset, at most.
    pub max_bytes: u64,
    /// Attempts after the first, in a row without success.
    pub max_retries: u32,
    /// Wait before the first retry; doubled for each further one.
    pub retry_delay: Duration,
    /// The longest wait. A server that asks for a longer one is not tried again.
    pub max_wait: Duration,
    /// How long finding and connecting to a server may take, each.
    pub connect_timeout: Duration,
    /// How long a server may be silent.
    pub stall_timeout: Duration,
    /// Whether to go through the proxy of the environment (`HTTPS_PROXY`, `NO_PROXY`, …).
    pub use_proxy: bool,
}

impl Default for DownloadOptions {
    fn default() -> Self {
        Self {
            roots: SearchRoots::default(),
            base_url: None,
            hub_url: None,
            force: false,
            max_bytes: 1 << 38,
            max_retries: 5,
            retry_delay: Duration::from_secs(1),
            max_wait: Duration::from_secs(60),
            connect_timeout: Duration::from_secs(5),
            stall_timeout: Duration::from_secs(30),
            use_proxy: true,
        }
    }
}

impl DownloadOptions {
    /// The defaults with the roots and the hub of this process's environment.
    pub fn from_env() -> Self {
        Self {
            roots: SearchRoots::from_env(),
            hub_url: std::env::var("HF_ENDPOINT")
                .ok()
                .filter(|url| !url.is_empty()),
            ..Self::default()
        }
    }
}

/// What happens on the way.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Event {
    /// So many bytes of the dataset are there.
    Bytes {
        /// Bytes so far, those of earlier calls included.
        done: u64,
        /// Bytes in the end, where known.
        total: Option<u64>,
    },
    /// An attempt failed; the next follows after a wait.
    Retry {
        /// What failed.
        what: String,
        /// The wait.
        wait: Duration,
    },
}

/// How it was made sure that the data is what was published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Check {
    /// By the published SHA-256 (of a Minari dataset: of every file that has one; the others by length).
    Sha256,
    /// By its length and by opening it.
    Opened,
    /// Not at all: it was there already and the server could not be asked.
    NotChecked,
}

impl Check {
    /// Stable name: `sha256`, `opened` or `none`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sha256 => "sha256",
            Self::Opened => "opened",
            Self::NotChecked => "none",
        }
    }
}

/// A dataset that is in its place.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Downloaded {
    /// Its full id.
    pub id: String,
    /// Its file or folder.
    pub path: PathBuf,
    /// Bytes of its files.
    pub bytes: u64,
    /// Bytes that came over the network; 0 if it was there already.
    pub fetched: u64,
    /// Whether it was there already.
    pub was_there: bool,
    /// How it was checked.
    pub check: Check,
}

/// Fetches a dataset by its id or short name, telling `event` about the progress.
///
/// # Errors
/// [`DatasetError::Download`] naming the address. What was fetched stays for the next call to go on from, unless it
/// was wrong. [`DatasetError::BadId`] for an id that could leave the folder of datasets.
pub fn download(
    name: &str,
    options: &DownloadOptions,
    event: &mut dyn FnMut(Event),
) -> Result<Downloaded> {
    let plan = plan::place(name, options)?;
    let client = Client::new(options, &plan.base);
    let fetched = match plan.store {
        Store::D4rl => d4rl(&plan, &client, options, event),
        Store::Minari => minari::download(&plan, &client, options, event),
    };
    fetched.map_err(|error| plan.error(error))
}

/// One file of D4RL.
fn d4rl(
    plan: &Plan,
    client: &Client<'_>,
    options: &DownloadOptions,
    event: &mut dyn FnMut(Event),
) -> Result<Downloaded, DownloadError> {
    let wanted = Wanted {
        url: plan.url.clone(),
        bytes: plan.bytes,
        sha256: plan.sha256.map(str::to_owned),
    };
    let target = &plan.destination;
    if let Some(there) = d4rl_there(plan, options)? {
        return Ok(there);
    }
    plan.make_parent()?;
    let partial = Partial::begin(target)?;
    // Another process may have just put it there.
    if let Some(there) = d4rl_there(plan, options)? {
        return Ok(there);
    }
    let mut watch = Watch {
        event,
        before: 0,
        total: wanted.bytes,
        fetched: 0,
    };
    fetch::fetch(client, options, &wanted, &partial, &mut watch)?;
    let fetched = watch.fetched;
    let check = match wanted.sha256 {
        Some(_) => Check::Sha256,
        None => {
            opens(&partial.current()).inspect_err(|_| partial.discard())?;
            Check::Opened
        }
    };
    partial.place_current(target)?;
    partial.finish()?;
    Ok(plan.downloaded(size(target), fetched, check))
}

/// The file that is there already, checked.
fn d4rl_there(plan: &Plan, options: &DownloadOptions) -> Result<Option<Downloaded>, DownloadError> {
    let path = &plan.destination;
    if options.force || path.symlink_metadata().is_err() {
        return Ok(None);
    }
    let check = match (plan.bytes, plan.sha256) {
        (Some(bytes), Some(sha256)) => {
            differs_by(path, bytes, Some(sha256))?;
            Check::Sha256
        }
        _ => {
            opens(path).map_err(|error| DownloadError::Differs {
                path: path.clone(),
                what: error.to_string(),
            })?;
            Check::Opened
        }
    };
    let there = plan.downloaded(size(path), 0, check);
    Ok(Some(Downloaded {
        was_there: true,
        ..there
    }))
}

/// Compares a file that is there with what is published.
fn differs_by(path: &Path, bytes: u64, sha256: Option<&str>) -> Result<(), DownloadError> {
    let differs = |what: String| DownloadError::Differs {
        path: path.to_owned(),
        what,
    };
    let found = std::fs::metadata(path).map_err(DownloadError::disk("read the file"))?;
    if found.len() != bytes {
        return Err(differs(format!(
            "has {} bytes, expected {bytes}",
            found.len()
        )));
    }
    let found = match sha256 {
        Some(_) => partial::sha256(path)?,
        None => return Ok(()),
    };
    match sha256 {
        Some(expected) if found != expected => Err(differs(format!(
            "its SHA-256 is {found}, expected {expected}"
        ))),
        _ => Ok(()),
    }
}

/// Whether the file opens as HDF5. What this build cannot read is given the benefit of the doubt.
fn opens(path: &Path) -> Result<(), DownloadError> {
    let refused = |found: String| DownloadError::WrongContent {
        found,
        expected: "an HDF5 file",
    };
    match crate::format::open(path, &OpenOptions::default()) {
        Ok(source) if source.info().format == crate::Format::D4rlHdf5 => Ok(()),
        Ok(source) => Err(refused(format!(
            "a file of format {}",
            source.info().format
        ))),
        Err(error) => match error.cause() {
            damaged @ (DatasetError::Corrupt { .. }
            | DatasetError::NotADataset { .. }
            | DatasetError::Hdf5 { .. }
            | DatasetError::Io { .. }) => Err(refused(damaged.to_string())),
            _ => Ok(()),
        },
    }
}

fn size(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |file| file.len())
}
