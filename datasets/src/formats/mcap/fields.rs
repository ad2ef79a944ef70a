//! Numbers and texts of a message as the row of a column.

use arrow::datatypes::DataType;

use super::Value;
use super::base64;
use super::bind::Layout;
use super::decode::{FieldDescription, FieldKind, FieldLength, FieldPath, Slot};
use super::mapping::{NamesField, TopicFields};
use super::paths::{Paths, leaf_names, leaves_of, names_beside};
use super::values::{self, Number};
use crate::error::{DatasetError, Result};

/// A column of numbers or text.
pub(super) struct Values {
    leaves: Vec<Leaf>,
    /// Names from the mapping or of the leaves.
    names: Option<Vec<String>>,
    /// The slot with the names by which values are picked.
    names_slot: Option<usize>,
    /// Names of the last message, and where each wanted one is in it.
    seen: (Vec<String>, Vec<Option<usize>>),
    is_exact: bool,
}

struct Leaf {
    /// In the plan's slots, or in the paths of the tree.
    slot: usize,
    field: FieldDescription,
}

/// A message, taken apart.
pub(super) struct Source<'s> {
    pub(super) slots: &'s [Slot],
    /// The whole message, and paths in it.
    pub(super) tree: Option<&'s Value>,
    pub(super) paths: &'s [FieldPath],
}

impl Source<'_> {
    fn texts(&self, slot: usize) -> impl ExactSizeIterator<Item = &str> {
        static NOTHING: std::sync::LazyLock<Slot> = std::sync::LazyLock::new(Slot::default);
        self.slots.get(slot).unwrap_or(&NOTHING).texts()
    }

    /// All numbers of a leaf.
    fn exact(&self, slot: usize) -> Option<Vec<Number>> {
        let mut numbers = Vec::new();
        let found = values::reach(self.tree?, self.paths.get(slot)?);
        let is_whole = found
            .iter()
            .all(|value| values::numbers(value, &mut numbers));
        (is_whole && !found.is_empty()).then_some(numbers)
    }
}

impl Values {
    /// `by_tree` if numbers are to be taken from the whole decoded message.
    pub(super) fn new(
        fields: &[FieldDescription],
        topic: &TopicFields,
        paths: &mut Paths,
        by_tree: bool,
    ) -> Result<Self> {
        let mut found = Vec::new();
        for path in &topic.paths {
            found.append(&mut leaves_of(fields, path)?);
        }
        let long = [DataType::Int64, DataType::UInt64].map(FieldKind::Number);
        let is_exact = by_tree || found.iter().any(|field| long.contains(&field.kind));
        let names_of_values = topic.names.clone().or_else(|| leaf_names(&found));
        let mut leaves = Vec::with_capacity(found.len());
        for field in found {
            let path = field.path.parse()?;
            let slot = match is_exact {
                true => paths.add_to_tree(path),
                false => paths.add(path),
            };
            leaves.push(Leaf { slot, field });
        }
        let names = match &topic.names_field {
            NamesField::None => None,
            NamesField::Path(path) => Some(path.clone()),
            NamesField::Beside => names_beside(fields, &topic.paths),
        };
        let names_slot = match names {
            Some(path) if leaves.len() == 1 => Some(paths.add(path.parse()?)),
            Some(_) if topic.names_field != NamesField::Beside => {
                return Err(DatasetError::Unsupported {
                    what: format!("names of several fields of \"{}\"", topic.topic),
                });
            }
            _ => None,
        };
        Ok(Self {
            is_exact,
            names: names_of_values,
            leaves,
            names_slot,
            seen: Default::default(),
        })
    }

    /// Whether every leaf is in the message.
    fn is_there(&self, source: &Source<'_>) -> bool {
        self.leaves.iter().all(|leaf| match self.is_exact {
            true => source.exact(leaf.slot).is_some(),
            false => source.slots.get(leaf.slot).is_some_and(Slot::present),
        })
    }

