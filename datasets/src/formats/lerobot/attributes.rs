//! Columns of `meta/episodes` that are no index: what is recorded about an episode.

use arrow::array::{Array, ArrayRef, AsArray, RecordBatch};
use arrow::datatypes::{DataType, Field, Float64Type, Int64Type, UInt64Type};
use serde_json::{Map, Value};

use crate::schema;

/// Column of the seeds.
pub(super) const SEED: &str = "seed";
/// Column and attribute of the task texts.
pub(super) const TASKS: &str = "tasks";
/// Field metadata of a column that holds values as JSON text.
const CONTENT: &str = "content";
const JSON: &str = "json";

/// The field of values of mixed or nested types, as JSON text.
pub(super) fn json_field(name: &str) -> Field {
    Field::new(name, DataType::Utf8, true)
        .with_metadata([(CONTENT.to_owned(), JSON.to_owned())].into())
}

/// Whether a column or key of a description is about the episode and not about where its data is.
pub(super) fn is_attribute(name: &str) -> bool {
    let indices = [
        schema::EPISODE_INDEX,
        "length",
        "dataset_from_index",
        "dataset_to_index",
    ];
    let places = ["stats/", "data/", "videos/", "meta/"];
    !indices.contains(&name) && !places.iter().any(|place| name.starts_with(place))
}

/// The attributes in one row; nulls are left out.
pub(super) fn of_row(batch: &RecordBatch, row: usize) -> Map<String, Value> {
    let schema = batch.schema();
    let columns = schema.fields().iter().zip(batch.columns());
    columns
        .filter(|(field, _)| is_attribute(field.name()))
        .filter_map(|(field, array)| {
            let value = value(array, row)?;
            let is_json = field.metadata().get(CONTENT).is_some_and(|c| c == JSON);
            let value = match &value {
                Value::String(text) if is_json => serde_json::from_str(text).unwrap_or(value),
                _ => value,
            };
            (!value.is_null()).then(|| (field.name().clone(), value))
        })
        .collect()
}

/// A value as JSON; `None` for null and for types that JSON has no place for.
fn value(array: &ArrayRef, row: usize) -> Option<Value> {
    if array.is_null(row) {
        return None;
    }
    let list = |values: ArrayRef| {
        let items = (0..values.len()).map(|i| value(&values, i).unwrap_or(Value::Null));
        Some(Value::Array(items.collect()))
    };
    match array.data_type() {
        DataType::Boolean => Some(Value::Bool(array.as_boolean().value(row))),
        DataType::List(_) => list(array.as_list::<i32>().value(row)),
        DataType::LargeList(_) => list(array.as_list::<i64>().value(row)),
        DataType::FixedSizeList(_, _) => list(array.as_fixed_size_list().value(row)),
        DataType::Struct(fields) => {
            let columns = fields.iter().zip(array.as_struct().columns());
            let entries = columns.filter_map(|(f, a)| Some((f.name().clone(), value(a, row)?)));
            Some(Value::Object(entries.collect()))
        }
        other => scalar(&array.slice(row, 1), other),
    }
}

/// The only value of an array.
fn scalar(one: &ArrayRef, data_type: &DataType) -> Option<Value> {
    let cast = |to: &DataType| arrow::compute::cast(one, to).ok();
    if data_type.is_unsigned_integer() {
        let value = cast(&DataType::UInt64)?;
        return Some(value.as_primitive::<UInt64Type>().value(0).into());
    }
    if data_type.is_integer() {
        let value = cast(&DataType::Int64)?;
        return Some(value.as_primitive::<Int64Type>().value(0).into());
    }
    if data_type.is_floating() {
        let value = cast(&DataType::Float64)?
            .as_primitive::<Float64Type>()
            .value(0);
        let number = serde_json::Number::from_f64(value);
        return Some(number.map_or_else(|| Value::String(value.to_string()), Value::Number));
    }
    match data_type {
        DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View => {
            let text = cast(&DataType::Utf8)?;
            Some(Value::String(text.as_string::<i32>().value(0).to_owned()))
        }
        _ => None,
    }
}
