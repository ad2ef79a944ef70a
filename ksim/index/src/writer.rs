//! Writes sections one after the other, with their checksums.

use std::io::Write;

use crate::error::IndexError;
use crate::format::{self, Entry, FRAME};

/// An index in the making. Only what [`finish`](Self::finish) completes can be opened.
pub(crate) struct SectionWriter<W: Write> {
    out: W,
    offset: u64,
    entries: Vec<Entry>,
    hasher: blake3::Hasher,
}

impl<W: Write> SectionWriter<W> {
    pub(crate) fn new(out: W) -> Result<Self, IndexError> {
        let mut writer = Self {
            out,
            offset: 0,
            entries: Vec::new(),
            hasher: blake3::Hasher::new(),
        };
        writer.put(&format::header())?;
        debug_assert_eq!(writer.offset, FRAME as u64);
        Ok(writer)
    }

    /// Begins a section, the name of which has at most 16 bytes.
    pub(crate) fn begin(&mut self, name: &str) -> Result<(), IndexError> {
        let gap = vec![0; format::gap(self.offset)];
        self.put(&gap)?;
        self.hasher.reset();
        self.entries.push(Entry {
            name: name.to_owned(),
            offset: self.offset,
            len: 0,
            hash: [0; 32],
        });
        Ok(())
    }

    /// Appends to the section that was begun last.
    pub(crate) fn append(&mut self, bytes: &[u8]) -> Result<(), IndexError> {
        self.hasher.update_rayon(bytes);
        self.put(bytes)?;
        if let Some(entry) = self.entries.last_mut() {
            entry.len += bytes.len() as u64;
            entry.hash = *self.hasher.finalize().as_bytes();
        }
        Ok(())
    }

    /// A whole section. One without content is none.
    pub(crate) fn section(&mut self, name: &str, bytes: &[u8]) -> Result<(), IndexError> {
        self.begin(name)?;
        self.append(bytes)
    }

    /// What has been written is in the file afterwards.
    pub(crate) fn flush(&mut self) -> Result<(), IndexError> {
        self.out.flush().map_err(IndexError::io("write the index"))
    }

    /// Where a section lies.
    pub(crate) fn entry(&self, name: &'static str) -> Result<&Entry, IndexError> {
        let found = self.entries.iter().find(|entry| entry.name == name);
        found.ok_or(IndexError::NoSection { name })
    }

    /// Directory and footer.
    pub(crate) fn finish(mut self) -> Result<(), IndexError> {
        let end = format::end(&self.entries, self.offset);
        self.put(&end)?;
        self.flush()
    }

    fn put(&mut self, bytes: &[u8]) -> Result<(), IndexError> {
        let written = self.out.write_all(bytes);
        written.map_err(IndexError::io("write the index"))?;
        self.offset += bytes.len() as u64;
        Ok(())
    }
}
