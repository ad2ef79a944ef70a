//! The file's frame: header, directory, footer. See the crate's documentation.

use crate::error::IndexError;

/// Version of the format. What reads one version reads no other.
pub const VERSION: u32 = 1;

/// Begins with a byte that is no text and holds a line end, so that transfers as text show.
const MAGIC: [u8; 8] = *b"\x89KSIMIX\n";
const END_MAGIC: [u8; 8] = *b"KSIMEND\n";

/// Bytes of the header, of a directory entry, and of the footer.
pub(crate) const FRAME: usize = 64;
/// Sections begin at multiples of this: the page of most machines.
pub(crate) const ALIGNMENT: usize = 4096;

/// Sections of the rounded rows, in file order; see [`ksim::RoundedRows`] for what is in them.
pub(crate) const ROWS: [&str; 8] = [
    "rows.scale",
    "rows.strips",
    "rows.order",
    "rows.starts",
    "rows.errors",
    "rows.clipped",
    "rows.levels",
    "rows.norm",
];
/// The same, by clusters.
pub(crate) const CELLS: [&str; 8] = [
    "cells.scale",
    "cells.strips",
    "cells.order",
    "cells.starts",
    "cells.errors",
    "cells.clipped",
    "cells.levels",
    "cells.norm",
];

/// Bytes of a section's name.
const NAME: usize = 16;

/// A section as the directory has it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Entry {
    pub(crate) name: String,
    pub(crate) offset: u64,
    pub(crate) len: u64,
    pub(crate) hash: [u8; 32],
}

impl Entry {
    fn encode(&self) -> [u8; FRAME] {
        let mut bytes = [0; FRAME];
        let name = self.name.as_bytes();
        bytes[..name.len()].copy_from_slice(name);
        bytes[NAME..NAME + 8].copy_from_slice(&self.offset.to_le_bytes());
        bytes[NAME + 8..NAME + 16].copy_from_slice(&self.len.to_le_bytes());
        bytes[NAME + 16..].copy_from_slice(&self.hash);
        bytes
    }

    fn decode(bytes: &[u8]) -> Option<Self> {
        let name = bytes.get(..NAME)?;
        let end = name.iter().position(|&byte| byte == 0).unwrap_or(NAME);
        Some(Self {
            name: std::str::from_utf8(&name[..end]).ok()?.to_owned(),
            offset: number(bytes, NAME)?,
            len: number(bytes, NAME + 8)?,
            hash: bytes.get(NAME + 16..FRAME)?.try_into().ok()?,
        })
    }
}

fn number(bytes: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.get(at..at + 8)?.try_into().ok()?))
}

/// The header.
pub(crate) fn header() -> [u8; FRAME] {
    let mut bytes = [0; FRAME];
    bytes[..8].copy_from_slice(&MAGIC);
    bytes[8..12].copy_from_slice(&VERSION.to_le_bytes());
    bytes[12..16].copy_from_slice(&(ALIGNMENT as u32).to_le_bytes());
    bytes
}

/// Zeros from `offset` to where the next section may begin.
pub(crate) fn gap(offset: u64) -> usize {
    (offset.next_multiple_of(ALIGNMENT as u64) - offset) as usize
}

/// Directory and footer, for a directory that begins at `offset`.
pub(crate) fn end(entries: &[Entry], offset: u64) -> Vec<u8> {
    let mut bytes: Vec<u8> = entries.iter().flat_map(Entry::encode).collect();
    let hash = frame_hash(&header(), &bytes);
    bytes.extend(offset.to_le_bytes());
    bytes.extend((entries.len() as u32).to_le_bytes());
    bytes.extend([0; 4]);
    bytes.extend(hash);
    bytes.extend([0; 8]);
    bytes.extend(END_MAGIC);
    bytes
}

fn frame_hash(header: &[u8], directory: &[u8]) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(header).update(directory);
    *hasher.finalize().as_bytes()
}

/// Reads the frame of a whole file and checks everything but the sections' content.
pub(crate) fn read(file: &[u8]) -> Result<Vec<Entry>, IndexError> {
    let n_bytes = file.len() as u64;
    if !file.starts_with(&MAGIC) {
        return Err(IndexError::NotAnIndex);
    }
    let truncated = || IndexError::Truncated { n_bytes };
    let head = file.get(..FRAME).ok_or_else(truncated)?;
    let version = u32::from_le_bytes([head[8], head[9], head[10], head[11]]);
    if version != VERSION {
        return Err(IndexError::Version {
            found: version,
            expected: VERSION,
        });
    }
    if file.len() < 2 * FRAME || !file.ends_with(&END_MAGIC) {
        return Err(truncated());
    }
    let foot_at = file.len() - FRAME;
    let foot = &file[foot_at..];
    let damaged = |part: &str, offset: u64| IndexError::Damaged {
        part: part.to_owned(),
        offset,
    };
    let footer = || damaged("the footer", foot_at as u64);
    let start = number(foot, 0).ok_or_else(footer)?;
    let n_sections = u32::from_le_bytes([foot[8], foot[9], foot[10], foot[11]]);
    let length = u64::from(n_sections) * FRAME as u64;
    let fits = start >= FRAME as u64 && start.checked_add(length) == Some(foot_at as u64);
    let zeros = |bytes: &[u8]| bytes.iter().all(|&byte| byte == 0);
    if !fits || !zeros(&foot[12..16]) || !zeros(&foot[48..56]) {
        return Err(footer());
    }
    let directory = &file[start as usize..foot_at];
    if head != header() || frame_hash(head, directory) != foot[16..48] {
        return Err(damaged("header or directory", start));
    }
    let entries: Option<Vec<Entry>> = directory.chunks_exact(FRAME).map(Entry::decode).collect();
    let entries = entries.ok_or_else(|| damaged("the directory", start))?;
    // Sections follow each other, with nothing but zeros between them.
    let mut next = FRAME as u64;
    for entry in &entries {
        let end = entry.offset.checked_add(entry.len);
        let in_order = entry.offset == next.next_multiple_of(ALIGNMENT as u64)
            && end.is_some_and(|end| end <= start);
        if !in_order || !zeros(&file[next as usize..entry.offset as usize]) {
            return Err(damaged("what is before a section", next));
        }
        next = entry.offset + entry.len;
    }
    match next == start {
        true => Ok(entries),
        false => Err(damaged("what is before the directory", next)),
    }
}
