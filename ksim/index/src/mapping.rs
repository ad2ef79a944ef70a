//! Files in memory: the only unsafe code of this crate.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;
use memmap2::Mmap;

/// A whole file, mapped for reading.
#[derive(Debug, Clone)]
pub(crate) struct Mapping(Arc<Mmap>);

impl Mapping {
    /// Maps a file that is not empty.
    pub(crate) fn new(file: &File) -> io::Result<Self> {
        #[expect(unsafe_code, reason = "mapping a file is unsafe whoever does it")]
        // SAFETY: the mapping is read as plain numbers only. It would be unsound if the file changed or shrank
        // meanwhile. The files mapped are unnamed temporary ones of this process, which are written before they are
        // mapped and never after, and indexes, which `ksim` puts in place by renaming a complete file and never
        // writes to again. Someone who edits an index in place while it is in use breaks this, as with any program
        // that maps its data; the checksums are computed over the mapping and show an edit before the use.
        let mmap = unsafe { Mmap::map(file) }?;
        Ok(Self(Arc::new(mmap)))
    }

    /// The whole file.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.0
    }

    /// A part of the file that keeps the mapping alive.
    pub(crate) fn share(&self, range: Range<usize>) -> Bytes {
        Bytes::from_owner(Shared(Arc::clone(&self.0))).slice(range)
    }

    /// Gives back the memory behind the whole file.
    pub(crate) fn release_all(&self) {
        self.release(0..self.0.len());
    }

    /// Gives back the memory behind a part: it is read again where it is used again. Nothing happens where the
    /// system has no such call.
    pub(crate) fn release(&self, range: Range<usize>) {
        #[cfg(unix)]
        if !range.is_empty() {
            #[expect(
                unsafe_code,
                reason = "this advice changes memory where a mapping is private"
            )]
            // SAFETY: the mapping is shared and read-only, backed by a file that does not change (see `new`): pages
            // that are dropped come back with the same content, so a borrow of them sees no change.
            let advised = unsafe {
                self.0.unchecked_advise_range(
                    memmap2::UncheckedAdvice::DontNeed,
                    range.start,
                    range.len(),
                )
            };
            // Memory stays in use if the advice is refused, which is no error.
            let _ = advised;
        }
        #[cfg(not(unix))]
        let _ = range;
    }
}

/// What a [`Bytes`] holds on to.
struct Shared(Arc<Mmap>);

impl AsRef<[u8]> for Shared {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}
