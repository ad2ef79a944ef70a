//! Writing: arrays that grow by rows, attributes.

use std::path::Path;

use arrow::array::{Array as _, ArrayRef, ArrowPrimitiveType, AsArray};
use arrow::datatypes::{
    DataType, Float16Type, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type,
    UInt8Type, UInt16Type, UInt32Type, UInt64Type,
};
use hdf5::types::{TypeDescriptor, VarLenArray, VarLenUnicode};
use hdf5_metno as hdf5;
use serde_json::Value;

use super::file::failed;
use crate::error::{DatasetError, LibraryMessage, Result};
use crate::formats::episode_rows::{flat_values, refuse_nulls};

/// Bytes of a chunk, about: h5py's automatic chunks are between 16 KiB and 1 MiB.
const CHUNK_BYTES: usize = 256 << 10;
/// Bytes a value of variable length takes in a chunk.
const REFERENCE_BYTES: usize = 16;
/// Numbers of an attribute, at most: an attribute of more than 64 KiB does not fit its object's header.
const MAX_ATTRIBUTE_VALUES: usize = 4096;

/// Makes a new file whose groups remember the order in which they were made.
///
/// # Errors
/// The file cannot be made.
pub(crate) fn create_file(path: &Path) -> Result<hdf5::File> {
    let mut options = hdf5::FileBuilder::new();
    options.with_fcpl(|fcpl| {
        fcpl.link_creation_order(hdf5::plist::file_create::LinkCreationOrder::Indexed)
    });
    // Nobody else knows the name of a file that is not finished. A lock would pass to any process that the
    // program starts meanwhile, and keep the finished file from being read.
    options.with_fapl(|fapl| fapl.file_locking(false));
    options
        .create_excl(path)
        .map_err(failed("create", "a new file"))
}

/// Finishes a file: everything is on the disk after it.
///
/// # Errors
/// A failed write.
pub(crate) fn close_file(file: hdf5::File, path: &Path) -> Result<()> {
    file.close().map_err(failed("finish", "the file"))?;
    std::fs::File::open(path)
        .and_then(|file| file.sync_all())
        .map_err(|e| DatasetError::io("write", e))
}

/// How an array is stored.
#[derive(Debug, Clone)]
pub(crate) struct ArrayPlan {
    /// Type of one value.
    pub(crate) value_type: DataType,
    /// Shape of one row.
    pub(crate) row_shape: Vec<usize>,
    /// Rows that will come, at most; a chunk has no more.
    pub(crate) n_rows: u64,
    /// Level of deflate.
    pub(crate) deflate: Option<u8>,
}

/// An array that grows by rows.
pub(crate) struct ArrayWriter {
    dataset: hdf5::Dataset,
    key: String,
    row_shape: Vec<usize>,
    n_rows: usize,
}

impl ArrayWriter {
    /// Makes an array without rows. `key` is its path for messages.
    ///
    /// # Errors
    /// A type no array has, or a failed write.
    pub(crate) fn create(
        group: &hdf5::Group,
        name: &str,
        key: &str,
        plan: &ArrayPlan,
    ) -> Result<Self> {
        let (descriptor, value_bytes) = stored_type(&plan.value_type, key)?;
        let row_bytes = plan.row_shape.iter().product::<usize>().max(1) * value_bytes;
        let n_rows = usize::try_from(plan.n_rows).unwrap_or(usize::MAX);
        let chunk_rows = (CHUNK_BYTES / row_bytes).min(n_rows).max(1);
        let mut chunk = vec![chunk_rows];
        chunk.extend(&plan.row_shape);
        let mut extents = vec![hdf5::Extent::resizable(0)];
        extents.extend(plan.row_shape.iter().map(|&dim| hdf5::Extent::fixed(dim)));
        let mut builder = group
            .new_dataset_builder()
            .empty_as(descriptor)
            .shape(extents)
            .chunk(chunk);
        if let Some(level) = plan.deflate {
            builder = builder.deflate(level);
        }
        Ok(Self {
            dataset: builder.create(name).map_err(failed("create", key))?,
            key: key.to_owned(),
            row_shape: plan.row_shape.clone(),
            n_rows: 0,
        })
    }

    /// Rows so far.
    pub(crate) fn n_rows(&self) -> u64 {
        self.n_rows as u64
    }

    /// Appends the rows of an array of the planned type.
    ///
    /// # Errors
    /// A null, text that HDF5 cannot hold, or a failed write.
    pub(crate) fn append(&mut self, rows: &ArrayRef) -> Result<()> {
        if rows.is_empty() {
            return Ok(());
        }
        refuse_nulls(rows, &self.key, self.n_rows as u64)?;
        let values = flat_values(rows);
        self.append_values(&values, rows.len())?;
        self.n_rows += rows.len();
        Ok(())
    }

