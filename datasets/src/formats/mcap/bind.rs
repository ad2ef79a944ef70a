//! Columns of a mapping bound to the fields of a channel: from a message to the bytes of a row.

use arrow::datatypes::DataType;

use super::decode::{Extracted, FieldDescription, FieldKind, FieldPath, Plan};
use super::fields::{Source, Values};
use super::mapping::{Column, Dtype, From, Kind, Missing};
use super::paths::Paths;
use super::picture::{PictureKind, PictureLayout};

use super::{Channel, Decoder, Message, Value};
use crate::error::{DatasetError, Result};

/// What the rows of a column are; known from the first message that has values.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Layout {
    /// Type of one value: a number, `Boolean`, `Utf8` or `Binary`.
    pub(crate) value_type: DataType,
    /// Shape of a row; empty for a scalar.
    pub(crate) shape: Vec<usize>,
    pub(crate) names: Option<Vec<String>>,
    /// For pictures.
    pub(crate) picture: Option<PictureLayout>,
}

impl Layout {
    /// Values in a row.
    pub(crate) fn width(&self) -> usize {
        self.shape.iter().product()
    }
}

/// The columns of a topic, read from the messages of one of its channels.
pub(crate) struct ChannelReader {
    decoder: Decoder,
    plan: Plan,
    /// Paths in `tree`.
    paths: Vec<FieldPath>,
    extracted: Extracted,
    /// The whole message, where a column needs integers or JSON's words exactly.
    tree: Option<Value>,
    stamp: Option<usize>,
    columns: Vec<Bound>,
}

/// A column in a [`ChannelReader`].
struct Bound {
    /// Its place in the mapping.
    column: usize,
    what: What,
    missing: Missing,
    value_type: Option<DataType>,
    shape: Option<Vec<usize>>,
}

enum What {
    Picture {
        kind: PictureKind,
        slots: std::ops::Range<usize>,
    },
    Values(Values),
}

impl ChannelReader {
    /// Binds columns, given with their place in the mapping; with `stamp` the time stamp inside messages too.
    ///
    /// # Errors
    /// An encoding that is not read, a field that the messages do not have, or one that cannot be a column.
    pub(crate) fn new(
        channel: &Channel,
        columns: &[(usize, &Column)],
        stamp: bool,
    ) -> Result<Self> {
        let decoder = Decoder::new(channel)?;
        let fields = decoder.fields();
        let mut paths = Paths::default();
        let stamp = match stamp {
            true => Some(paths.add(stamp_path(&fields, &channel.topic)?)),
            false => None,
        };
        let is_json = channel.message_encoding == "json";
        let mut bound = Vec::with_capacity(columns.len());
        for (place, column) in columns {
            if let From::Topic(topic) = &column.from {
                let dtype = column.dtype.map(Dtype::data_type);
                let is_number =
                    dtype.is_some_and(|dtype| !matches!(dtype, DataType::Utf8 | DataType::Binary));
                let what = match column.kind {
                    Some(Kind::Image) if topic.paths.is_empty() => picture(&fields, &mut paths)?,
                    _ => What::Values(Values::new(
                        &fields,
                        topic,
                        &mut paths,
                        is_json && is_number,
                    )?),
                };
                bound.push(Bound {
                    column: *place,
                    what,
                    missing: topic.missing,
                    value_type: column.dtype.map(Dtype::data_type),
                    shape: column.shape.clone(),
                });
            }
        }
        Ok(Self {
            plan: decoder.plan(&paths.planned)?,
            decoder,
            paths: paths.in_tree,
            extracted: Extracted::default(),
            tree: None,
            stamp,
            columns: bound,
        })
    }

    /// Number of columns.
    pub(crate) fn n_columns(&self) -> usize {
        self.columns.len()
    }

    /// Place of a column in the mapping.
    pub(crate) fn column(&self, at: usize) -> usize {
        self.columns[at].column
    }

