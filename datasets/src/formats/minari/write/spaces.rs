//! The spaces of a dataset: those of the source if they fit, else made from the columns.

use std::collections::BTreeSet;

use arrow::array::{ArrayRef, AsArray};
use arrow::datatypes::DataType;
use serde_json::{Map, Value, json};

use super::super::json;
use super::super::space::Space;
use super::columns::{Group, Leaf};
use super::tree::Node;
use crate::error::{DatasetError, Result};
use crate::spec::LeafKind;

/// A space on its way to `metadata.json`.
pub(super) struct SpaceText {
    group: Group,
    /// The source's own, in Python's dialect; `None` if it is made from the columns.
    kept: Option<String>,
    /// What was seen of the text of each leaf.
    texts: Vec<Texts>,
}

/// What text leaves hold, for their space.
#[derive(Debug, Clone, Default)]
struct Texts {
    seen: bool,
    min_length: usize,
    max_length: usize,
    charset: BTreeSet<char>,
}

impl SpaceText {
    /// Keeps `recorded` if the columns fit it. `verbatim` is the same as the source wrote it.
    pub(super) fn new(group: &Group, recorded: Option<&Value>, verbatim: Option<&str>) -> Self {
        let fitting = recorded.filter(|value| {
            let space = Space::parse(value);
            group
                .tree
                .as_ref()
                .is_some_and(|tree| fits(&space, tree, group))
        });
        let kept = fitting.map(|value| {
            let same = |text: &&str| json::parse(text, "space").is_ok_and(|own| own == *value);
            match verbatim.filter(same) {
                Some(text) => text.to_owned(),
                None => json::write(value),
            }
        });
        Self {
            group: group.clone(),
            kept,
            texts: vec![Texts::default(); group.leaves.len()],
        }
    }

    /// Whether the source's space is kept.
    pub(super) fn is_kept(&self) -> bool {
        self.kept.is_some()
    }

    /// Whether Minari takes an encoded and a plain leaf for pictures.
    ///
    /// # Errors
    /// It takes one of each, which it cannot read.
    pub(super) fn pictures(&self) -> Result<(bool, bool)> {
        let text = self.write();
        let space = Space::parse(&json::parse(&text, "space")?);
        let (mut encoded, mut plain) = (false, false);
        if let Some(tree) = &self.group.tree {
            pictures(&space, tree, &self.group, &mut |leaf| match leaf.value_type
                == DataType::Binary
            {
                true => encoded = true,
                false => plain = true,
            });
        }
        Ok((encoded, plain))
    }

    /// Notes rows.
    pub(super) fn see(&mut self, arrays: &[ArrayRef]) {
        if self.is_kept() {
            return;
        }
        for (texts, array) in self.texts.iter_mut().zip(arrays) {
            if let Some(array) = array.as_string_opt::<i32>() {
                array.iter().flatten().for_each(|text| texts.see(text));
            }
        }
    }

    /// The space as Minari writes it.
    pub(super) fn write(&self) -> String {
        match (&self.kept, &self.group.tree) {
            (Some(text), _) => text.clone(),
            (None, Some(tree)) => json::write(&self.made(tree)),
            (None, None) => json::write(&json!({"type": "Dict", "subspaces": {}})),
        }
    }

    fn made(&self, node: &Node) -> Value {
        match node {
            Node::Dict(parts) => {
                let parts = parts
                    .iter()
                    .map(|(key, part)| (key.clone(), self.made(part)));
                json!({"type": "Dict", "subspaces": parts.collect::<Map<_, _>>()})
            }
            Node::Tuple(parts) => {
                let parts: Vec<Value> = parts.iter().map(|part| self.made(part)).collect();
                json!({"type": "Tuple", "subspaces": parts})
            }
            Node::Leaf(place) => {
                let leaf = self.group.leaves.get(*place);
                let texts = self.texts.get(*place);
                leaf.zip(texts)
                    .map_or(Value::Null, |(leaf, texts)| made(leaf, texts))
            }
        }
    }
}

impl Texts {
    fn see(&mut self, text: &str) {
        let length = text.chars().count();
        self.min_length = if self.seen {
            self.min_length.min(length)
        } else {
            length
        };
        self.max_length = self.max_length.max(length);
        self.charset.extend(text.chars());
        self.seen = true;
    }
}

