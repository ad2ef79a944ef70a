//! Gymnasium spaces as Minari writes them.

use std::cmp::Ordering;

use arrow::datatypes::DataType;
use serde_json::Value;

use crate::spec::{LeafKind, arrow_type};

/// Shortest side of a picture that Minari encodes.
const MIN_PICTURE_SIDE: u64 = 32;

/// A space, or a part of one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Space {
    Leaf {
        kind: LeafKind,
        shape: Option<Vec<usize>>,
        /// Type of one value; `None` for a NumPy type that no column can have.
        data_type: Option<DataType>,
    },
    Dict(Vec<(String, Space)>),
    Tuple(Vec<Space>),
    /// A type this crate does not know; the data decides.
    Unknown,
}

impl Space {
    /// The space a metadata field holds, if any.
    pub(crate) fn of(field: &Option<Value>) -> Self {
        field.as_ref().map_or(Self::Unknown, Self::parse)
    }

    /// Reads the JSON form; anything that does not fit is [`Self::Unknown`], never an error, since the data
    /// can be read without it.
    pub(crate) fn parse(value: &Value) -> Self {
        Self::parse_nested(value, 0)
    }

    fn parse_nested(value: &Value, depth: usize) -> Self {
        // Deeper nesting than this is refused in the data as well.
        if depth > 32 {
            return Self::Unknown;
        }
        let shape = |key: &str| value.get(key).and_then(shape_of);
        let dtype = || data_type(value.get("dtype")?.as_str()?);
        let leaf = |kind, shape, data_type| Self::Leaf {
            kind,
            shape,
            data_type,
        };
        match value.get("type").and_then(Value::as_str) {
            Some("Box") if is_picture(value) => leaf(LeafKind::Image, shape("shape"), dtype()),
            Some("Box") => leaf(LeafKind::Box, shape("shape"), dtype()),
            Some("Discrete") => leaf(LeafKind::Discrete, Some(Vec::new()), Some(DataType::Int64)),
            Some("MultiDiscrete") => leaf(
                LeafKind::MultiDiscrete,
                value.get("nvec").and_then(nested_shape),
                dtype().or(Some(DataType::Int64)),
            ),
            Some("MultiBinary") => {
                let n = |n: &serde_json::Number| n.as_u64().and_then(|n| usize::try_from(n).ok());
                let shape = match value.get("n") {
                    Some(Value::Number(number)) => n(number).map(|n| vec![n]),
                    _ => shape("n"),
                };
                leaf(LeafKind::MultiBinary, shape, Some(DataType::Int8))
            }
            Some("Text") => leaf(LeafKind::Text, Some(Vec::new()), Some(DataType::Utf8)),
            Some("Dict") => match value.get("subspaces") {
                Some(Value::Object(parts)) => {
                    let parts = parts
                        .iter()
                        .map(|(k, v)| (k.clone(), Self::parse_nested(v, depth + 1)));
                    Self::Dict(parts.collect())
                }
                _ => Self::Unknown,
            },
            Some("Tuple") => match value.get("subspaces") {
                Some(Value::Array(parts)) => Self::Tuple(
                    parts
                        .iter()
                        .map(|part| Self::parse_nested(part, depth + 1))
                        .collect(),
                ),
                _ => Self::Unknown,
            },
            _ => Self::Unknown,
        }
    }

    /// The part under a key of the file: a dictionary key, or `_index_3` of a tuple.
    pub(crate) fn member(&self, name: &str) -> &Self {
        let found = match self {
            Self::Dict(parts) => parts
                .iter()
                .find(|(key, _)| key == name)
                .map(|(_, part)| part),
            Self::Tuple(parts) => tuple_index(name).and_then(|index| parts.get(index)),
            _ => None,
        };
        found.unwrap_or(&Self::Unknown)
    }
}

/// The column type of a NumPy type.
fn data_type(numpy: &str) -> Option<DataType> {
    match numpy {
        "bool" => Some(DataType::Boolean),
        number => arrow_type(number),
    }
}

/// `3` for `_index_3`.
pub(crate) fn tuple_index(name: &str) -> Option<usize> {
    name.strip_prefix("_index_")?.parse().ok()
}

