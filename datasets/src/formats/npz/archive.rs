//! The entries of an archive, and their bytes in order.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Take};
use std::path::{Path, PathBuf};

use flate2::Crc;
use flate2::read::DeflateDecoder;
use zip::{CompressionMethod, ZipArchive};

use crate::error::{DatasetError, Result};
use crate::guard;

/// How many times its packed size an entry may declare to be: deflate cannot shrink data by more than 1032.
const MAX_RATIO: u64 = 1100;
/// Declared bytes that are always believed.
const ALWAYS_ALLOWED: u64 = 1 << 20;
/// Arrays of an archive, at most.
const MAX_ENTRIES: usize = 4096;
const BUFFER: usize = 64 << 10;

/// An open archive: where its entries lie.
pub(super) struct Archive {
    pub(super) path: PathBuf,
    pub(super) entries: Vec<Entry>,
}

/// One entry, its sizes checked.
#[derive(Debug, Clone)]
pub(super) struct Entry {
    pub(super) name: String,
    /// Bytes when unpacked.
    pub(super) size: u64,
    packed_size: u64,
    start: u64,
    is_deflated: bool,
    crc: u32,
}

impl Archive {
    /// Reads the directory of an archive.
    ///
    /// # Errors
    /// It is damaged, or has entries that are encrypted, packed in another way than by deflate, or that declare
    /// more than can be in them.
    pub(super) fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(|e| DatasetError::io("open", e))?;
        let size = file
            .metadata()
            .map_err(|e| DatasetError::io("open", e))?
            .len();
        let entries = guard::decode(|| entries(file, size))?;
        Ok(Self {
            path: path.to_owned(),
            entries,
        })
    }
}

fn entries(file: File, file_size: u64) -> Result<Vec<Entry>> {
    let damaged = |what: &str, error: zip::result::ZipError| {
        DatasetError::corrupt(format!("{what} ({file_size} bytes): {error}"))
    };
    let archive = ZipArchive::new(BufReader::new(file));
    let mut archive = archive.map_err(|e| damaged("not a whole zip archive", e))?;
    if archive.len() > MAX_ENTRIES {
        let n = archive.len();
        return Err(DatasetError::corrupt(format!("an archive of {n} arrays")));
    }
    let mut entries = Vec::with_capacity(archive.len());
    let mut declared = 0u64;
    for place in 0..archive.len() {
        let file = archive
            .by_index_raw(place)
            .map_err(|e| damaged("a damaged zip archive", e))?;
        let name = file
            .name()
            .map_err(|e| damaged("a damaged zip archive", e))?
            .into_owned();
        let unsupported = |what: &str| DatasetError::Unsupported {
            what: format!("\"{name}\" is {what}"),
        };
        let is_deflated = match file.compression() {
            _ if file.encrypted() => return Err(unsupported("encrypted")),
            CompressionMethod::Stored => false,
            CompressionMethod::Deflated => true,
            other => return Err(unsupported(&format!("packed by {other}, not by deflate"))),
        };
        let start = file.data_start().unwrap_or(u64::MAX);
        let entry = Entry {
            size: file.size(),
            packed_size: file.compressed_size(),
            start,
            is_deflated,
            crc: file.crc32(),
            name: name.clone(),
        };
        // Entries may claim the same bytes, so their sum counts as well.
        declared = declared.saturating_add(entry.size);
        entry.check(declared, file_size)?;
        entries.push(entry);
    }
    Ok(entries)
}

impl Entry {
    fn check(&self, declared: u64, file_size: u64) -> Result<()> {
        let end = self.start.checked_add(self.packed_size);
        if end.is_none_or(|end| end > file_size)
            || (!self.is_deflated && self.size != self.packed_size)
        {
            return Err(DatasetError::corrupt(format!(
                "\"{}\" lies outside the archive ({file_size} bytes)",
                self.name
            )));
        }
        let allowed = |packed: u64| {
            packed
                .saturating_mul(MAX_RATIO)
                .saturating_add(ALWAYS_ALLOWED)
        };
        if self.size > allowed(self.packed_size) || declared > allowed(file_size) {
            return Err(DatasetError::DeclaredSize {
                key: self.name.clone(),
                declared: declared.max(self.size).into(),
                file_size,
                max_ratio: MAX_RATIO,
            });
        }
        Ok(())
    }
}

