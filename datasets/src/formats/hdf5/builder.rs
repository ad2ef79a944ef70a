//! Reading rows of an HDF5 array into a column.

use arrow::array::StringBuilder;
use hdf5::types::{VarLenArray, VarLenAscii, VarLenUnicode};
use hdf5_metno as hdf5;

use super::array::Array;
use crate::error::{DatasetError, Result};
use crate::formats::steps::{Element, LeafBuilder, Values};

/// Start of a JPEG picture.
const JPEG_START: [u8; 2] = [0xFF, 0xD8];

impl LeafBuilder {
    /// Appends rows `start..start + n` of `array`, whose type and width must be the builder's.
    ///
    /// # Errors
    /// Another type or shape, or what reading finds.
    pub(crate) fn append(&mut self, array: &Array, start: u64, n: usize) -> Result<()> {
        if self.element == Element::Bytes {
            self.append_pictures(array, start, n)?;
        } else {
            self.check(array)?;
            match &mut self.values {
                Values::I8(values) => array.read_into(start, n, values)?,
                Values::I16(values) => array.read_into(start, n, values)?,
                Values::I32(values) => array.read_into(start, n, values)?,
                Values::I64(values) => array.read_into(start, n, values)?,
                Values::U8(values) => array.read_into(start, n, values)?,
                Values::U16(values) => array.read_into(start, n, values)?,
                Values::U32(values) => array.read_into(start, n, values)?,
                Values::U64(values) => array.read_into(start, n, values)?,
                Values::F16(values) => array.read_into(start, n, values)?,
                Values::F32(values) => array.read_into(start, n, values)?,
                Values::F64(values) => array.read_into(start, n, values)?,
                Values::Text(values) => append_text(array, start, n, values)?,
                Values::Bytes(_) => {}
            }
        }
        self.nulls.append_n(n, true);
        Ok(())
    }

    fn check(&self, array: &Array) -> Result<()> {
        if array.element() != self.element {
            return Err(DatasetError::WrongType {
                key: array.key().to_owned(),
                actual: array.element().numpy_name().to_owned(),
                expected: "the type it has in the first episode",
            });
        }
        if array.width() != self.width {
            return Err(DatasetError::ShapeMismatch {
                key: array.key().to_owned(),
                actual: array.row_shape().to_vec(),
                expected: format!("{} values, as in the first episode", self.width),
            });
        }
        Ok(())
    }

    /// Encoded pictures come as runs of bytes, or as a plain byte array when all have the same length.
    fn append_pictures(&mut self, array: &Array, start: u64, n: usize) -> Result<()> {
        let Values::Bytes(values) = &mut self.values else {
            return Ok(());
        };
        let not_jpeg = || DatasetError::WrongType {
            key: array.key().to_owned(),
            actual: "bytes that are no JPEG picture".to_owned(),
            expected: "JPEG pictures, as in the first episode",
        };
        match (array.element(), array.row_shape()) {
            (Element::Bytes, []) => {
                for picture in array.read_slice::<VarLenArray<u8>>(start, n)? {
                    values.append_value(&*picture);
                }
            }
            (Element::U8, [length]) if *length > 0 => {
                let mut rows = Vec::new();
                array.read_into(start, n, &mut rows)?;
                for picture in rows.chunks_exact(*length) {
                    if !picture.starts_with(&JPEG_START) {
                        return Err(not_jpeg());
                    }
                    values.append_value(picture);
                }
            }
            _ => return Err(not_jpeg()),
        }
        Ok(())
    }
}

/// Bytes are checked here and not trusted to be UTF-8: the file's word for it is worth nothing.
fn append_text(array: &Array, start: u64, n: usize, values: &mut StringBuilder) -> Result<()> {
    let mut append = |row: usize, bytes: &[u8]| match std::str::from_utf8(bytes) {
        Ok(text) => {
            values.append_value(text);
            Ok(())
        }
        Err(_) => Err(DatasetError::corrupt(format!(
            "row {} of \"{}\" is text that is not UTF-8",
            start + row as u64,
            array.key()
        ))),
    };
    // The library converts no character sets, so the type asked for must have the file's.
    if let Ok(rows) = array.read_slice::<VarLenUnicode>(start, n) {
        return rows
            .iter()
            .enumerate()
            .try_for_each(|(row, text)| append(row, text.as_bytes()));
    }
    let rows = array.read_slice::<VarLenAscii>(start, n)?;
    rows.iter()
        .enumerate()
        .try_for_each(|(row, text)| append(row, text.as_bytes()))
}
