//! The leaves of observation and action spaces.

use arrow::datatypes::{DataType, Field};

use crate::schema;

/// The number type of a NumPy name, such as `float32`; `None` for another name.
pub fn arrow_type(name: &str) -> Option<DataType> {
    Some(match name {
        "float16" => DataType::Float16,
        "float32" => DataType::Float32,
        "float64" => DataType::Float64,
        "int8" => DataType::Int8,
        "int16" => DataType::Int16,
        "int32" => DataType::Int32,
        "int64" => DataType::Int64,
        "uint8" => DataType::UInt8,
        "uint16" => DataType::UInt16,
        "uint32" => DataType::UInt32,
        "uint64" => DataType::UInt64,
        _ => return None,
    })
}

/// What a leaf of a space is, after Gymnasium's space types.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum LeafKind {
    /// A numeric array with bounds, or any numeric array of a format without spaces.
    Box,
    /// One integer.
    Discrete,
    /// Several integers.
    MultiDiscrete,
    /// Several bits, stored as integers.
    MultiBinary,
    /// A string.
    Text,
    /// A picture: raw bytes of shape (H, W\[, C\]), or encoded if the column is `Binary`.
    Image,
}

/// One leaf of the observation or action space, stored in one column.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeafSpec {
    /// Name of the column, such as `observation.achieved_goal`.
    pub column: String,
    /// What it holds.
    pub kind: LeafKind,
    /// Shape of one row; empty for a scalar.
    pub shape: Vec<usize>,
    /// Type of one value, as the source stores it.
    pub data_type: DataType,
}

impl LeafSpec {
    /// Values in one row: the product of the shape.
    pub fn width(&self) -> usize {
        self.shape.iter().product()
    }

    /// True for leaves that can be part of a state vector: numbers, but neither text nor pictures.
    pub fn is_numeric(&self) -> bool {
        self.kind != LeafKind::Image && schema::is_number(&self.data_type)
    }

    /// The leaf a column of the canonical schema holds, or `None` for a type no leaf can have.
    pub(crate) fn of_field(field: &Field) -> Option<Self> {
        let (data_type, shape) = schema::row_shape(field)?;
        let kind = match data_type {
            DataType::Utf8 => LeafKind::Text,
            DataType::Binary => LeafKind::Image,
            DataType::UInt8 if matches!(shape.len(), 2 | 3) => LeafKind::Image,
            _ => LeafKind::Box,
        };
        Some(Self {
            column: field.name().clone(),
            kind,
            shape,
            data_type,
        })
    }
}
