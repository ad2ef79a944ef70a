//! One array of an archive.

use std::path::{Path, PathBuf};

use npyz::{DType, Endianness, NpyHeader, Order, TypeChar};

use super::archive::{Entry, Stream};
use crate::error::{DatasetError, Result};
use crate::formats::steps::{ArrayInfo, Element, LeafBuilder};
use crate::guard;

/// Bytes of a header, at most; NumPy itself stops at 10,000 characters.
const MAX_HEADER: usize = 64 << 10;
/// Nesting of a header, at most: its parser calls itself for every bracket.
const MAX_NESTING: usize = 16;
/// Bytes of an array in Fortran order, at most: its rows lie scattered, so it is read whole.
const MAX_FORTRAN: u64 = 1 << 30;
/// Values in one row, at most (Arrow's list sizes are `i32`).
const MAX_ROW_WIDTH: u64 = i32::MAX as u64;
/// Bytes read at a time.
const BYTES_AT_ONCE: usize = 1 << 20;

/// An array, by its header.
#[derive(Debug, Clone)]
pub(super) struct NpyArray {
    pub(super) info: ArrayInfo,
    path: PathBuf,
    entry: Entry,
    /// Where the values start in the entry.
    start: u64,
    is_big_endian: bool,
    is_fortran: bool,
}

/// What an entry holds.
pub(super) enum Found {
    Array(NpyArray),
    /// An array that no column can be made of.
    Other {
        /// Its type.
        actual: String,
    },
}

impl NpyArray {
    /// Reads the header of an entry.
    ///
    /// # Errors
    /// It is damaged, holds Python objects, or declares other sizes than the entry has.
    pub(super) fn open(path: &Path, entry: &Entry, key: &str) -> Result<Found> {
        let (header, start) = header(path, entry, key)?;
        if header.uses_pickled_array() {
            return Err(DatasetError::Unsupported {
                what: format!("\"{key}\" holds Python objects, which are never unpickled"),
            });
        }
        let dtype = header.dtype();
        let other = || {
            Ok(Found::Other {
                actual: dtype.descr(),
            })
        };
        let Some((element, is_big_endian)) = element(&dtype) else {
            return other();
        };
        let Some((&n_rows, row)) = header.shape().split_first() else {
            return other();
        };
        let width = row.iter().try_fold(1u64, |n, &dim| n.checked_mul(dim));
        let width = width.filter(|width| *width <= MAX_ROW_WIDTH);
        let row_bytes = width.and_then(|width| width.checked_mul(element.n_bytes() as u64));
        let declared = row_bytes.and_then(|bytes| bytes.checked_mul(n_rows));
        let (Some(declared), Ok(row_shape)) =
            (declared, row.iter().map(|&d| usize::try_from(d)).collect())
        else {
            return Err(DatasetError::corrupt(format!(
                "\"{key}\" declares more values than can be"
            )));
        };
        if declared.checked_add(start) != Some(entry.size) {
            let size = entry.size - start.min(entry.size);
            let what = format!("\"{key}\" declares {declared} bytes of values, but has {size}");
            return Err(DatasetError::corrupt(what));
        }
        let info = ArrayInfo {
            key: key.to_owned(),
            element,
            n_rows,
            row_shape,
        };
        Ok(Found::Array(Self {
            // One value a row lies in the same order either way.
            is_fortran: header.order() == Order::Fortran && info.width() > 1,
            info,
            path: path.to_owned(),
            entry: entry.clone(),
            start,
            is_big_endian,
        }))
    }
}

