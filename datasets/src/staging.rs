//! Destinations that appear whole or not at all.

use std::path::{Path, PathBuf};

use crate::error::{DatasetError, Result};

/// A file or folder under a temporary name beside its destination; removed unless [`Self::publish`]ed.
pub(crate) struct Staged {
    target: PathBuf,
    temporary: PathBuf,
    published: bool,
}

impl Staged {
    /// A place for a file; the caller creates it. An existing file is replaced when it is published.
    ///
    /// # Errors
    /// The target is no name of a file.
    pub(crate) fn file(target: &Path) -> Result<Self> {
        Self::beside(target)
    }

    /// A new empty folder that will stand at `target`, where nothing or an empty folder may be.
    ///
    /// # Errors
    /// Something is there already, or the folder cannot be made.
    pub(crate) fn folder(target: &Path) -> Result<Self> {
        let occupied = match std::fs::read_dir(target) {
            Ok(mut entries) => entries.next().is_some(),
            Err(_) => target.symlink_metadata().is_ok(),
        };
        if occupied {
            return Err(DatasetError::AlreadyExists);
        }
        let staged = Self::beside(target)?;
        std::fs::create_dir_all(&staged.temporary).map_err(|e| DatasetError::io("create", e))?;
        Ok(staged)
    }

    fn beside(target: &Path) -> Result<Self> {
        let name = target
            .file_name()
            .ok_or_else(|| {
                let source = std::io::Error::from(std::io::ErrorKind::InvalidFilename);
                DatasetError::io("create", source)
            })?
            .to_string_lossy();
        let temporary = target.with_file_name(format!(".{name}.{}.unfinished", std::process::id()));
        Ok(Self {
            target: target.to_owned(),
            temporary,
            published: false,
        })
    }

    /// Where to write.
    pub(crate) fn path(&self) -> &Path {
        &self.temporary
    }

    /// Where it will stand.
    pub(crate) fn target(&self) -> &Path {
        &self.target
    }

    /// Puts what was written in its place. The caller has synced the files it cares for.
    ///
    /// # Errors
    /// The system refuses the renaming.
    pub(crate) fn publish(mut self) -> Result<()> {
        std::fs::rename(&self.temporary, &self.target)
            .map_err(|e| DatasetError::io("put in place", e))?;
        self.published = true;
        Ok(())
    }
}

impl Drop for Staged {
    fn drop(&mut self) {
        if !self.published {
            // Nothing useful can be done if this fails: the name says what it is.
            let _ = match self.temporary.is_dir() {
                true => std::fs::remove_dir_all(&self.temporary),
                false => std::fs::remove_file(&self.temporary),
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_appears_when_published_and_vanishes_when_dropped() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("out");
        let staged = Staged::folder(&target).unwrap();
        std::fs::write(staged.path().join("a"), "x").unwrap();
        drop(staged);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
        let staged = Staged::folder(&target).unwrap();
        std::fs::write(staged.path().join("a"), "x").unwrap();
        assert!(!target.exists());
        staged.publish().unwrap();
        assert!(target.join("a").exists());
        assert!(matches!(
            Staged::folder(&target).map(|_| ()),
            Err(DatasetError::AlreadyExists)
        ));
    }
}
