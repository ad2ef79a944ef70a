//! The hidden folder a download grows in: `.NAME.part` beside its destination.
//!
//! It holds a lock, the file that is being fetched (`current`, and `current.json` saying of what), and for a dataset
//! of several files those that are complete (`files`). A later call goes on from it.

use std::fs::{File, TryLockError};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::error::DownloadError;

/// What the beginning in `current` is the beginning of.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Mark {
    pub(super) url: String,
    pub(super) etag: Option<String>,
    pub(super) last_modified: Option<String>,
    pub(super) total: Option<u64>,
    pub(super) sha256: Option<String>,
}

impl Mark {
    /// What a server compares to tell whether the file is still the same.
    pub(super) fn validator(&self) -> Option<&String> {
        // A weak tag promises the same meaning, not the same bytes.
        let strong = self.etag.as_ref().filter(|etag| !etag.starts_with("W/"));
        strong.or(self.last_modified.as_ref())
    }
}

/// A download under way. No other process is at it as long as this lives.
pub(super) struct Partial {
    folder: PathBuf,
    _lock: File,
}

impl Partial {
    /// Takes over or begins the download that will stand at `target`, whose folder exists.
    pub(super) fn begin(target: &Path) -> Result<Self, DownloadError> {
        let name = target.file_name().unwrap_or_default().to_string_lossy();
        let folder = target.with_file_name(format!(".{name}.part"));
        let io = DownloadError::disk("begin the download");
        loop {
            match std::fs::create_dir(&folder) {
                Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
                    return Err(io(error));
                }
                _ => {}
            }
            // A link could lead anywhere.
            if !folder.symlink_metadata().map_err(&io)?.is_dir() {
                return Err(io(io::ErrorKind::NotADirectory.into()));
            }
            let path = folder.join("lock");
            let lock = match File::options()
                .write(true)
                .create(true)
                .truncate(false)
                .open(&path)
            {
                // The other process is just done with it.
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                opened => opened.map_err(&io)?,
            };
            match lock.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => {
                    let path = target.to_owned();
                    return Err(DownloadError::Busy { path });
                }
                Err(TryLockError::Error(error)) => return Err(io(error)),
            }
            if is_still_there(&lock, &path) {
                return Ok(Self {
                    folder,
                    _lock: lock,
                });
            }
        }
    }

    /// The file that is being fetched.
    pub(super) fn current(&self) -> PathBuf {
        self.folder.join("current")
    }

    /// Where the complete files of a dataset of several stand.
    pub(super) fn files(&self) -> PathBuf {
        self.folder.join("files")
    }

    /// A place for a folder that is in the way.
    pub(super) fn replaced(&self) -> PathBuf {
        self.folder.join("replaced")
    }

    fn mark_path(&self) -> PathBuf {
        self.folder.join("current.json")
    }

    /// What `current` is the beginning of, and its bytes so far.
    pub(super) fn mark(&self) -> Option<(Mark, u64)> {
        let mark = serde_json::from_slice(&std::fs::read(self.mark_path()).ok()?).ok()?;
        let have = std::fs::metadata(self.current()).ok()?.len();
        Some((mark, have))
    }

    /// Begins `current` anew.
    pub(super) fn restart(&self, mark: &Mark) -> Result<File, DownloadError> {
        let io = DownloadError::disk("write the partial file");
        let text = serde_json::to_vec(mark).map_err(|error| io(error.into()))?;
        // First the file, so that a mark never stands beside the bytes of another file.
        self.discard();
        let file = File::create(self.current()).map_err(&io)?;
        std::fs::write(self.mark_path(), text).map_err(&io)?;
        Ok(file)
    }

    /// Opens `current` at its end.
    pub(super) fn proceed(&self) -> Result<File, DownloadError> {
        let io = DownloadError::disk("open the partial file");
        let mut file = File::options()
            .write(true)
            .open(self.current())
            .map_err(&io)?;
        file.seek(SeekFrom::End(0)).map_err(&io)?;
        Ok(file)
    }

    /// Drops what `current` has.
    pub(super) fn discard(&self) {
        // What is not there need not be removed; what cannot be removed shows when it is created.
        let _ = std::fs::remove_file(self.mark_path());
        let _ = std::fs::remove_file(self.current());
    }

    /// Moves the complete `current` to its place.
    pub(super) fn place_current(&self, target: &Path) -> Result<(), DownloadError> {
        let io = DownloadError::disk("put the file in place");
        File::open(self.current())
            .and_then(|file| file.sync_all())
            .map_err(&io)?;
        std::fs::rename(self.current(), target).map_err(&io)?;
        let _ = std::fs::remove_file(self.mark_path());
        Ok(())
    }

    /// Moves the folder of complete files to its place, in exchange for what is there.
    pub(super) fn place_files(&self, target: &Path) -> Result<(), DownloadError> {
        let io = DownloadError::disk("put the folder in place");
        let is_occupied = target.symlink_metadata().is_ok();
        if is_occupied {
            std::fs::rename(target, self.replaced()).map_err(&io)?;
        }
        std::fs::rename(self.files(), target).map_err(|error| {
            if is_occupied {
                // Nothing better can be done if this fails too; the folder is still in `replaced`.
                let _ = std::fs::rename(self.replaced(), target);
            }
            io(error)
        })
    }

    fn is_empty(&self) -> bool {
        let has_bytes = std::fs::metadata(self.current()).is_ok_and(|current| current.len() > 0);
        !has_bytes && !self.files().exists() && !self.replaced().exists()
    }

    /// Removes the folder: everything is in its place.
    pub(super) fn finish(self) -> Result<(), DownloadError> {
        std::fs::remove_dir_all(&self.folder).map_err(DownloadError::disk("clean up"))
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        if self.is_empty() {
            // Already gone after `finish`.
            let _ = std::fs::remove_dir_all(&self.folder);
        }
    }
}

/// Whether the file that was opened is the one at the path: another process may have removed it in between.
#[cfg(unix)]
fn is_still_there(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let opened = file.metadata().map(|file| (file.dev(), file.ino()));
    let found = std::fs::metadata(path).map(|file| (file.dev(), file.ino()));
    matches!((opened, found), (Ok(opened), Ok(found)) if opened == found)
}

/// An open file cannot be removed here.
#[cfg(not(unix))]
fn is_still_there(_file: &File, path: &Path) -> bool {
    path.exists()
}

/// SHA-256 of a file in lower-case hexadecimal.
pub(super) fn sha256(path: &Path) -> Result<String, DownloadError> {
    let io = DownloadError::disk("read the file");
    let mut file = File::open(path).map_err(&io)?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 16];
    loop {
        match file.read(&mut buffer).map_err(&io)? {
            0 => break,
            n => hasher.update(&buffer[..n]),
        }
    }
    Ok(hasher
        .finalize()
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect())
}
