//! Types of values, and arrays with a row per step.

use arrow::datatypes::DataType;

/// Type of one value of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(
    not(feature = "hdf5"),
    expect(dead_code, reason = "only HDF5 files have text and pictures")
)]
pub(crate) enum Element {
    I8,
    I16,
    I32,
    I64,
    U8,
    U16,
    U32,
    U64,
    F16,
    F32,
    F64,
    /// h5py's bool: an enum over `i8`. Read as `i8`, since damaged files hold other values than 0 and 1.
    Bool,
    /// Strings of variable length.
    Text,
    /// Variable-length runs of bytes: encoded pictures.
    Bytes,
}

impl Element {
    /// The Arrow type that holds it.
    pub(crate) fn data_type(self) -> DataType {
        match self {
            Self::I8 => DataType::Int8,
            Self::I16 => DataType::Int16,
            Self::I32 => DataType::Int32,
            Self::I64 => DataType::Int64,
            Self::U8 => DataType::UInt8,
            Self::U16 => DataType::UInt16,
            Self::U32 => DataType::UInt32,
            Self::U64 => DataType::UInt64,
            Self::F16 => DataType::Float16,
            Self::F32 => DataType::Float32,
            Self::F64 => DataType::Float64,
            Self::Bool => DataType::Boolean,
            Self::Text => DataType::Utf8,
            Self::Bytes => DataType::Binary,
        }
    }

    /// Bytes of one value in memory.
    pub(crate) fn size(self) -> u128 {
        match self {
            Self::I8 | Self::U8 | Self::Bool => 1,
            Self::I16 | Self::U16 | Self::F16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 | Self::Text => 8,
            Self::Bytes => 16,
        }
    }

    /// As [`Self::size`], for memory.
    pub(crate) fn n_bytes(self) -> usize {
        usize::try_from(self.size()).unwrap_or(0)
    }

    /// NumPy's name of the type in the file.
    pub(crate) fn numpy_name(self) -> &'static str {
        match self {
            Self::I8 => "int8",
            Self::I16 => "int16",
            Self::I32 => "int32",
            Self::I64 => "int64",
            Self::U8 => "uint8",
            Self::U16 => "uint16",
            Self::U32 => "uint32",
            Self::U64 => "uint64",
            Self::F16 => "float16",
            Self::F32 => "float32",
            Self::F64 => "float64",
            Self::Bool => "bool",
            Self::Text | Self::Bytes => "object",
        }
    }
}

/// An array as its file describes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ArrayInfo {
    /// Path in the file.
    pub(crate) key: String,
    pub(crate) element: Element,
    /// Length of the first axis.
    pub(crate) n_rows: u64,
    pub(crate) row_shape: Vec<usize>,
}

impl ArrayInfo {
    /// Values in one row.
    pub(crate) fn width(&self) -> usize {
        self.row_shape.iter().product()
    }

    /// Whether a row is one value, or one value in brackets.
    pub(crate) fn is_column(&self) -> bool {
        matches!(self.row_shape.as_slice(), [] | [1])
    }
}
