//! Values of one type as the bytes of an Arrow buffer.

use arrow::datatypes::DataType;
use half::f16;

use super::Value;
use super::decode::{FieldPath, PathStep};

/// A number on its way into a column.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Number {
    Float(f64),
    Integer(i128),
}

/// Bytes of one value of a number type; flags are one byte. `None` for types without a fixed size.
pub(crate) fn width(data_type: &DataType) -> Option<usize> {
    match data_type {
        DataType::Boolean => Some(1),
        other => other.primitive_width(),
    }
}

/// Appends a value in native byte order; `false` if the type cannot hold it exactly.
pub(crate) fn push(data_type: &DataType, number: Number, out: &mut Vec<u8>) -> bool {
    macro_rules! integer {
        ($type:ty) => {{
            let exact = match number {
                Number::Integer(value) => <$type>::try_from(value).ok(),
                // The cast saturates, so it is undone exactly only if nothing was lost.
                Number::Float(value) => Some(value as $type).filter(|cast| *cast as f64 == value),
            };
            exact.map(|value| out.extend(value.to_ne_bytes())).is_some()
        }};
    }
    let float = match number {
        Number::Float(value) => value,
        Number::Integer(value) => value as f64,
    };
    let is_exact = match number {
        Number::Float(_) => true,
        Number::Integer(value) => float as i128 == value,
    };
    match data_type {
        DataType::Float64 => out.extend(float.to_ne_bytes()),
        DataType::Float32 => {
            out.extend((float as f32).to_ne_bytes());
            return is_exact && same(f64::from(float as f32), float);
        }
        DataType::Float16 => {
            let half = f16::from_f64(float);
            out.extend(half.to_ne_bytes());
            return is_exact && same(half.to_f64(), float);
        }
        DataType::Boolean => {
            out.push(u8::from(float != 0.0));
            return !float.is_nan();
        }
        DataType::Int8 => return integer!(i8),
        DataType::Int16 => return integer!(i16),
        DataType::Int32 => return integer!(i32),
        DataType::Int64 => return integer!(i64),
        DataType::UInt8 => return integer!(u8),
        DataType::UInt16 => return integer!(u16),
        DataType::UInt32 => return integer!(u32),
        DataType::UInt64 => return integer!(u64),
        _ => return false,
    }
    is_exact
}

fn same(a: f64, b: f64) -> bool {
    a == b || (a.is_nan() && b.is_nan())
}

/// The floats of a buffer of a float type; `None` for other types.
pub(crate) fn floats(data_type: &DataType, bytes: &[u8]) -> Option<Vec<f64>> {
    match data_type {
        DataType::Float64 => Some(
            bytes
                .as_chunks()
                .0
                .iter()
                .map(|v| f64::from_ne_bytes(*v))
                .collect(),
        ),
        DataType::Float32 => {
            let values = bytes.as_chunks().0.iter();
            Some(values.map(|v| f64::from(f32::from_ne_bytes(*v))).collect())
        }
        _ => None,
    }
}

/// What a path leads to in a decoded message; nothing if it is not there. `[]` visits every element.
pub(crate) fn reach<'v>(value: &'v Value, path: &FieldPath) -> Vec<&'v Value> {
    let mut at = vec![value];
    for step in &path.steps {
        at = at
            .into_iter()
            .flat_map(|value| -> Vec<&Value> {
                match (step, value) {
                    (PathStep::Member(name), value) => value.member(name).into_iter().collect(),
                    (PathStep::Index(index), Value::List(items)) => {
                        items.get(*index).into_iter().collect()
                    }
                    (PathStep::Each, Value::List(items)) => items.iter().collect(),
                    _ => Vec::new(),
                }
            })
            .collect();
    }
    at.retain(|value| **value != Value::Null);
    at
}

/// The numbers of a decoded value, with JSON's words for those it cannot write; `false` if it holds others.
pub(crate) fn numbers(value: &Value, out: &mut Vec<Number>) -> bool {
    out.push(match value {
        Value::Bool(flag) => Number::Integer(i128::from(*flag)),
        Value::Int(value) => Number::Integer(i128::from(*value)),
        Value::Uint(value) => Number::Integer(i128::from(*value)),
        Value::Float32(value) => Number::Float(f64::from(*value)),
        Value::Float64(value) => Number::Float(*value),
        Value::Text(word) => match word.as_str() {
            "NaN" => Number::Float(f64::NAN),
            "Infinity" => Number::Float(f64::INFINITY),
            "-Infinity" => Number::Float(f64::NEG_INFINITY),
            _ => return false,
        },
        Value::List(items) => return items.iter().all(|item| numbers(item, out)),
        Value::Bytes(bytes) => {
            out.extend(bytes.iter().map(|byte| Number::Integer(i128::from(*byte))));
            return true;
        }
        Value::Null | Value::Struct(_) => return false,
    });
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_holds_exactly_what_it_can() {
        let holds = |data_type: DataType, number| push(&data_type, number, &mut Vec::new());
        assert!(holds(DataType::Float32, Number::Float(0.5)));
        assert!(!holds(DataType::Float32, Number::Float(0.1)));
        assert!(holds(DataType::Float32, Number::Float(f64::NAN)));
        assert!(holds(DataType::Int8, Number::Float(-128.0)));
        assert!(!holds(DataType::Int8, Number::Float(-129.0)));
        assert!(!holds(DataType::UInt8, Number::Float(1.5)));
        assert!(!holds(DataType::Int32, Number::Float(f64::NAN)));
        assert!(holds(
            DataType::UInt64,
            Number::Integer(i128::from(u64::MAX))
        ));
        assert!(!holds(
            DataType::Int64,
            Number::Integer(i128::from(u64::MAX))
        ));
        assert!(!holds(DataType::Float64, Number::Integer((1 << 53) + 1)));
        assert!(!holds(DataType::Boolean, Number::Float(f64::NAN)));
    }
}