/// The bytes of an entry, read from the start to the end. The checksum is compared at the end, unless bytes of
/// an entry that is not packed were skipped, which are not read.
pub(super) struct Stream {
    entry: Entry,
    inner: Inner,
    position: u64,
    crc: Option<Crc>,
}

enum Inner {
    Stored(BufReader<File>),
    Deflated(DeflateDecoder<BufReader<Take<File>>>),
}

impl Stream {
    /// Starts at the first byte.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub(super) fn open(path: &Path, entry: &Entry) -> Result<Self> {
        let mut file = File::open(path).map_err(|e| DatasetError::io("open", e))?;
        file.seek(SeekFrom::Start(entry.start))
            .map_err(|e| DatasetError::io("read", e))?;
        let inner = if entry.is_deflated {
            Inner::Deflated(DeflateDecoder::new(BufReader::new(
                file.take(entry.packed_size),
            )))
        } else {
            Inner::Stored(BufReader::new(file))
        };
        Ok(Self {
            entry: entry.clone(),
            inner,
            position: 0,
            crc: Some(Crc::new()),
        })
    }

    pub(super) fn position(&self) -> u64 {
        self.position
    }

    /// Fills `bytes`.
    ///
    /// # Errors
    /// There are fewer, they cannot be unpacked, or the checksum is another.
    pub(super) fn read(&mut self, bytes: &mut [u8]) -> Result<()> {
        let end = self.position.saturating_add(bytes.len() as u64);
        if end > self.entry.size {
            return Err(self.damaged("ends too early"));
        }
        let read = match &mut self.inner {
            Inner::Stored(file) => file.read_exact(bytes),
            Inner::Deflated(file) => file.read_exact(bytes),
        };
        read.map_err(|error| self.damaged(&error.to_string()))?;
        self.position = end;
        if let Some(crc) = &mut self.crc {
            crc.update(bytes);
        }
        if end == self.entry.size {
            self.check_end()?;
        }
        Ok(())
    }

    /// Passes over `n` bytes.
    ///
    /// # Errors
    /// As for [`Self::read`].
    pub(super) fn skip(&mut self, n: u64) -> Result<()> {
        let mut left = n;
        if let Inner::Stored(file) = &mut self.inner
            && n > BUFFER as u64
        {
            let by =
                i64::try_from(n).map_err(|_| DatasetError::corrupt("an offset out of range"))?;
            file.seek_relative(by)
                .map_err(|e| DatasetError::io("read", e))?;
            (self.crc, self.position, left) = (None, self.position + n, 0);
        }
        let mut buffer = [0; BUFFER];
        while left > 0 {
            let part = usize::try_from(left).unwrap_or(BUFFER).min(BUFFER);
            self.read(&mut buffer[..part])?;
            left -= part as u64;
        }
        Ok(())
    }

    fn check_end(&mut self) -> Result<()> {
        if self
            .crc
            .as_ref()
            .is_some_and(|crc| crc.sum() != self.entry.crc)
        {
            return Err(self.damaged("has another checksum than recorded"));
        }
        if let Inner::Deflated(file) = &mut self.inner {
            let more = file
                .read(&mut [0])
                .map_err(|e| DatasetError::io("read", e))?;
            if more > 0 {
                return Err(self.damaged("unpacks to more than it declares"));
            }
        }
        Ok(())
    }

    fn damaged(&self, what: &str) -> DatasetError {
        DatasetError::corrupt(format!(
            "\"{}\" at byte {} of {}: {what}",
            self.entry.name, self.position, self.entry.size
        ))
    }
}