/// The widest space whose values have this type and shape.
fn made(leaf: &Leaf, texts: &Texts) -> Value {
    let bounds = |low: Value, high: Value| (low, high);
    let (dtype, (low, high)) = match &leaf.value_type {
        DataType::Utf8 => {
            let charset: String = texts.charset.iter().collect();
            // An empty set of characters is no set to Gymnasium.
            let charset = if charset.is_empty() {
                " ".to_owned()
            } else {
                charset
            };
            return json!({
                "type": "Text",
                "max_length": texts.max_length.max(1),
                "min_length": texts.min_length,
                "charset": charset,
            });
        }
        DataType::Boolean => ("bool", bounds(false.into(), true.into())),
        DataType::Int8 => ("int8", bounds(i8::MIN.into(), i8::MAX.into())),
        DataType::Int16 => ("int16", bounds(i16::MIN.into(), i16::MAX.into())),
        DataType::Int32 => ("int32", bounds(i32::MIN.into(), i32::MAX.into())),
        DataType::Int64 => ("int64", bounds(i64::MIN.into(), i64::MAX.into())),
        // Pictures are bytes.
        DataType::UInt8 | DataType::Binary => ("uint8", bounds(0.into(), u8::MAX.into())),
        DataType::UInt16 => ("uint16", bounds(0.into(), u16::MAX.into())),
        DataType::UInt32 => ("uint32", bounds(0.into(), u32::MAX.into())),
        DataType::UInt64 => ("uint64", bounds(0.into(), u64::MAX.into())),
        DataType::Float16 => ("float16", bounds("-Infinity".into(), "Infinity".into())),
        DataType::Float32 => ("float32", bounds("-Infinity".into(), "Infinity".into())),
        _ => ("float64", bounds("-Infinity".into(), "Infinity".into())),
    };
    json!({
        "type": "Box",
        "dtype": dtype,
        "shape": leaf.shape,
        "low": nested(&leaf.shape, low),
        "high": nested(&leaf.shape, high),
    })
}

/// A list of lists of this shape, all of one value.
fn nested(shape: &[usize], value: Value) -> Value {
    match shape.split_first() {
        None => value,
        Some((&n, rest)) => Value::Array(vec![nested(rest, value); n]),
    }
}

/// Whether the columns are what the space says. Spaces of a type that is not known fit anything.
fn fits(space: &Space, node: &Node, group: &Group) -> bool {
    match (space, node) {
        (Space::Unknown, _) => true,
        (Space::Dict(parts), Node::Dict(nodes)) => {
            let fits_member = |(key, node): &(String, Node)| {
                let part = parts.iter().find(|(name, _)| name == key);
                part.is_some_and(|(_, part)| fits(part, node, group))
            };
            parts.len() == nodes.len() && nodes.iter().all(fits_member)
        }
        (Space::Tuple(parts), Node::Tuple(nodes)) => {
            parts.len() == nodes.len()
                && parts
                    .iter()
                    .zip(nodes)
                    .all(|(part, node)| fits(part, node, group))
        }
        (Space::Leaf { kind, shape, .. }, Node::Leaf(place)) => {
            let Some(leaf) = group.leaves.get(*place) else {
                return false;
            };
            let kind_fits = match leaf.value_type {
                DataType::Utf8 => *kind == LeafKind::Text,
                DataType::Binary => *kind == LeafKind::Image,
                _ => *kind != LeafKind::Text,
            };
            kind_fits && shape.as_ref().is_none_or(|shape| *shape == leaf.shape)
        }
        _ => false,
    }
}

/// Calls `found` for every leaf that the space makes a picture.
fn pictures(space: &Space, node: &Node, group: &Group, found: &mut dyn FnMut(&Leaf)) {
    match (space, node) {
        (Space::Dict(_), Node::Dict(nodes)) => {
            for (key, node) in nodes {
                pictures(space.member(key), node, group, found);
            }
        }
        (Space::Tuple(parts), Node::Tuple(nodes)) => {
            for (part, node) in parts.iter().zip(nodes) {
                pictures(part, node, group, found);
            }
        }
        (Space::Leaf { kind, .. }, Node::Leaf(place)) if *kind == LeafKind::Image => {
            group.leaves.get(*place).into_iter().for_each(found);
        }
        _ => {}
    }
}

/// One flag says for the whole dataset whether pictures are encoded.
///
/// # Errors
/// Some are and some are not.
pub(super) fn jpeg_encoding(spaces: [&SpaceText; 2]) -> Result<Option<bool>> {
    let (mut encoded, mut plain) = (false, false);
    for space in spaces {
        let (some_encoded, some_plain) = space.pictures()?;
        encoded |= some_encoded;
        plain |= some_plain;
    }
    match (encoded, plain) {
        (true, true) => Err(DatasetError::Unsupported {
            what: "encoded and plain pictures in one Minari dataset".to_owned(),
        }),
        (false, false) => Ok(None),
        _ => Ok(Some(encoded)),
    }
}
