//! The container: an uncompressed zip archive.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use zip::{CompressionMethod, ZipArchive};

use super::error::ImportError;

/// Bytes of a file, at most: the largest network of the reference takes 130 MB.
const MAX_FILE: u64 = 2 << 30;
/// Bytes of its pickle, at most: 200 tensors take 40 kB.
const MAX_PICKLE: u64 = 1 << 20;
/// Entries, at most: one per tensor and a few more.
const MAX_ENTRIES: usize = 1 << 14;
/// Bytes of an entry's name, at most: a file's stem, which it bears, has at most 255.
const MAX_NAME: usize = 300;
/// What PyTorch writes into `version`, at most.
const MAX_VERSION: u64 = 10;
/// Bytes that are read in one go.
const BUFFER: usize = 64 << 10;

/// An open checkpoint file whose entries were checked: none is packed, and no byte belongs to two of them.
pub(super) struct Archive {
    path: PathBuf,
    zip: ZipArchive<BufReader<File>>,
    /// The folder in it that holds everything, with `/`.
    prefix: String,
}

impl Archive {
    /// Opens a file and checks its directory.
    pub(super) fn open(path: &Path) -> Result<Self, ImportError> {
        let io = |doing| move |source| ImportError::io(path, doing, source);
        let mut file = File::open(path).map_err(io("open"))?;
        let length = file.metadata().map_err(io("open"))?.len();
        if length > MAX_FILE {
            let problem = format!("{length} bytes, expected {MAX_FILE} at most");
            return Err(ImportError::archive(path, problem));
        }
        let mut start = Vec::with_capacity(4);
        let mut first = (&mut file).take(4);
        first.read_to_end(&mut start).map_err(io("read"))?;
        check_magic(path, &start)?;
        file.seek(SeekFrom::Start(0)).map_err(io("read"))?;
        let zip = ZipArchive::new(BufReader::with_capacity(BUFFER, file));
        let zip = zip.map_err(|error| damaged(path, &error))?;
        let mut archive = Self {
            path: path.to_owned(),
            zip,
            prefix: String::new(),
        };
        archive.check_entries(length)?;
        archive.prefix = archive.find_prefix()?;
        archive.check_texts()?;
        Ok(archive)
    }

    /// The pickle.
    pub(super) fn pickle(&mut self) -> Result<Vec<u8>, ImportError> {
        self.read("data.pkl", MAX_PICKLE)
    }

    /// Hands the bytes of a storage to `take`, piece by piece, if it has as many as expected.
    pub(super) fn storage(
        &mut self,
        key: &str,
        n_bytes: u64,
        mut take: impl FnMut(&[u8]),
    ) -> Result<(), ImportError> {
        let name = format!("{}data/{key}", self.prefix);
        let Some(index) = self.zip.index_for_name(&name) else {
            return Err(self.error(format!("\"{name}\" is missing, which its pickle names")));
        };
        let path = &self.path;
        let mut entry = self.zip.by_index(index).map_err(|e| damaged(path, &e))?;
        if entry.size() != n_bytes {
            let found = entry.size();
            let problem = format!("\"{name}\" has {found} bytes, its pickle says {n_bytes}");
            return Err(ImportError::archive(path, problem));
        }
        let mut piece = vec![0; BUFFER.min(usize::try_from(n_bytes).unwrap_or(BUFFER))];
        let mut left = n_bytes;
        while left > 0 {
            let n = piece.len().min(usize::try_from(left).unwrap_or(BUFFER));
            let read = entry.read_exact(&mut piece[..n]);
            read.map_err(|error| unreadable(path, &name, &error))?;
            take(&piece[..n]);
            left -= n as u64;
        }
        // The end is where the checksum is compared.
        let end = entry.read(&mut [0]);
        end.map_err(|error| unreadable(path, &name, &error))?;
        Ok(())
    }

