//! One HDF5 dataset, checked before it is read.

use hdf5::plist::dataset_create::{DatasetCreate, Layout};
use hdf5::types::{FloatSize, IntSize, TypeDescriptor};
use hdf5_metno as hdf5;

use super::file::failed;
use crate::error::{DatasetError, Result};
use crate::formats::steps::{ArrayInfo, Element};

/// How many times its file an array may declare to be. Deflate, the strongest filter in use, cannot
/// shrink data by more than 1032; what declares more has no data behind it.
const MAX_RATIO: u64 = 1100;
/// Declared bytes that are always believed, so that tiny files do not trip over the ratio.
const ALWAYS_ALLOWED: u128 = 1 << 20;
/// Bytes of one chunk, at most: the library unpacks a chunk as a whole.
const MAX_CHUNK_BYTES: u128 = 1 << 30;
/// Values in one row, at most (Arrow's list sizes are `i32`).
const MAX_ROW_WIDTH: u128 = i32::MAX as u128;

/// An open array whose rows can be read.
#[derive(Debug)]
pub(crate) struct Array {
    dataset: hdf5::Dataset,
    key: String,
    element: Element,
    n_rows: u64,
    row_shape: Vec<usize>,
}

impl Array {
    /// Opens `name` in `group` and checks type, size, storage and filters. `key` is its path for messages.
    ///
    /// # Errors
    /// What the checks find, each naming `key`.
    pub(crate) fn open(group: &hdf5::Group, name: &str, key: &str, file_size: u64) -> Result<Self> {
        let (dataset, storage) = open_contained(group, name, key)?;
        let shape = dataset
            .get_shape()
            .map_err(failed("read the shape of", key))?;
        let descriptor = dataset.dtype().and_then(|dtype| dtype.to_descriptor());
        let descriptor = descriptor.map_err(failed("read the type of", key))?;
        let wrong = |expected| DatasetError::WrongType {
            key: key.to_owned(),
            actual: descriptor.to_string(),
            expected,
        };
        let element = element_of(&descriptor)
            .ok_or_else(|| wrong("numbers, flags, text or variable-length bytes"))?;
        let Some((&n_rows, row_shape)) = shape.split_first() else {
            return Err(not_an_array(key));
        };
        check_size(key, &shape, element, file_size)?;
        check_chunks(&storage, key, element, file_size)?;
        Ok(Self {
            key: key.to_owned(),
            element,
            n_rows: n_rows as u64,
            row_shape: row_shape.to_vec(),
            dataset,
        })
    }

    /// Length of the first axis, by the header alone.
    ///
    /// # Errors
    /// The array is not there, lies outside the file, or is a scalar.
    pub(crate) fn length(group: &hdf5::Group, key: &str) -> Result<u64> {
        let (dataset, _) = open_contained(group, key, key)?;
        let shape = dataset
            .get_shape()
            .map_err(failed("read the shape of", key))?;
        shape
            .first()
            .map(|&n| n as u64)
            .ok_or_else(|| not_an_array(key))
    }

    /// What the file says about it.
    pub(crate) fn info(&self) -> ArrayInfo {
        ArrayInfo {
            key: self.key.clone(),
            element: self.element,
            n_rows: self.n_rows,
            row_shape: self.row_shape.clone(),
        }
    }

    /// Path in the file.
    pub(crate) fn key(&self) -> &str {
        &self.key
    }

    /// Type of its values.
    pub(crate) fn element(&self) -> Element {
        self.element
    }

    /// Length of the first axis.
    pub(crate) fn n_rows(&self) -> u64 {
        self.n_rows
    }

    /// Shape of one row.
    pub(crate) fn row_shape(&self) -> &[usize] {
        &self.row_shape
    }

    /// Values in one row.
    pub(crate) fn width(&self) -> usize {
        self.row_shape.iter().product()
    }

    /// Whether a row is one value, or one value in brackets.
    pub(crate) fn is_column(&self) -> bool {
        matches!(self.row_shape.as_slice(), [] | [1])
    }

    /// Appends rows `start..start + n` to `values`.
    ///
    /// # Errors
    /// The rows are not there, or the library cannot unpack or convert them.
    pub(crate) fn read_into<T>(&self, start: u64, n: usize, values: &mut Vec<T>) -> Result<()>
    where
        T: hdf5::H5Type + Copy + Default,
    {
        if n == 0 {
            return Ok(());
        }
        let read = failed("read", &self.key);
        if start == 0 && n as u64 == self.n_rows {
            let before = values.len();
            values.resize(before + n * self.width(), T::default());
            self.dataset
                .read_into_raw(&mut values[before..])
                .map_err(read)?;
            return Ok(());
        }
        values.extend_from_slice(&self.read_slice::<T>(start, n)?);
        Ok(())
    }

    /// Rows `start..start + n` of any type.
    ///
    /// # Errors
    /// As for [`Self::read_into`].
    pub(crate) fn read_slice<T: hdf5::H5Type>(&self, start: u64, n: usize) -> Result<Vec<T>> {
        let outside = start
            .checked_add(n as u64)
            .is_none_or(|end| end > self.n_rows);
        if outside {
            let (key, actual, expected) = (
                self.key.clone(),
                self.n_rows,
                start.saturating_add(n as u64),
            );
            return Err(DatasetError::LengthMismatch {
                key,
                actual,
                expected,
            });
        }
        let start =
            usize::try_from(start).map_err(|_| DatasetError::corrupt("more rows than memory"))?;
        let mut axes = vec![hdf5::SliceOrIndex::from(start..start + n)];
        axes.extend(self.row_shape.iter().map(|_| hdf5::SliceOrIndex::from(..)));
        let slice = self
            .dataset
            .read_slice::<T, _, ndarray::IxDyn>(hdf5::Hyperslab::from(axes));
        // The library fills a fresh array in row-major order: its vector is the rows, from the start.
        let (values, _) = slice
            .map_err(failed("read", &self.key))?
            .into_raw_vec_and_offset();
        Ok(values)
    }
}

