//! Safetensors files with one JSON table beside their tensors, written atomically.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::io::{self, Read as _};
use std::path::Path;

use safetensors::{Dtype, SafeTensorError, SafeTensors, View};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tempfile::NamedTempFile;

use crate::error::PlannerError;
use crate::nets::{Tensor, Weights};

/// Key of the JSON table in the metadata. There is only one key: several would stand in no certain order.
const METADATA_KEY: &str = "ksim";

/// Bytes that a header has at most, as safetensors bounds it.
const MOST_HEADER: u64 = 100_000_000;

/// Tensors of f32 by name.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct TensorFile {
    /// The tensors.
    pub(crate) tensors: BTreeMap<String, Tensor>,
}

impl TensorFile {
    /// Adds tensors, with `prefix.` before their names.
    pub(crate) fn insert(&mut self, prefix: &str, weights: &Weights) {
        for (name, tensor) in &weights.tensors {
            self.tensors
                .insert(format!("{prefix}.{name}"), tensor.clone());
        }
    }

    /// Takes the tensors out whose names begin with `prefix.`.
    pub(crate) fn take(&mut self, prefix: &str) -> Weights {
        let prefix = format!("{prefix}.");
        let names: Vec<String> = self
            .tensors
            .keys()
            .filter(|name| name.starts_with(&prefix))
            .cloned()
            .collect();
        let mut weights = Weights::default();
        for name in names {
            if let Some(tensor) = self.tensors.remove(&name) {
                weights
                    .tensors
                    .insert(name[prefix.len()..].to_owned(), tensor);
            }
        }
        weights
    }

    /// Writes the file. It appears whole or not at all.
    ///
    /// # Errors
    /// The file cannot be written; what was there stays.
    pub(crate) fn write(&self, path: &Path, metadata: &impl Serialize) -> Result<(), PlannerError> {
        let json = serde_json::to_string(metadata).map_err(|source| PlannerError::Json {
            path: path.to_owned(),
            source,
        })?;
        let metadata = HashMap::from([(METADATA_KEY.to_owned(), json)]);
        let views = self
            .tensors
            .iter()
            .map(|(name, tensor)| (name, F32View(tensor)));
        write_atomically(path, |file| {
            safetensors::serialize_to_file(views, Some(metadata), file).map_err(|source| {
                match source {
                    SafeTensorError::IoError(source) => source,
                    other => io::Error::other(other),
                }
            })
        })
    }

    /// Reads the table of a file, without its tensors.
    ///
    /// # Errors
    /// The file cannot be read, is damaged or has no such table.
    pub(crate) fn read_table<M: DeserializeOwned>(path: &Path) -> Result<M, PlannerError> {
        /// The part of a safetensors header that is asked for here.
        #[derive(serde::Deserialize)]
        struct Header {
            #[serde(rename = "__metadata__")]
            metadata: Option<HashMap<String, String>>,
        }
        let read = || -> io::Result<Vec<u8>> {
            let mut file = fs::File::open(path)?;
            let mut bytes = vec![0; 8];
            file.read_exact(&mut bytes)?;
            let length = bytes
                .iter()
                .rev()
                .fold(0, |n, byte| n << 8 | u64::from(*byte));
            file.take(length.min(MOST_HEADER)).read_to_end(&mut bytes)?;
            Ok(bytes)
        };
        let bytes = read().map_err(|source| PlannerError::File {
            path: path.to_owned(),
            action: "read",
            source,
        })?;
        let header: Result<Header, _> = serde_json::from_slice(&bytes[8..]);
        let header = header.map_err(|source| PlannerError::Json {
            path: path.to_owned(),
            source,
        })?;
        table(path, header.metadata.as_ref())
    }

    /// Reads a file and its table.
    ///
    /// # Errors
    /// The file cannot be read, is damaged, has no table or tensors of another type than f32.
    pub(crate) fn read<M: DeserializeOwned>(path: &Path) -> Result<(Self, M), PlannerError> {
        let bytes = fs::read(path).map_err(|source| PlannerError::File {
            path: path.to_owned(),
            action: "read",
            source,
        })?;
        let damaged = |source| PlannerError::Safetensors {
            path: path.to_owned(),
            source,
        };
        let mismatch = |what: String, expected: &str, found: String| PlannerError::Mismatch {
            path: path.to_owned(),
            what,
            expected: expected.to_owned(),
            found,
        };
        let file = SafeTensors::deserialize(&bytes).map_err(damaged)?;
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(damaged)?;
        let metadata = table(path, header.metadata().as_ref())?;
        let mut tensors = BTreeMap::new();
        for (name, view) in file.iter() {
            if view.dtype() != Dtype::F32 {
                let found = format!("{:?}", view.dtype());
                return Err(mismatch(
                    format!("the type of tensor \"{name}\""),
                    "F32",
                    found,
                ));
            }
            let numbers = view.data().as_chunks::<4>().0.iter();
            let tensor = Tensor {
                shape: view.shape().to_vec(),
                values: numbers.map(|bytes| f32::from_le_bytes(*bytes)).collect(),
            };
            tensors.insert(name.to_owned(), tensor);
        }
        Ok((Self { tensors }, metadata))
    }
}