    /// Reads a message; the other functions tell of it.
    pub(crate) fn load(&mut self, message: &Message<'_>) -> Result<()> {
        if !self.paths.is_empty() {
            self.tree = Some(self.decoder.decode(message)?);
        }
        self.plan.extract(message, &mut self.extracted)
    }

    /// The time stamp inside the message; `None` if it is zero or not there.
    pub(crate) fn stamp(&self) -> Option<i64> {
        self.extracted
            .slots()
            .get(self.stamp?)?
            .time_ns()
            .filter(|time| *time != 0)
    }

    /// What the rows of a column are, judged by this message; `None` if it has no values.
    pub(crate) fn layout(&self, at: usize, message: &Message<'_>) -> Result<Option<Layout>> {
        let bound = &self.columns[at];
        let mut layout = match &bound.what {
            What::Picture { kind, slots } => {
                let slots = self
                    .extracted
                    .slots()
                    .get(slots.clone())
                    .unwrap_or_default();
                let picture = kind.layout(slots).map_err(|what| message.error(what))?;
                Layout {
                    value_type: picture.value_type.clone(),
                    shape: picture.shape.clone(),
                    names: None,
                    picture: Some(picture),
                }
            }
            What::Values(values) => {
                let source = self.source();
                match values.layout(&source) {
                    Some(layout) => layout,
                    None => return Ok(None),
                }
            }
        };
        if let Some(value_type) = &bound.value_type {
            layout.value_type = value_type.clone();
        }
        if let Some(shape) = &bound.shape {
            let declared = shape.iter().try_fold(1usize, |n, d| n.checked_mul(*d));
            if declared != Some(layout.width())
                && !matches!(layout.value_type, DataType::Utf8 | DataType::Binary)
            {
                let what = format!(
                    "{} values, which are no row of shape {shape:?}",
                    layout.width()
                );
                return Err(message.error(what));
            }
            layout.shape.clone_from(shape);
        }
        Ok(Some(layout))
    }

    /// Appends the row of a column; `false` if it is null (nothing is appended then).
    pub(crate) fn read(
        &mut self,
        at: usize,
        layout: &Layout,
        message: &Message<'_>,
        out: &mut Vec<u8>,
    ) -> Result<bool> {
        let source = Source {
            slots: self.extracted.slots(),
            tree: self.tree.as_ref(),
            paths: &self.paths,
        };
        let Some(bound) = self.columns.get_mut(at) else {
            return Ok(false);
        };
        let start = out.len();
        let read = match (&mut bound.what, &layout.picture) {
            (What::Picture { kind, slots }, Some(picture)) => {
                let slots = source.slots.get(slots.clone()).unwrap_or_default();
                kind.read(slots, picture, out).map(|()| true)
            }
            (What::Picture { .. }, None) => Ok(false),
            (What::Values(values), _) => values.read(&source, layout, out),
        };
        let is_there = read.map_err(|what| message.error(what))?;
        if !is_there {
            out.truncate(start);
            if bound.missing == Missing::Error {
                return Err(message.error("a value is missing (say `missing = \"null\"` for such a column to be null there)"));
            }
        }
        Ok(is_there)
    }

    fn source(&self) -> Source<'_> {
        Source {
            slots: self.extracted.slots(),
            tree: self.tree.as_ref(),
            paths: &self.paths,
        }
    }
}

fn stamp_path(fields: &[FieldDescription], topic: &str) -> Result<FieldPath> {
    let found = ["header.stamp", "timestamp"].into_iter().find(|path| {
        fields
            .iter()
            .any(|field| field.path == *path && field.kind == FieldKind::Time)
    });
    match found {
        Some(path) => path.parse(),
        None => Err(DatasetError::Unsupported {
            what: format!(
                "`clock = \"header\"` with \"{topic}\", whose messages have no time stamp"
            ),
        }),
    }
}

fn picture(fields: &[FieldDescription], paths: &mut Paths) -> Result<What> {
    let kind = PictureKind::of(fields)?;
    let start = paths.planned.len();
    for path in kind.paths()? {
        paths.add(path);
    }
    Ok(What::Picture {
        kind,
        slots: start..paths.planned.len(),
    })
}
