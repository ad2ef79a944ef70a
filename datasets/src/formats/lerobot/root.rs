//! The dataset folder, and paths inside it: nothing outside is ever opened.

use std::fs::File;
use std::io::Read;
use std::path::{Component, Path, PathBuf};

use crate::error::{DatasetError, Result};

/// Bytes of a JSON file, at most.
const MAX_TEXT: u64 = 1 << 30;

/// A dataset folder.
#[derive(Debug, Clone)]
pub(super) struct Root {
    path: PathBuf,
    /// Every file must lie under this folder once links are followed: the dataset's, or in the Hugging Face
    /// cache (`<repository>/snapshots/<revision>`, whose files are links to `../../blobs`) the repository's.
    real: PathBuf,
}

impl Root {
    /// # Errors
    /// The folder is not there.
    pub(super) fn new(path: &Path) -> Result<Self> {
        let mut real = path
            .canonicalize()
            .map_err(|e| DatasetError::io("open", e))?;
        let repository = real
            .parent()
            .filter(|parent| parent.ends_with("snapshots"))
            .and_then(Path::parent)
            .map(Path::to_owned);
        if let Some(repository) = repository {
            real = repository;
        }
        Ok(Self {
            path: path.to_owned(),
            real,
        })
    }

    /// Where a file of the dataset is, as it is named in messages.
    pub(super) fn join(&self, relative: &str) -> PathBuf {
        self.path.join(relative)
    }

    /// Whether there is something under that name; it may still be refused.
    pub(super) fn has(&self, relative: &str) -> bool {
        self.join(relative).symlink_metadata().is_ok()
    }

    /// Opens a file of the dataset.
    ///
    /// # Errors
    /// It is not there, or is not inside the folder; the error names it.
    pub(super) fn open(&self, relative: &str) -> Result<File> {
        let path = self.join(relative);
        let open = || {
            let real = self.contained(relative)?;
            File::open(real).map_err(|e| DatasetError::io("open", e))
        };
        open().map_err(|error| error.in_file(&path))
    }

    /// Whether the file is there and inside the folder.
    ///
    /// # Errors
    /// What [`Self::open`] would say.
    pub(super) fn check(&self, relative: &str) -> Result<()> {
        self.contained(relative)
            .map(|_| ())
            .map_err(|error| error.in_file(&self.join(relative)))
    }

    /// The text of a file.
    ///
    /// # Errors
    /// It cannot be read, is too long or no UTF-8.
    pub(super) fn read_text(&self, relative: &str) -> Result<String> {
        let mut text = String::new();
        let mut file = self.open(relative)?.take(MAX_TEXT);
        let read = file.read_to_string(&mut text);
        let read = read.map_err(|e| DatasetError::io("read", e));
        read.and_then(|length| match length as u64 == MAX_TEXT {
            true => Err(DatasetError::corrupt("over 1 GiB of JSON")),
            false => Ok(text),
        })
        .map_err(|error| error.in_file(&self.join(relative)))
    }

    /// The files `chunk-*/file-*.parquet` in a folder, in order of their names, as LeRobot reads them.
    ///
    /// # Errors
    /// A folder cannot be listed.
    pub(super) fn parquet_files(&self, folder: &str) -> Result<Vec<String>> {
        let mut found = Vec::new();
        for chunk in self.list(folder)? {
            let chunk = format!("{folder}/{chunk}");
            if self.join(&chunk).is_dir() {
                let names = self.list(&chunk)?.into_iter();
                let files = names.filter(|name| name.ends_with(".parquet"));
                found.extend(files.map(|name| format!("{chunk}/{name}")));
            }
        }
        Ok(found)
    }

    fn list(&self, folder: &str) -> Result<Vec<String>> {
        let path = self.join(folder);
        let list = || -> std::io::Result<Vec<String>> {
            let mut names = Vec::new();
            for entry in std::fs::read_dir(&path)? {
                names.push(entry?.file_name().to_string_lossy().into_owned());
            }
            names.sort();
            Ok(names)
        };
        list().map_err(|e| DatasetError::io("list", e).in_file(&path))
    }

    fn contained(&self, relative: &str) -> Result<PathBuf> {
        let refused = |actual: String| DatasetError::Metadata {
            field: "path of a file".to_owned(),
            actual,
            expected: "a path inside the dataset folder",
        };
        let is_plain = |part| matches!(part, Component::Normal(_));
        let path = Path::new(relative);
        if !path.components().all(is_plain) || relative.contains(['\\', '\0']) {
            return Err(refused(format!("\"{}\"", relative.escape_debug())));
        }
        let real = self
            .path
            .join(path)
            .canonicalize()
            .map_err(|e| DatasetError::io("open", e))?;
        match real.starts_with(&self.real) {
            true => Ok(real),
            false => Err(refused("a link out of it".to_owned())),
        }
    }
}

