//! ROS message types, resolved.

use std::sync::Arc;

use arrow::datatypes::DataType;

use crate::formats::mcap::decode::{FieldDescription, FieldKind, FieldLength, MAX_LISTED};

/// The generation of ROS: they differ in builtin types and in the layout of messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Flavor {
    /// Packed, without alignment; `time`, `duration` and `Header` are built in.
    Ros1,
    /// CDR.
    Ros2,
}

/// A number of fixed size, or a flag.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Primitive {
    Bool,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Primitive {
    pub(super) fn named(name: &str, flavor: Flavor) -> Option<Self> {
        Some(match (name, flavor) {
            ("bool", _) => Self::Bool,
            ("byte", Flavor::Ros1) | ("int8", _) => Self::I8,
            ("byte" | "char" | "uint8", _) => Self::U8,
            ("int16", _) => Self::I16,
            ("uint16", _) => Self::U16,
            ("int32", _) => Self::I32,
            ("uint32", _) => Self::U32,
            ("int64", _) => Self::I64,
            ("uint64", _) => Self::U64,
            ("float32", _) => Self::F32,
            ("float64", _) => Self::F64,
            _ => return None,
        })
    }

    /// Bytes of a value.
    pub(super) fn size(self) -> usize {
        match self {
            Self::Bool | Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    fn kind(self) -> FieldKind {
        FieldKind::Number(match self {
            Self::Bool => return FieldKind::Bool,
            Self::I8 => DataType::Int8,
            Self::U8 => DataType::UInt8,
            Self::I16 => DataType::Int16,
            Self::U16 => DataType::UInt16,
            Self::I32 => DataType::Int32,
            Self::U32 => DataType::UInt32,
            Self::I64 => DataType::Int64,
            Self::U64 => DataType::UInt64,
            Self::F32 => DataType::Float32,
            Self::F64 => DataType::Float64,
        })
    }
}

/// What one value of a field is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Primitive(Primitive),
    /// With the most bytes it may have.
    Text(Option<usize>),
    /// Its place in [`Types::structs`].
    Struct(usize),
}

/// How many values a field has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Count {
    One,
    Fixed(usize),
    Bounded(usize),
    Any,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Field {
    pub(super) name: Arc<str>,
    pub(super) kind: Kind,
    pub(super) count: Count,
}

/// The structs that are points or spans of time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Clock {
    Time,
    Duration,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Struct {
    pub(super) name: String,
    pub(super) fields: Vec<Field>,
    pub(super) clock: Option<Clock>,
    /// Bytes it takes at least, alignment not counted. 0 only if it never takes any.
    pub(super) min_size: usize,
    /// If it is so many primitives of one size: size and number.
    pub(super) uniform: Option<(usize, usize)>,
}

/// A message type and those it is made of. No struct holds itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Types {
    pub(super) flavor: Flavor,
    /// Each after those it holds; the last is the message.
    pub(super) structs: Vec<Struct>,
}

impl Types {
    pub(super) fn get(&self, place: usize) -> Option<&Struct> {
        self.structs.get(place)
    }

    pub(super) fn root(&self) -> Option<&Struct> {
        self.structs.last()
    }

    /// Bytes a value takes at least.
    pub(super) fn min_size(&self, kind: Kind) -> usize {
        match kind {
            Kind::Primitive(primitive) => primitive.size(),
            Kind::Text(_) => 4,
            Kind::Struct(place) => self.get(place).map_or(0, |s| s.min_size),
        }
    }

    /// Size and number of the primitives of a value, if they are all of one size.
    pub(super) fn uniform(&self, kind: Kind) -> Option<(usize, usize)> {
        match kind {
            Kind::Primitive(primitive) => Some((primitive.size(), 1)),
            Kind::Text(_) => None,
            Kind::Struct(place) => self.get(place)?.uniform,
        }
    }

    /// Adds a struct whose parts are there already; its place.
    pub(super) fn add(&mut self, name: String, fields: Vec<Field>, clock: Option<Clock>) -> usize {
        let dummy = usize::from(fields.is_empty() && self.flavor == Flavor::Ros2);
        let sizes = fields.iter().map(|field| match field.count {
            Count::One => self.min_size(field.kind),
            Count::Fixed(n) => n.saturating_mul(self.min_size(field.kind)),
            Count::Bounded(_) | Count::Any => 4,
        });
        let min_size = sizes.fold(dummy, usize::saturating_add);
        let uniform = self.uniform_fields(&fields);
        self.structs.push(Struct {
            name,
            fields,
            clock,
            min_size,
            uniform,
        });
        self.structs.len() - 1
    }

    fn uniform_fields(&self, fields: &[Field]) -> Option<(usize, usize)> {
        let mut all: Option<(usize, usize)> = None;
        for field in fields {
            let (size, n) = self.uniform(field.kind)?;
            let n = match field.count {
                Count::One => n,
                Count::Fixed(times) => n.checked_mul(times).filter(|&n| n > 0)?,
                Count::Bounded(_) | Count::Any => return None,
            };
            all = match all {
                None => Some((size, n)),
                Some((other, sum)) if other == size => Some((size, sum.checked_add(n)?)),
                Some(_) => return None,
            };
        }
        all
    }

    /// The fields that can be extracted.
    pub(crate) fn describe(&self) -> Vec<FieldDescription> {
        let mut found = Vec::new();
        if let Some(root) = self.root() {
            self.describe_struct(root, "", false, &mut found);
        }
        found
    }

    fn describe_struct(
        &self,
        of: &Struct,
        prefix: &str,
        in_array: bool,
        found: &mut Vec<FieldDescription>,
    ) {
        for field in &of.fields {
            if found.len() >= MAX_LISTED {
                return;
            }
            let is_array = field.count != Count::One;
            // Arrays in arrays have no path.
            if is_array && in_array {
                continue;
            }
            let path = format!("{prefix}{}", field.name);
            let length = match field.count {
                Count::One if in_array => FieldLength::Variable { max: None },
                Count::One => FieldLength::One,
                Count::Fixed(n) => FieldLength::Fixed(n),
                Count::Bounded(n) => FieldLength::Variable { max: Some(n) },
                Count::Any => FieldLength::Variable { max: None },
            };
            let kind = match field.kind {
                Kind::Primitive(Primitive::U8) if is_array => FieldKind::Bytes,
                Kind::Primitive(primitive) => primitive.kind(),
                Kind::Text(_) => FieldKind::Text,
                Kind::Struct(place) => {
                    let Some(inner) = self.get(place).filter(|inner| inner.min_size > 0) else {
                        continue;
                    };
                    match inner.clock {
                        Some(Clock::Time) if !is_array && !in_array => FieldKind::Time,
                        Some(Clock::Duration) if !is_array && !in_array => FieldKind::Duration,
                        _ => {
                            let each = if is_array { "[]" } else { "" };
                            let prefix = format!("{path}{each}.");
                            self.describe_struct(inner, &prefix, in_array || is_array, found);
                            continue;
                        }
                    }
                }
            };
            found.push(FieldDescription { path, kind, length });
        }
    }
}