/// The header of an entry and its length.
fn header(path: &Path, entry: &Entry, key: &str) -> Result<(NpyHeader, u64)> {
    let damaged = |what: &str| DatasetError::corrupt(format!("the header of \"{key}\": {what}"));
    let mut stream = Stream::open(path, entry)?;
    let mut bytes = vec![0; 10];
    stream.read(&mut bytes)?;
    let n = match bytes[6] {
        1 => usize::from(u16::from_le_bytes([bytes[8], bytes[9]])),
        _ => {
            bytes.resize(12, 0);
            stream.read(&mut bytes[10..])?;
            let length = [bytes[8], bytes[9], bytes[10], bytes[11]];
            usize::try_from(u32::from_le_bytes(length)).unwrap_or(usize::MAX)
        }
    };
    if n > MAX_HEADER {
        return Err(damaged("it is longer than a header can be"));
    }
    let before = bytes.len();
    bytes.resize(before + n, 0);
    stream.read(&mut bytes[before..])?;
    let mut depth = 0usize;
    for byte in &bytes[before..] {
        match byte {
            b'(' | b'[' | b'{' => depth += 1,
            b')' | b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > MAX_NESTING {
            return Err(damaged("it is nested too deep"));
        }
    }
    let header = guard::decode(|| {
        NpyHeader::from_reader(bytes.as_slice()).map_err(|error| damaged(&error.to_string()))
    })?;
    Ok((header, stream.position()))
}

/// Type of the values, and whether their bytes are in big-endian order.
fn element(dtype: &DType) -> Option<(Element, bool)> {
    let DType::Plain(plain) = dtype else {
        return None;
    };
    let element = match (plain.type_char(), plain.size_field()) {
        (TypeChar::Bool, 1) => Element::Bool,
        (TypeChar::Int, 1) => Element::I8,
        (TypeChar::Int, 2) => Element::I16,
        (TypeChar::Int, 4) => Element::I32,
        (TypeChar::Int, 8) => Element::I64,
        (TypeChar::Uint, 1) => Element::U8,
        (TypeChar::Uint, 2) => Element::U16,
        (TypeChar::Uint, 4) => Element::U32,
        (TypeChar::Uint, 8) => Element::U64,
        (TypeChar::Float, 2) => Element::F16,
        (TypeChar::Float, 4) => Element::F32,
        (TypeChar::Float, 8) => Element::F64,
        _ => return None,
    };
    Some((element, plain.endianness() == Endianness::Big))
}

/// The rows of an array, cheapest when read in order.
pub(super) struct Rows {
    array: NpyArray,
    stream: Stream,
    /// The row the stream stands at.
    next: u64,
    /// The row before it: some episode rules take a row twice.
    last: Vec<u8>,
    /// All rows, of an array in Fortran order.
    whole: Option<Vec<u8>>,
}

impl Rows {
    /// Starts at the first row.
    ///
    /// # Errors
    /// The file cannot be read, or the array is in Fortran order and too large for that.
    pub(super) fn open(array: &NpyArray) -> Result<Self> {
        let mut stream = Stream::open(&array.path, &array.entry)?;
        stream.skip(array.start)?;
        let whole = array
            .is_fortran
            .then(|| read_fortran(array, &mut stream))
            .transpose()?;
        Ok(Self {
            array: array.clone(),
            stream,
            next: 0,
            last: Vec::new(),
            whole,
        })
    }

    fn row_bytes(&self) -> usize {
        self.array.info.width() * self.array.info.element.n_bytes()
    }

    /// Appends rows `start..start + n` to the builder.
    ///
    /// # Errors
    /// They are not there, or the entry is damaged.
    pub(super) fn append(&mut self, start: u64, n: usize, to: &mut LeafBuilder) -> Result<()> {
        let end = start.saturating_add(n as u64);
        if end > self.array.info.n_rows {
            return Err(DatasetError::LengthMismatch {
                key: self.array.info.key.clone(),
                actual: self.array.info.n_rows,
                expected: end,
            });
        }
        let (mut start, row_bytes) = (start, self.row_bytes());
        if let Some(whole) = &self.whole {
            let from = usize::try_from(start)
                .unwrap_or(usize::MAX)
                .saturating_mul(row_bytes);
            let rows = whole
                .get(from..from.saturating_add(n * row_bytes))
                .unwrap_or_default();
            return to.append_bytes(rows, n, self.array.is_big_endian);
        }
        if n > 0 && start + 1 == self.next && self.last.len() == row_bytes {
            to.append_bytes(&self.last, 1, self.array.is_big_endian)?;
            start += 1;
        }
        if n > 0 && start < self.next {
            let array = self.array.clone();
            *self = Self::open(&array)?;
        }
        self.go_to(start)?;
        let at_once = (BYTES_AT_ONCE / row_bytes).max(1) as u64;
        while self.next < end {
            let part = usize::try_from(at_once.min(end - self.next)).unwrap_or(1);
            let mut bytes = vec![0; part * row_bytes];
            self.stream.read(&mut bytes)?;
            self.next += part as u64;
            to.append_bytes(&bytes, part, self.array.is_big_endian)?;
            self.last = bytes.split_off(bytes.len() - row_bytes);
        }
        Ok(())
    }

    /// Passes over the rows up to `row`, so that the checksum of a whole pass is compared.
    ///
    /// # Errors
    /// The entry is damaged.
    pub(super) fn go_to(&mut self, row: u64) -> Result<()> {
        let rows = row.saturating_sub(self.next);
        if rows > 0 && self.whole.is_none() {
            self.stream
                .skip(rows.saturating_mul(self.row_bytes() as u64))?;
            self.next = row;
            self.last.clear();
        }
        Ok(())
    }
}

/// All rows of an array in Fortran order, one after another.
fn read_fortran(array: &NpyArray, stream: &mut Stream) -> Result<Vec<u8>> {
    let size = array.entry.size - array.start;
    if size > MAX_FORTRAN {
        return Err(DatasetError::Unsupported {
            what: format!(
                "\"{}\" is in Fortran order and has {size} bytes, more than {MAX_FORTRAN}",
                array.info.key
            ),
        });
    }
    let n_bytes = usize::try_from(size).unwrap_or(0);
    let mut columns = vec![0; n_bytes];
    stream.read(&mut columns)?;
    let mut rows = vec![0; n_bytes];
    let value = array.info.element.n_bytes();
    let shape = &array.info.row_shape;
    let n_rows = usize::try_from(array.info.n_rows).unwrap_or(0);
    for (inner, at) in fortran_places(shape).into_iter().enumerate() {
        for row in 0..n_rows {
            let from = (row + n_rows * at) * value;
            let to = (row * array.info.width() + inner) * value;
            rows[to..to + value].copy_from_slice(&columns[from..from + value]);
        }
    }
    Ok(rows)
}

/// For the values of a row in C order, their places in Fortran order.
fn fortran_places(shape: &[usize]) -> Vec<usize> {
    let width = shape.iter().product();
    let place = |inner: usize| {
        let (mut rest, mut at) = (inner, 0);
        let mut strides: Vec<usize> = Vec::with_capacity(shape.len());
        shape.iter().fold(1, |stride, dim| {
            strides.push(stride);
            stride * dim
        });
        for (dim, stride) in shape.iter().zip(&strides).rev() {
            at += rest % dim * stride;
            rest /= dim;
        }
        at
    };
    (0..width).map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_fortran_order() {
        // Row values (i, j) of a 2 × 3 row: Fortran counts i first.
        assert_eq!(fortran_places(&[2, 3]), [0, 2, 4, 1, 3, 5]);
        assert_eq!(fortran_places(&[4]), [0, 1, 2, 3]);
    }
}
