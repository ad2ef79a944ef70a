//! Hashes of the files that results follow from: another file of the same name makes other results.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use super::error::SuiteError;

/// Bytes that are read in one go.
const PIECE: usize = 1 << 18;

/// Hashes of files and folders, each read once.
#[derive(Debug, Default)]
pub(super) struct Contents {
    known: BTreeMap<PathBuf, String>,
}

impl Contents {
    /// Of a file, or of all files in a folder and its folders.
    pub(super) fn of(&mut self, path: &Path) -> Result<String, SuiteError> {
        self.of_files(path, |_| true)
    }

    /// Of the files of a run that planning may read: one that was trained further is another planner.
    pub(super) fn of_run(&mut self, run: &Path) -> Result<String, SuiteError> {
        self.of_files(run, |name| {
            !name.starts_with("checkpoint") && !name.starts_with("losses")
        })
    }

    fn of_files(
        &mut self,
        path: &Path,
        counts: impl Fn(&str) -> bool,
    ) -> Result<String, SuiteError> {
        if let Some(hash) = self.known.get(path) {
            return Ok(hash.clone());
        }
        let mut hasher = blake3::Hasher::new();
        let mut left = vec![path.to_owned()];
        while let Some(next) = left.pop() {
            let failed = |source| SuiteError::Read {
                path: next.clone(),
                source,
            };
            if next.is_dir() {
                let entries = fs::read_dir(&next).map_err(failed)?;
                let entries = entries.map(|entry| Ok(entry?.path()));
                let mut inner = entries.collect::<io::Result<Vec<_>>>().map_err(failed)?;
                inner.retain(|path| {
                    let name = path.file_name().unwrap_or_default();
                    counts(&name.to_string_lossy())
                });
                inner.sort_unstable_by(|a, b| b.cmp(a));
                left.extend(inner);
                continue;
            }
            let name = next.strip_prefix(path).unwrap_or(&next).to_string_lossy();
            let mut file = File::open(&next).map_err(failed)?;
            let length = file.metadata().map_err(failed)?.len();
            hasher.update(&(name.len() as u64).to_le_bytes());
            hasher.update(name.as_bytes());
            hasher.update(&length.to_le_bytes());
            let mut piece = vec![0; PIECE];
            loop {
                match file.read(&mut piece).map_err(failed)? {
                    0 => break,
                    n => hasher.update(&piece[..n]),
                };
            }
        }
        let hash = hasher.finalize().to_hex()[..32].to_owned();
        self.known.insert(path.to_owned(), hash.clone());
        Ok(hash)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_contents_count_and_places_do_not() {
        let folder = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        let hash = |path: &str| Contents::default().of(&folder.path().join(path)).unwrap();
        for place in ["a", "b"] {
            write(&format!("{place}/x/1"), "one");
            write(&format!("{place}/2"), "two");
        }
        assert_eq!(hash("a"), hash("b"));
        assert_ne!(hash("a/2"), hash("a/x/1"));
        let before = hash("a");
        write("a/x/1", "One");
        assert_ne!(hash("a"), before);
        write("a/x/1", "one");
        write("a/checkpoint.safetensors", "more");
        assert_ne!(hash("a"), before);
        let of_run = |path: &str| Contents::default().of_run(&folder.path().join(path));
        assert_eq!(of_run("a").unwrap(), before);
        let error = of_run("c").unwrap_err().to_string();
        assert!(
            error.starts_with("cannot read") && error.ends_with('c'),
            "{error}"
        );
    }
}