/// A path with places for numbers, such as `data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PathTemplate(Vec<Part>);

#[derive(Debug, Clone, PartialEq, Eq)]
enum Part {
    Text(String),
    /// Place among the known fields, and the width the number is padded to with zeros.
    Number(usize, usize),
}

impl PathTemplate {
    /// Parses a template of Python's format language, of which only `{field}` and `{field:03d}` are known.
    ///
    /// # Errors
    /// Another field or form.
    pub(super) fn parse(template: &str, fields: &[&str]) -> Result<Self> {
        let bad = || DatasetError::Metadata {
            field: "data_path".to_owned(),
            actual: format!("\"{}\"", template.escape_debug()),
            expected: "a path with the fields of its version, such as {chunk_index:03d}",
        };
        let mut parts = Vec::new();
        let mut rest = template;
        while let Some((text, after)) = rest.split_once('{') {
            let (place, after) = after.split_once('}').ok_or_else(bad)?;
            let (name, width) = match place.split_once(':') {
                None => (place, 0),
                Some((name, form)) => (name, padding(form).ok_or_else(bad)?),
            };
            let known = fields.iter().position(|field| *field == name);
            parts.push(Part::Text(text.to_owned()));
            parts.push(Part::Number(known.ok_or_else(bad)?, width));
            rest = after;
        }
        parts.push(Part::Text(rest.to_owned()));
        let stray =
            |part: &Part| matches!(part, Part::Text(text) if text.contains(['{', '}', '\\']));
        match parts.iter().any(stray) || template.is_empty() {
            true => Err(bad()),
            false => Ok(Self(parts)),
        }
    }

    /// The path for these values of the fields, which are not negative.
    pub(super) fn path(&self, values: &[i64]) -> String {
        self.0
            .iter()
            .map(|part| match part {
                Part::Text(text) => text.clone(),
                Part::Number(field, width) => {
                    let value = values.get(*field).copied().unwrap_or(0);
                    format!("{value:0width$}")
                }
            })
            .collect()
    }
}

/// The width in `03d`, `3d` or `d`.
fn padding(form: &str) -> Option<usize> {
    let digits = form.strip_suffix('d')?;
    let width = match digits {
        "" => 0,
        digits => digits.parse().ok()?,
    };
    // Blanks in a path are not what anyone means, so a width without a leading zero is refused.
    let zeros = digits.is_empty() || digits.starts_with('0');
    (zeros && width <= 20).then_some(width)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn templates_format_known_fields_only() {
        let parse = |text| PathTemplate::parse(text, &["chunk_index", "file_index"]);
        let template = parse("data/chunk-{chunk_index:03d}/file-{file_index}.parquet").unwrap();
        assert_eq!(template.path(&[1, 20]), "data/chunk-001/file-20.parquet");
        assert_eq!(template.path(&[1234, 0]), "data/chunk-1234/file-0.parquet");
        for bad in [
            "",
            "{episode_index}",
            "{chunk_index!r}",
            "{chunk_index:3d}",
            "{chunk_index:0999999d}",
            "{chunk_index.__class__}",
            "{chunk_index",
            "x}",
            "{{chunk_index}}",
            "a\\{file_index}",
        ] {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn nothing_outside_is_opened() {
        let dir = tempfile::tempdir().unwrap();
        let dataset = dir.path().join("set");
        std::fs::create_dir(&dataset).unwrap();
        std::fs::write(dataset.join("a"), "inside").unwrap();
        std::fs::write(dir.path().join("b"), "outside").unwrap();
        std::os::unix::fs::symlink("../b", dataset.join("link")).unwrap();
        let root = Root::new(&dataset).unwrap();
        assert_eq!(root.read_text("a").unwrap(), "inside");
        let absolute = dir.path().join("b").to_string_lossy().into_owned();
        for outside in ["../b", "x/../../b", &absolute, "link", "./a"] {
            let error = root.open(outside).unwrap_err();
            let refused = matches!(error.cause(), DatasetError::Metadata { .. });
            assert!(refused, "{outside}: {error:?}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn links_of_the_hub_cache_are_followed() {
        let dir = tempfile::tempdir().unwrap();
        let snapshot = dir.path().join("datasets--a--b/snapshots/main");
        std::fs::create_dir_all(&snapshot).unwrap();
        std::fs::create_dir(dir.path().join("datasets--a--b/blobs")).unwrap();
        std::fs::write(dir.path().join("datasets--a--b/blobs/1"), "blob").unwrap();
        std::os::unix::fs::symlink("../../blobs/1", snapshot.join("a")).unwrap();
        let root = Root::new(&snapshot).unwrap();
        assert_eq!(root.read_text("a").unwrap(), "blob");
    }
}