    pub(super) fn layout(&self, source: &Source<'_>) -> Option<Layout> {
        let first = self.leaves.first()?;
        if !self.is_there(source) {
            return None;
        }
        if self.is_text(source) {
            return Some(Layout {
                value_type: DataType::Utf8,
                shape: Vec::new(),
                names: None,
                picture: None,
            });
        }
        let names = match (&self.names, self.names_slot) {
            (None, Some(slot)) => Some(source.texts(slot).map(str::to_owned).collect()),
            (names, _) => names.clone(),
        };
        let n_values: usize = match (self.names_slot, &names) {
            (Some(_), Some(names)) => names.len(),
            _ => self
                .leaves
                .iter()
                .map(|leaf| self.count(source, leaf))
                .sum(),
        };
        if n_values == 0 {
            return None;
        }
        let is_scalar = self.leaves.len() == 1
            && n_values == 1
            && self.names_slot.is_none()
            && match first.field.length {
                FieldLength::One => !first.field.path.contains("[]"),
                _ => false,
            };
        Some(Layout {
            value_type: self.value_type(),
            shape: if is_scalar {
                Vec::new()
            } else {
                vec![n_values]
            },
            names: names.filter(|names| names.len() == n_values && !is_scalar),
            picture: None,
        })
    }

    fn is_text(&self, source: &Source<'_>) -> bool {
        let [leaf] = self.leaves.as_slice() else {
            return false;
        };
        match leaf.field.kind {
            FieldKind::Text => true,
            FieldKind::Any => source.texts(leaf.slot).len() == 1,
            _ => false,
        }
    }

    fn count(&self, source: &Source<'_>, leaf: &Leaf) -> usize {
        let slot = source.slots.get(leaf.slot);
        match leaf.field.kind {
            _ if self.is_exact => source.exact(leaf.slot).map_or(0, |numbers| numbers.len()),
            FieldKind::Bytes => slot.map_or(0, |slot| slot.bytes().len()),
            FieldKind::Time | FieldKind::Duration => 1,
            _ => slot.map_or(0, |slot| slot.numbers().len()),
        }
    }

    /// The type of the fields if they agree, else the one that holds all small ones.
    fn value_type(&self) -> DataType {
        let of = |leaf: &Leaf| match &leaf.field.kind {
            FieldKind::Number(data_type) => data_type.clone(),
            FieldKind::Bool => DataType::Boolean,
            FieldKind::Bytes => DataType::UInt8,
            FieldKind::Time | FieldKind::Duration => DataType::Int64,
            FieldKind::Text | FieldKind::Any => DataType::Float64,
        };
        let mut types = self.leaves.iter().map(of);
        let first = types.next().unwrap_or(DataType::Float64);
        match types.all(|other| other == first) {
            // A list of flags has no column type of its own.
            true if first == DataType::Boolean
                && !matches!(self.leaves.as_slice(), [leaf] if leaf.field.length == FieldLength::One) =>
            {
                DataType::UInt8
            }
            true => first,
            false => DataType::Float64,
        }
    }

    /// The text says what does not fit.
    pub(super) fn read(
        &mut self,
        source: &Source<'_>,
        layout: &Layout,
        out: &mut Vec<u8>,
    ) -> Result<bool, String> {
        if !self.is_there(source) {
            return Ok(false);
        }
        let only = self.leaves.first().map_or(0, |leaf| leaf.slot);
        match layout.value_type {
            DataType::Utf8 => {
                let text = source.texts(only).next().unwrap_or_default();
                out.extend_from_slice(text.as_bytes());
                return Ok(true);
            }
            DataType::Binary => {
                let slot = source.slots.get(only);
                match slot.and_then(|slot| slot.texts().next()) {
                    // JSON has no bytes.
                    Some(text) => {
                        out.extend(base64::decode(text).ok_or("text that is not base64")?)
                    }
                    None => out.extend_from_slice(slot.map(Slot::bytes).unwrap_or_default()),
                }
                return Ok(true);
            }
            _ => {}
        }
        if let (Some(slot), Some(names)) = (self.names_slot, &layout.names) {
            return self.read_by_name(source, slot, names, layout, out);
        }
        let n_values: usize = self
            .leaves
            .iter()
            .map(|leaf| self.count(source, leaf))
            .sum();
        // Protobuf does not tell an empty list from one that is not there.
        if n_values == 0 {
            return Ok(layout.width() == 0);
        }
        if n_values != layout.width() {
            return Err(format!(
                "{} has {n_values} values, expected {} as before",
                self.label(),
                layout.width()
            ));
        }
        for leaf in &self.leaves {
            self.push_all(source, leaf, &layout.value_type, out)?;
        }
        Ok(true)
    }

