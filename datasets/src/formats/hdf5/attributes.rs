//! Attributes and small datasets as JSON, for metadata.

use hdf5::types::{
    FixedAscii, FixedUnicode, FloatSize, IntSize, TypeDescriptor, VarLenAscii, VarLenUnicode,
};
use hdf5_metno as hdf5;
use serde_json::{Map, Value};

use super::file::failed;
use crate::error::Result;

/// Values of an attribute that are kept, at most: metadata, not data.
const MAX_VALUES: usize = 4096;
/// Bytes of a string of fixed length that are kept, at most.
const MAX_FIXED_TEXT: usize = 1024;

/// All attributes of an object that JSON can hold, in name order; others are left out.
///
/// # Errors
/// The attributes cannot be listed.
pub(crate) fn attributes(object: &hdf5::Location, key: &str) -> Result<Map<String, Value>> {
    let mut names = object
        .attr_names()
        .map_err(failed("list the attributes of", key))?;
    names.sort();
    let mut values = Map::new();
    for name in names {
        if let Some(value) = object
            .attr(&name)
            .ok()
            .and_then(|attribute| json_value(&attribute))
        {
            values.insert(name, value);
        }
    }
    Ok(values)
}

/// The value of a small dataset or attribute, or `None` if it is large or JSON cannot hold it. Floats that
/// JSON has no word for become the strings `NaN`, `Infinity` and `-Infinity`.
pub(crate) fn json_value(container: &hdf5::Container) -> Option<Value> {
    let shape = container.get_shape().ok()?;
    let n_values = shape
        .iter()
        .try_fold(1usize, |n, &dim| n.checked_mul(dim))?;
    if n_values > MAX_VALUES {
        return None;
    }
    let values: Vec<Value> = match container.dtype().ok()?.to_descriptor().ok()? {
        TypeDescriptor::Integer(_) => read(container, |value: i64| Value::from(value))?,
        TypeDescriptor::Unsigned(_) => read(container, |value: u64| Value::from(value))?,
        TypeDescriptor::Float(FloatSize::U2 | FloatSize::U4 | FloatSize::U8) => {
            read(container, float)?
        }
        TypeDescriptor::Boolean => read(container, |value: i8| Value::from(value != 0))?,
        TypeDescriptor::Enum(numbers) if numbers.size == IntSize::U1 => {
            read(container, |value: i8| Value::from(value))?
        }
        TypeDescriptor::VarLenUnicode => {
            texts::<VarLenUnicode>(container, VarLenUnicode::as_bytes)?
        }
        TypeDescriptor::VarLenAscii => texts::<VarLenAscii>(container, VarLenAscii::as_bytes)?,
        TypeDescriptor::FixedAscii(n) if n <= MAX_FIXED_TEXT => {
            texts::<FixedAscii<MAX_FIXED_TEXT>>(container, FixedAscii::as_bytes)?
        }
        TypeDescriptor::FixedUnicode(n) if n <= MAX_FIXED_TEXT => {
            texts::<FixedUnicode<MAX_FIXED_TEXT>>(container, FixedUnicode::as_bytes)?
        }
        _ => return None,
    };
    match shape.as_slice() {
        [] => values.into_iter().next(),
        _ => Some(Value::Array(values)),
    }
}

fn read<T: hdf5::H5Type>(
    container: &hdf5::Container,
    to_json: impl Fn(T) -> Value,
) -> Option<Vec<Value>> {
    Some(
        container
            .read_raw::<T>()
            .ok()?
            .into_iter()
            .map(to_json)
            .collect(),
    )
}

fn texts<T: hdf5::H5Type>(
    container: &hdf5::Container,
    bytes: impl Fn(&T) -> &[u8],
) -> Option<Vec<Value>> {
    let rows = container.read_raw::<T>().ok()?;
    Some(
        rows.iter()
            .map(|text| Value::from(String::from_utf8_lossy(bytes(text)).into_owned()))
            .collect(),
    )
}

fn float(value: f64) -> Value {
    let word = match value {
        value if value.is_nan() => "NaN",
        f64::INFINITY => "Infinity",
        f64::NEG_INFINITY => "-Infinity",
        value => return Value::from(value),
    };
    Value::from(word)
}