    fn check_entries(&mut self, length: u64) -> Result<(), ImportError> {
        let path = self.path.clone();
        if self.zip.len() > MAX_ENTRIES {
            let n = self.zip.len();
            return Err(self.error(format!("{n} entries, expected {MAX_ENTRIES} at most")));
        }
        if self.zip.has_duplicate_names() {
            return Err(self.error("two entries have the same name"));
        }
        for index in 0..self.zip.len() {
            let entry = self.zip.by_index_raw(index);
            let entry = entry.map_err(|error| damaged(&path, &error))?;
            let name = entry.name().map_err(|error| damaged(&path, &error))?;
            if name.len() > MAX_NAME || name.chars().any(char::is_control) {
                let problem = format!(
                    "an entry's name has {} bytes or control characters, expected {MAX_NAME} at most and none",
                    name.len()
                );
                return Err(ImportError::archive(&path, problem));
            }
            let problem = if entry.encrypted() {
                "is encrypted".to_owned()
            } else if entry.compression() != CompressionMethod::Stored {
                format!(
                    "is packed ({}), which PyTorch never does",
                    entry.compression()
                )
            } else if entry.size() != entry.compressed_size() {
                format!(
                    "declares {} and {} bytes",
                    entry.size(),
                    entry.compressed_size()
                )
            } else if entry.size() > length {
                format!("declares {} bytes in a file of {length}", entry.size())
            } else {
                continue;
            };
            return Err(ImportError::archive(&path, format!("\"{name}\" {problem}")));
        }
        match self.zip.has_overlapping_files() {
            Ok(false) => Ok(()),
            Ok(true) => Err(self.error("two of its entries claim the same bytes")),
            Err(error) => Err(damaged(&path, &error)),
        }
    }

    /// The one folder that holds a `data.pkl`.
    fn find_prefix(&self) -> Result<String, ImportError> {
        let names = self.zip.file_names().flatten();
        let mut folders = names.filter_map(|name| {
            let folder = name.strip_suffix("data.pkl")?;
            let is_folder = folder.strip_suffix('/').is_some_and(|f| !f.contains('/'));
            is_folder.then(|| folder.to_owned())
        });
        match (folders.next(), folders.next()) {
            (Some(folder), None) => Ok(folder),
            (None, _) => Err(self.error("no folder/data.pkl in it: not a file of torch.save")),
            (Some(one), Some(other)) => {
                Err(self.error(format!("two checkpoints in it: \"{one}\" and \"{other}\"")))
            }
        }
    }

    fn check_texts(&mut self) -> Result<(), ImportError> {
        let version = self.read("version", 32)?;
        let number = str::from_utf8(&version).ok().map(str::trim_end);
        let number = number.and_then(|text| text.parse::<u64>().ok());
        if number.is_none_or(|number| number > MAX_VERSION) {
            let found = String::from_utf8_lossy(&version);
            let problem = format!("\"version\" is {found:?}, expected 1 to {MAX_VERSION}");
            return Err(self.error(problem));
        }
        // Older files have no such entry, and no big-endian machine wrote them.
        let name = format!("{}byteorder", self.prefix);
        if self.zip.index_for_name(&name).is_some() {
            let order = self.read("byteorder", 32)?;
            if order != b"little" {
                let found = String::from_utf8_lossy(&order);
                return Err(self.error(format!("byte order {found:?}, expected \"little\"")));
            }
        }
        Ok(())
    }

    /// A small entry as a whole.
    fn read(&mut self, name: &str, at_most: u64) -> Result<Vec<u8>, ImportError> {
        let name = format!("{}{name}", self.prefix);
        let Some(index) = self.zip.index_for_name(&name) else {
            return Err(self.error(format!("\"{name}\" is missing: not a file of torch.save")));
        };
        let path = &self.path;
        let mut entry = self.zip.by_index(index).map_err(|e| damaged(path, &e))?;
        if entry.size() > at_most {
            let found = entry.size();
            let problem = format!("\"{name}\" has {found} bytes, expected {at_most} at most");
            return Err(ImportError::archive(path, problem));
        }
        let mut bytes = Vec::with_capacity(usize::try_from(entry.size()).unwrap_or(0));
        let read = entry.read_to_end(&mut bytes);
        read.map_err(|error| unreadable(path, &name, &error))?;
        Ok(bytes)
    }

    fn error(&self, problem: impl Into<String>) -> ImportError {
        ImportError::archive(&self.path, problem)
    }
}

fn check_magic(path: &Path, start: &[u8]) -> Result<(), ImportError> {
    let problem = match start {
        b"PK\x03\x04" => return Ok(()),
        [0x80, ..] => {
            "a bare pickle, not a zip archive: PyTorch before 1.6 wrote it; load and save it with a newer one"
        }
        _ => "not a zip archive, as torch.save writes it",
    };
    Err(ImportError::archive(path, problem))
}

fn damaged(path: &Path, error: &zip::result::ZipError) -> ImportError {
    ImportError::archive(path, format!("not a whole zip archive: {error}"))
}

fn unreadable(path: &Path, name: &str, error: &std::io::Error) -> ImportError {
    ImportError::archive(path, format!("\"{name}\" cannot be read: {error}"))
}
