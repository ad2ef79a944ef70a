//! Destinations that appear whole or not at all.

use std::path::{Path, PathBuf};

use crate::error::{DatasetError, Result};

/// A file or folder under a temporary name beside its destination; removed unless [`Self::publish`]ed.
pub(crate) struct Staged {
    target: PathBuf,
    temporary: PathBuf,
    /// Whether a folder that is at the target makes way.
    replaces: bool,
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

    /// A new empty folder that will stand at `target`. With `replace`, a folder that is there stays until
    /// this one is published; without, nothing or an empty folder may be there.
    ///
    /// # Errors
    /// Something is there already, or the folder cannot be made.
    pub(crate) fn folder(target: &Path, replace: bool) -> Result<Self> {
        let replaces = is_occupied(target);
        if replaces && !(replace && target.is_dir()) {
            return Err(DatasetError::AlreadyExists);
        }
        let mut staged = Self::beside(target)?;
        staged.replaces = replaces;
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
            replaces: false,
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
        let put = |from: &Path, to: &Path| {
            std::fs::rename(from, to).map_err(|e| DatasetError::io("put in place", e))
        };
        let old = self.temporary.with_extension("replaced");
        if self.replaces {
            // No system call replaces a folder that is not empty.
            put(&self.target, &old)?;
        }
        let placed = put(&self.temporary, &self.target);
        if self.replaces {
            // Nothing useful can be done if these fail: the name says what it is.
            let _ = match placed {
                Ok(()) if old.is_symlink() => std::fs::remove_file(&old),
                Ok(()) => std::fs::remove_dir_all(&old),
                Err(_) => std::fs::rename(&old, &self.target),
            };
        }
        placed?;
        self.published = true;
        Ok(())
    }
}

/// Whether something is there that is no empty folder.
pub(crate) fn is_occupied(target: &Path) -> bool {
    match std::fs::read_dir(target) {
        Ok(mut entries) => entries.next().is_some(),
        Err(_) => target.symlink_metadata().is_ok(),
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
        let staged = Staged::folder(&target, false).unwrap();
        std::fs::write(staged.path().join("a"), "x").unwrap();
        drop(staged);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
        let staged = Staged::folder(&target, false).unwrap();
        std::fs::write(staged.path().join("a"), "x").unwrap();
        assert!(!target.exists());
        staged.publish().unwrap();
        assert!(target.join("a").exists());
        assert!(matches!(
            Staged::folder(&target, false).map(|_| ()),
            Err(DatasetError::AlreadyExists)
        ));

        let staged = Staged::folder(&target, true).unwrap();
        std::fs::write(staged.path().join("b"), "x").unwrap();
        assert!(target.join("a").exists(), "the old one stays until the end");
        staged.publish().unwrap();
        assert!(target.join("b").exists() && !target.join("a").exists());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }
}