/// The table beside the tensors.
fn table<M: DeserializeOwned>(
    path: &Path,
    metadata: Option<&HashMap<String, String>>,
) -> Result<M, PlannerError> {
    let Some(table) = metadata.and_then(|table| table.get(METADATA_KEY)) else {
        return Err(PlannerError::Mismatch {
            path: path.to_owned(),
            what: "its metadata".to_owned(),
            expected: "a table under the key \"ksim\"".to_owned(),
            found: "none: the file is of another program".to_owned(),
        });
    };
    serde_json::from_str(table).map_err(|source| PlannerError::Json {
        path: path.to_owned(),
        source,
    })
}

/// Writes a file beside `path` and puts it in its place once it is whole and on disk.
pub(crate) fn write_atomically(
    path: &Path,
    write: impl FnOnce(&Path) -> io::Result<()>,
) -> Result<(), PlannerError> {
    let failed = |source| PlannerError::File {
        path: path.to_owned(),
        action: "write",
        source,
    };
    let folder = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty());
    let temporary = named(folder.unwrap_or(Path::new("."))).map_err(failed)?;
    write(temporary.path()).map_err(failed)?;
    settle(&temporary).map_err(failed)?;
    temporary
        .persist(path)
        .map_err(|error| failed(error.error))?;
    Ok(())
}

/// Brings what was written to disk. The writer may have put another file in the place of the one that was opened, as
/// safetensors does, which then gets the same permissions.
fn settle(temporary: &NamedTempFile) -> io::Result<()> {
    let permissions = temporary.as_file().metadata()?.permissions();
    let written = fs::File::open(temporary.path())?;
    written.set_permissions(permissions)?;
    written.sync_all()
}

/// A temporary file that others may read as any file of the user's.
fn named(folder: &Path) -> io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

/// A tensor as safetensors writes it.
struct F32View<'a>(&'a Tensor);

impl View for F32View<'_> {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        &self.0.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        self.0
            .values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect()
    }

    fn data_len(&self) -> usize {
        self.0.values.len() * size_of::<f32>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file() -> TensorFile {
        let tensor = |values: &[f32]| Tensor {
            shape: vec![values.len()],
            values: values.to_vec(),
        };
        TensorFile {
            tensors: BTreeMap::from([
                ("a.x".to_owned(), tensor(&[1.0, -0.5])),
                ("a.y".to_owned(), tensor(&[f32::MIN_POSITIVE])),
                ("ab.x".to_owned(), tensor(&[])),
            ]),
        }
    }

    #[test]
    fn what_is_written_is_read_again() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("some.safetensors");
        file().write(&path, &[1, 2]).expect("written");
        let (read, table): (TensorFile, Vec<i32>) = TensorFile::read(&path).expect("read");
        assert_eq!((read, table), (file(), vec![1, 2]));
        let plain = folder.path().join("plain");
        fs::write(&plain, b"").expect("written");
        let permissions = |path: &Path| fs::metadata(path).expect("file").permissions();
        assert_eq!(permissions(&path), permissions(&plain));
    }

    #[test]
    fn a_prefix_takes_only_its_own() {
        let mut file = file();
        let taken = file.take("a");
        assert_eq!(taken.tensors.keys().collect::<Vec<_>>(), ["x", "y"]);
        assert_eq!(file.tensors.keys().collect::<Vec<_>>(), ["ab.x"]);
    }

    #[test]
    fn a_cut_file_is_refused_and_named() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("cut.safetensors");
        file().write(&path, &0).expect("written");
        let bytes = fs::read(&path).expect("read");
        for length in [0, 7, bytes.len() / 2, bytes.len() - 1] {
            fs::write(&path, &bytes[..length]).expect("written");
            let error = TensorFile::read::<i32>(&path).expect_err("cut").to_string();
            assert!(error.contains("cut.safetensors: damaged"), "{error}");
        }
    }

    #[test]
    fn a_failed_write_keeps_the_old_file() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("kept.safetensors");
        file().write(&path, &0).expect("written");
        let full = write_atomically(&path, |file| {
            fs::write(file, b"half")?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        });
        assert!(
            full.expect_err("full")
                .to_string()
                .contains("kept.safetensors: cannot write")
        );
        assert!(TensorFile::read::<i32>(&path).is_ok());
        assert_eq!(fs::read_dir(folder.path()).expect("folder").count(), 1);
    }
}