    fn label(&self) -> &str {
        self.leaves.first().map_or("", |leaf| &leaf.field.path)
    }

    fn push_all(
        &self,
        source: &Source<'_>,
        leaf: &Leaf,
        to: &DataType,
        out: &mut Vec<u8>,
    ) -> Result<(), String> {
        let inexact =
            |number: Number| format!("{} holds {number:?}, which {to} cannot", leaf.field.path);
        let push = |number: Number, out: &mut Vec<u8>| match values::push(to, number, out) {
            true => Ok(()),
            false => Err(inexact(number)),
        };
        if self.is_exact {
            let numbers = source.exact(leaf.slot).unwrap_or_default();
            return numbers.into_iter().try_for_each(|number| push(number, out));
        }
        let Some(slot) = source.slots.get(leaf.slot) else {
            return Ok(());
        };
        match leaf.field.kind {
            FieldKind::Bytes if *to == DataType::UInt8 => out.extend_from_slice(slot.bytes()),
            FieldKind::Bytes => {
                for byte in slot.bytes() {
                    push(Number::Integer(i128::from(*byte)), out)?;
                }
            }
            FieldKind::Time | FieldKind::Duration => {
                push(
                    Number::Integer(i128::from(slot.time_ns().unwrap_or(0))),
                    out,
                )?;
            }
            _ if *to == DataType::Float64 => {
                out.extend(slot.numbers().iter().flat_map(|v| v.to_ne_bytes()))
            }
            _ => {
                for number in slot.numbers() {
                    push(Number::Float(*number), out)?;
                }
            }
        }
        Ok(())
    }

    fn read_by_name(
        &mut self,
        source: &Source<'_>,
        names_slot: usize,
        wanted: &[String],
        layout: &Layout,
        out: &mut Vec<u8>,
    ) -> Result<bool, String> {
        if !source
            .texts(names_slot)
            .eq(self.seen.0.iter().map(String::as_str))
        {
            self.seen.0 = source.texts(names_slot).map(str::to_owned).collect();
            let is_twice =
                |name: &&String| self.seen.0.iter().filter(|seen| seen == name).count() > 1;
            if let Some(name) = wanted.iter().find(is_twice) {
                return Err(format!(
                    "{} has the name \"{}\" twice (say `names_field = \"\"` to take values by their place)",
                    self.label(),
                    name.escape_debug()
                ));
            }
            self.seen.1 = wanted
                .iter()
                .map(|name| self.seen.0.iter().position(|seen| seen == name))
                .collect();
        }
        let Some(leaf) = self.leaves.first() else {
            return Ok(false);
        };
        let floats = source
            .slots
            .get(leaf.slot)
            .map(Slot::numbers)
            .unwrap_or_default();
        let numbers = match self.is_exact {
            true => source.exact(leaf.slot).unwrap_or_default(),
            false => Vec::new(),
        };
        for place in &self.seen.1 {
            let number = place.and_then(|place| match self.is_exact {
                true => numbers.get(place).copied(),
                false => floats.get(place).map(|number| Number::Float(*number)),
            });
            // A joint without a value makes the whole row null.
            let Some(number) = number else {
                return Ok(false);
            };
            if !values::push(&layout.value_type, number, out) {
                return Err(format!(
                    "{} holds {number:?}, which {} cannot",
                    leaf.field.path, layout.value_type
                ));
            }
        }
        Ok(true)
    }
}