    fn append_values(&self, values: &ArrayRef, n: usize) -> Result<()> {
        match values.data_type() {
            DataType::Int8 => self.numbers::<Int8Type>(values, n),
            DataType::Int16 => self.numbers::<Int16Type>(values, n),
            DataType::Int32 => self.numbers::<Int32Type>(values, n),
            DataType::Int64 => self.numbers::<Int64Type>(values, n),
            DataType::UInt8 => self.numbers::<UInt8Type>(values, n),
            DataType::UInt16 => self.numbers::<UInt16Type>(values, n),
            DataType::UInt32 => self.numbers::<UInt32Type>(values, n),
            DataType::UInt64 => self.numbers::<UInt64Type>(values, n),
            DataType::Float16 => self.numbers::<Float16Type>(values, n),
            DataType::Float32 => self.numbers::<Float32Type>(values, n),
            DataType::Float64 => self.numbers::<Float64Type>(values, n),
            DataType::Boolean => {
                let flags: Vec<bool> = values.as_boolean().values().iter().collect();
                self.raw(&flags, n)
            }
            DataType::Utf8 => {
                let texts = values.as_string::<i32>().iter().flatten();
                let texts = texts.map(|text| unicode(text, &self.key));
                self.raw(&texts.collect::<Result<Vec<_>>>()?, n)
            }
            DataType::Binary => {
                let runs = values.as_binary::<i32>().iter().flatten();
                let runs: Vec<VarLenArray<u8>> = runs.map(VarLenArray::from_slice).collect();
                self.raw(&runs, n)
            }
            other => Err(wrong_type(other, &self.key)),
        }
    }

    fn numbers<T: ArrowPrimitiveType>(&self, values: &ArrayRef, n: usize) -> Result<()>
    where
        T::Native: hdf5::H5Type,
    {
        self.raw(values.as_primitive::<T>().values(), n)
    }

    fn raw<T: hdf5::H5Type>(&self, values: &[T], n: usize) -> Result<()> {
        let write = failed("write", &self.key);
        let mut shape = vec![n];
        shape.extend(&self.row_shape);
        let view = ndarray::ArrayViewD::from_shape(shape.as_slice(), values);
        let view = view.map_err(|error| DatasetError::Hdf5 {
            operation: "write",
            key: self.key.clone(),
            source: LibraryMessage(error.to_string()),
        })?;
        let end = self.n_rows + n;
        shape[0] = end;
        self.dataset.resize(shape).map_err(&write)?;
        let mut axes = vec![hdf5::SliceOrIndex::from(self.n_rows..end)];
        axes.extend(self.row_shape.iter().map(|_| hdf5::SliceOrIndex::from(..)));
        self.dataset
            .write_slice(view, hdf5::Hyperslab::from(axes))
            .map_err(write)
    }
}

/// The type in the file, and the bytes of a value in a chunk.
fn stored_type(value_type: &DataType, key: &str) -> Result<(TypeDescriptor, usize)> {
    fn of<T: hdf5::H5Type>() -> (TypeDescriptor, usize) {
        (T::type_descriptor(), size_of::<T>())
    }
    Ok(match value_type {
        DataType::Int8 => of::<i8>(),
        DataType::Int16 => of::<i16>(),
        DataType::Int32 => of::<i32>(),
        DataType::Int64 => of::<i64>(),
        DataType::UInt8 => of::<u8>(),
        DataType::UInt16 => of::<u16>(),
        DataType::UInt32 => of::<u32>(),
        DataType::UInt64 => of::<u64>(),
        DataType::Float16 => of::<half::f16>(),
        DataType::Float32 => of::<f32>(),
        DataType::Float64 => of::<f64>(),
        // h5py's bool: an enum over `i8` with FALSE and TRUE.
        DataType::Boolean => of::<bool>(),
        DataType::Utf8 => (TypeDescriptor::VarLenUnicode, REFERENCE_BYTES),
        DataType::Binary => of::<VarLenArray<u8>>(),
        other => return Err(wrong_type(other, key)),
    })
}

fn wrong_type(actual: &DataType, key: &str) -> DatasetError {
    DatasetError::WrongType {
        key: key.to_owned(),
        actual: actual.to_string(),
        expected: "numbers, flags, text or encoded pictures",
    }
}

/// HDF5 marks the end of a text by a zero byte, so it cannot hold one.
fn unicode(text: &str, key: &str) -> Result<VarLenUnicode> {
    text.parse().map_err(|_| DatasetError::Unsupported {
        what: format!("text with a zero byte in HDF5 (\"{key}\")"),
    })
}

/// Writes a number, a flag or a text as an array without axes. `false` if the value is none of these.
///
/// # Errors
/// A failed write.
pub(crate) fn write_scalar(group: &hdf5::Group, key: &str, value: &Value) -> Result<bool> {
    fn write<T: hdf5::H5Type>(group: &hdf5::Group, key: &str, value: &T) -> hdf5::Result<()> {
        group.new_dataset::<T>().create(key)?.write_scalar(value)
    }
    let written = if let Some(value) = value.as_i64() {
        write(group, key, &value)
    } else if let Some(value) = value.as_u64() {
        write(group, key, &value)
    } else if let Some(value) = float(value) {
        write(group, key, &value)
    } else if let Some(value) = value.as_bool() {
        write(group, key, &value)
    } else if let Some(text) = value.as_str() {
        write(group, key, &unicode(text, key)?)
    } else {
        return Ok(false);
    };
    written.map_err(failed("write", key)).map(|()| true)
}