/// Order of sibling keys: `achieved_goal` first, `desired_goal` last, tuple elements by number, else bytewise.
pub(crate) fn key_order(a: &str, b: &str) -> Ordering {
    let rank = |key: &str| match key {
        "achieved_goal" => 0,
        "desired_goal" => 2,
        _ => 1,
    };
    let by_index = || match (tuple_index(a), tuple_index(b)) {
        (Some(a), Some(b)) => a.cmp(&b),
        _ => Ordering::Equal,
    };
    rank(a)
        .cmp(&rank(b))
        .then_with(by_index)
        .then_with(|| a.cmp(b))
}

fn shape_of(value: &Value) -> Option<Vec<usize>> {
    value
        .as_array()?
        .iter()
        .map(|dim| dim.as_u64().and_then(|dim| usize::try_from(dim).ok()))
        .collect()
}

/// Shape of a nested list, by its first elements.
fn nested_shape(value: &Value) -> Option<Vec<usize>> {
    let mut shape = Vec::new();
    let mut value = value;
    while let Value::Array(items) = value {
        shape.push(items.len());
        value = items.first()?;
    }
    Some(shape)
}

/// Minari's rule for what it may encode: bytes over the full range, two or three axes, sides of 32 and more.
fn is_picture(space: &Value) -> bool {
    let Some(shape) = space.get("shape").and_then(Value::as_array) else {
        return false;
    };
    let side = |axis: usize| {
        shape
            .get(axis)
            .and_then(Value::as_u64)
            .is_some_and(|n| n >= MIN_PICTURE_SIDE)
    };
    space.get("dtype").and_then(Value::as_str) == Some("uint8")
        && matches!(shape.len(), 2 | 3)
        && side(0)
        && side(1)
        && space.get("low").is_some_and(|low| all_are(low, 0))
        && space.get("high").is_some_and(|high| all_are(high, 255))
}

fn all_are(value: &Value, number: u64) -> bool {
    match value {
        Value::Array(items) => items.iter().all(|item| all_are(item, number)),
        other => other.as_u64() == Some(number),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn goals_frame_the_other_keys() {
        let mut keys = ["desired_goal", "observation", "achieved_goal", "image"];
        keys.sort_by(|a, b| key_order(a, b));
        assert_eq!(
            keys,
            ["achieved_goal", "image", "observation", "desired_goal"]
        );
        let mut tuple = ["_index_10", "_index_2", "_index_0"];
        tuple.sort_by(|a, b| key_order(a, b));
        assert_eq!(tuple, ["_index_0", "_index_2", "_index_10"]);
    }

    #[test]
    fn every_space_type_has_its_shape() {
        let space = Space::parse(&json!({"type": "Dict", "subspaces": {
            "a": {"type": "Box", "dtype": "float32", "shape": [2, 2]},
            "b": {"type": "Tuple", "subspaces": [{"type": "Discrete", "n": 3}, {"type": "MultiDiscrete", "nvec": [3, 4]}]},
            "c": {"type": "MultiBinary", "n": 3},
            "d": {"type": "MultiBinary", "n": [2, 3]},
            "e": {"type": "Text"},
            "f": {"type": "Graph"},
        }}));
        let shape = |space: &Space| match space {
            Space::Leaf { shape, .. } => shape.clone(),
            _ => None,
        };
        assert_eq!(shape(space.member("a")), Some(vec![2, 2]));
        assert_eq!(shape(space.member("b").member("_index_1")), Some(vec![2]));
        assert_eq!(shape(space.member("c")), Some(vec![3]));
        assert_eq!(shape(space.member("d")), Some(vec![2, 3]));
        assert_eq!(space.member("f"), &Space::Unknown);
        assert_eq!(space.member("missing"), &Space::Unknown);
        assert_eq!(Space::parse(&json!("nonsense")), Space::Unknown);
    }

    #[test]
    fn only_full_range_bytes_of_some_size_are_pictures() {
        let kind = |shape: Value, high: u64| {
            Space::parse(
                &json!({"type": "Box", "dtype": "uint8", "shape": shape, "low": [[0]], "high": [high]}),
            )
        };
        assert!(matches!(
            kind(json!([32, 40, 3]), 255),
            Space::Leaf {
                kind: LeafKind::Image,
                ..
            }
        ));
        assert!(matches!(
            kind(json!([31, 40, 3]), 255),
            Space::Leaf {
                kind: LeafKind::Box,
                ..
            }
        ));
        assert!(matches!(
            kind(json!([32, 40, 3]), 1),
            Space::Leaf {
                kind: LeafKind::Box,
                ..
            }
        ));
    }
}
