//! Reading the fields of a record. Every length is checked against the bytes that are there.

use std::collections::BTreeMap;

use crate::error::{DatasetError, Result};

/// A record's bytes, taken from the front.
pub(super) struct Body<'a> {
    rest: &'a [u8],
    what: &'static str,
    offset: u64,
}

impl<'a> Body<'a> {
    /// `what` and the record's `offset` in the file are for messages.
    pub(super) fn new(bytes: &'a [u8], what: &'static str, offset: u64) -> Self {
        Self {
            rest: bytes,
            what,
            offset,
        }
    }

    pub(super) fn error(&self, reason: &str) -> DatasetError {
        DatasetError::corrupt(format!(
            "the {} at offset {} {reason}",
            self.what, self.offset
        ))
    }

    pub(super) fn rest(&self) -> &'a [u8] {
        self.rest
    }

    pub(super) fn bytes(&mut self, n: usize) -> Result<&'a [u8]> {
        let (taken, rest) = self.rest.split_at_checked(n).ok_or_else(|| {
            self.error(&format!(
                "ends after {} bytes where {n} are expected",
                self.rest.len()
            ))
        })?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let bytes = self.bytes(N)?;
        bytes.try_into().map_err(|_| self.error("is cut short"))
    }

    pub(super) fn u16(&mut self) -> Result<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Result<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self) -> Result<u64> {
        self.array().map(u64::from_le_bytes)
    }

    /// Bytes after a 32-bit length.
    pub(super) fn sized(&mut self) -> Result<&'a [u8]> {
        let n = self.u32()?;
        self.bytes(usize::try_from(n).unwrap_or(usize::MAX))
    }

    pub(super) fn text(&mut self) -> Result<String> {
        let bytes = self.sized()?;
        match std::str::from_utf8(bytes) {
            Ok(text) => Ok(text.to_owned()),
            Err(_) => Err(self.error("holds text that is not UTF-8")),
        }
    }

    /// A map: a 32-bit length in bytes, then its entries.
    pub(super) fn map<K: Ord, V>(
        &mut self,
        entry: impl Fn(&mut Self) -> Result<(K, V)>,
    ) -> Result<BTreeMap<K, V>> {
        let bytes = self.sized()?;
        let mut inner = Self::new(bytes, self.what, self.offset);
        let mut map = BTreeMap::new();
        while !inner.rest.is_empty() {
            let (key, value) = entry(&mut inner)?;
            if map.insert(key, value).is_some() {
                return Err(self.error("holds a map with a key twice"));
            }
        }
        Ok(map)
    }

    pub(super) fn text_map(&mut self) -> Result<BTreeMap<String, String>> {
        self.map(|body| Ok((body.text()?, body.text()?)))
    }
}