/// Writes a number, a flag, a text or a list of one of them as an attribute. `false` if the value is none of
/// these, and nothing was written. The words `NaN`, `Infinity` and `-Infinity` are numbers.
///
/// # Errors
/// A failed write.
pub(crate) fn write_attribute(object: &hdf5::Location, name: &str, value: &Value) -> Result<bool> {
    let failed = failed("write the attribute", name);
    let builder = object.new_attr_builder();
    if let Some(values) = one_or_many(value, Value::as_i64) {
        return values.write(builder, name).map_err(failed);
    }
    if let Some(values) = one_or_many(value, Value::as_u64) {
        return values.write(builder, name).map_err(failed);
    }
    if let Some(values) = one_or_many(value, float) {
        return values.write(builder, name).map_err(failed);
    }
    if let Some(values) = one_or_many(value, Value::as_bool) {
        return values.write(builder, name).map_err(failed);
    }
    let text = |value: &Value| value.as_str().and_then(|text| text.parse().ok());
    match one_or_many::<VarLenUnicode>(value, text) {
        Some(values) => values.write(builder, name).map_err(failed),
        None => Ok(false),
    }
}

/// The value of an attribute.
enum OneOrMany<T> {
    One(T),
    Many(Vec<T>),
}

fn one_or_many<T>(value: &Value, read: impl Fn(&Value) -> Option<T>) -> Option<OneOrMany<T>> {
    match value {
        Value::Array(items) if items.len() > MAX_ATTRIBUTE_VALUES => None,
        Value::Array(items) => {
            let items: Option<Vec<T>> = items.iter().map(read).collect();
            items.map(OneOrMany::Many)
        }
        one => read(one).map(OneOrMany::One),
    }
}

impl<T: hdf5::H5Type> OneOrMany<T> {
    fn write(self, builder: hdf5::AttributeBuilder, name: &str) -> hdf5::Result<bool> {
        match self {
            Self::One(value) => builder.empty::<T>().create(name)?.write_scalar(&value)?,
            Self::Many(values) => {
                builder.with_data(values.as_slice()).create(name)?;
            }
        }
        Ok(true)
    }
}

/// A number of any kind as a float; the reader has words for those that JSON has not.
fn float(value: &Value) -> Option<f64> {
    match value {
        Value::String(word) => match word.as_str() {
            "NaN" => Some(f64::NAN),
            "Infinity" => Some(f64::INFINITY),
            "-Infinity" => Some(f64::NEG_INFINITY),
            _ => None,
        },
        number => number.as_f64(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::attributes;
    use super::*;

    #[test]
    fn a_lock_that_is_soon_gone_is_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.hdf5");
        drop(create_file(&path).unwrap());
        let locked = std::fs::File::open(&path).unwrap();
        locked.lock().unwrap();
        let holder = std::thread::spawn(move || {
            std::thread::sleep(std::time::Duration::from_millis(150));
            drop(locked);
        });
        super::super::file::H5File::open(&path).unwrap();
        holder.join().unwrap();
    }

    #[test]
    fn attributes_are_read_back_as_they_were() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.hdf5");
        let file = create_file(&path).unwrap();
        let values = json!({
            "bool": true, "float": 0.1, "int": -3, "large": u64::MAX, "list": [1, 2], "mixed": [1, 0.5],
            "nan": "NaN", "options/goal/x": 1.5, "text": "猫", "texts": ["a", ""], "empty": "",
        });
        let Value::Object(values) = values else {
            unreachable!()
        };
        for (name, value) in &values {
            assert!(write_attribute(&file, name, value).unwrap(), "{name}");
        }
        for refused in [json!(null), json!({"a": 1}), json!(["a", 1]), json!([[1]])] {
            assert!(!write_attribute(&file, "refused", &refused).unwrap());
        }
        close_file(file, &path).unwrap();
        let file = hdf5::File::open(&path).unwrap();
        let mut read = attributes(&file, "").unwrap();
        assert_eq!(read.remove("mixed"), Some(json!([1.0, 0.5])));
        let mut expected = values;
        expected.remove("mixed");
        assert_eq!(read, expected);
    }

    #[test]
    fn a_null_is_refused_with_its_row() {
        let folder = tempfile::tempdir().unwrap();
        let file = create_file(&folder.path().join("a.hdf5")).unwrap();
        let plan = ArrayPlan {
            value_type: DataType::Int8,
            row_shape: vec![],
            n_rows: 3,
            deflate: None,
        };
        let mut writer = ArrayWriter::create(&file, "a", "a", &plan).unwrap();
        let rows = |values: Vec<Option<i8>>| -> ArrayRef {
            std::sync::Arc::new(arrow::array::Int8Array::from(values))
        };
        writer.append(&rows(vec![Some(1), Some(2)])).unwrap();
        let error = writer.append(&rows(vec![None])).unwrap_err();
        assert!(
            matches!(error, DatasetError::NullValue { row: 2, .. }),
            "{error}"
        );
        assert_eq!(writer.n_rows(), 2);
    }
}