/// The type of values with this descriptor, if it can be read.
fn element_of(descriptor: &TypeDescriptor) -> Option<Element> {
    Some(match descriptor {
        TypeDescriptor::Integer(IntSize::U1) => Element::I8,
        TypeDescriptor::Integer(IntSize::U2) => Element::I16,
        TypeDescriptor::Integer(IntSize::U4) => Element::I32,
        TypeDescriptor::Integer(IntSize::U8) => Element::I64,
        TypeDescriptor::Unsigned(IntSize::U1) => Element::U8,
        TypeDescriptor::Unsigned(IntSize::U2) => Element::U16,
        TypeDescriptor::Unsigned(IntSize::U4) => Element::U32,
        TypeDescriptor::Unsigned(IntSize::U8) => Element::U64,
        TypeDescriptor::Float(FloatSize::U2) => Element::F16,
        TypeDescriptor::Float(FloatSize::U4) => Element::F32,
        TypeDescriptor::Float(FloatSize::U8) => Element::F64,
        TypeDescriptor::Boolean => Element::Bool,
        // Any other enum by its numbers.
        TypeDescriptor::Enum(numbers) => element_of(&numbers.base_type())?,
        TypeDescriptor::VarLenUnicode | TypeDescriptor::VarLenAscii => Element::Text,
        TypeDescriptor::VarLenArray(item) if **item == TypeDescriptor::Unsigned(IntSize::U1) => {
            Element::Bytes
        }
        _ => return None,
    })
}

fn not_an_array(key: &str) -> DatasetError {
    DatasetError::ShapeMismatch {
        key: key.to_owned(),
        actual: Vec::new(),
        expected: "an array, not a scalar".to_owned(),
    }
}

fn check_size(key: &str, shape: &[usize], element: Element, file_size: u64) -> Result<()> {
    let values = shape
        .iter()
        .try_fold(1u128, |n, &dim| n.checked_mul(dim as u128));
    let declared = values
        .and_then(|n| n.checked_mul(element.size()))
        .unwrap_or(u128::MAX);
    let allowed = u128::from(file_size) * u128::from(MAX_RATIO) + ALWAYS_ALLOWED;
    let row = shape[1..]
        .iter()
        .try_fold(1u128, |n, &dim| n.checked_mul(dim as u128));
    if declared > allowed || row.is_none_or(|row| row > MAX_ROW_WIDTH) {
        return Err(DatasetError::DeclaredSize {
            key: key.to_owned(),
            declared,
            file_size,
            max_ratio: MAX_RATIO,
        });
    }
    Ok(())
}

/// Opens an array whose data lie in the file itself.
///
/// Nothing but the header is looked at before that is known: to ask a virtual dataset for its shape already
/// opens the files it is made of.
///
/// # Errors
/// It is not there, or its data lie elsewhere.
pub(crate) fn open_contained(
    group: &hdf5::Group,
    name: &str,
    key: &str,
) -> Result<(hdf5::Dataset, DatasetCreate)> {
    let dataset = group.dataset(name).map_err(failed("open", key))?;
    let read = failed("read the storage of", key);
    let storage = dataset.create_plist().map_err(&read)?;
    let what = match storage.get_layout().map_err(&read)? {
        Layout::Virtual => "is a virtual dataset over other files",
        Layout::Contiguous if !storage.get_external().map_err(&read)?.is_empty() => {
            "is stored in another file"
        }
        _ => return Ok((dataset, storage)),
    };
    Err(DatasetError::Unsupported {
        what: format!("\"{key}\" {what}"),
    })
}

/// Refuses unknown filters and giant chunks.
fn check_chunks(
    storage: &DatasetCreate,
    key: &str,
    element: Element,
    file_size: u64,
) -> Result<()> {
    let layout = storage
        .get_layout()
        .map_err(failed("read the storage of", key))?;
    if layout != Layout::Chunked {
        return Ok(());
    }
    let chunk = storage
        .get_chunk()
        .map_err(failed("read the chunks of", key))?
        .unwrap_or_default();
    let bytes = chunk
        .iter()
        .try_fold(element.size(), |n, &dim| n.checked_mul(dim as u128));
    let declared = bytes.unwrap_or(u128::MAX);
    if declared > MAX_CHUNK_BYTES {
        return Err(DatasetError::DeclaredSize {
            key: key.to_owned(),
            declared,
            file_size,
            max_ratio: MAX_RATIO,
        });
    }
    check_filters(storage, key)
}

fn check_filters(storage: &DatasetCreate, key: &str) -> Result<()> {
    for filter in storage
        .get_filters()
        .map_err(failed("read the filters of", key))?
    {
        if !filter.is_available() {
            return Err(DatasetError::UnknownFilter {
                key: key.to_owned(),
                filter: filter.id(),
            });
        }
    }
    Ok(())
}
