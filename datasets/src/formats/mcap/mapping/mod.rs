//! Which fields of which topics are observation and action: the TOML file of
//! [`OpenOptions::mapping`](crate::OpenOptions::mapping). `docs/mcap-mapping.md` describes every key.

mod check;
mod columns;
mod file;

use std::collections::BTreeMap;
use std::path::Path;

use arrow::datatypes::DataType;
use serde::Deserialize;

use super::align::{Align, Pace};
use crate::error::{DatasetError, Result};

/// Bytes of a mapping file, at most.
const MAX_BYTES: u64 = 1 << 20;

/// The time that orders messages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Clock {
    /// When the recorder got the message.
    #[default]
    Log,
    /// When it was sent, as the recorder knows it.
    Publish,
    /// The stamp inside the message: when it was measured.
    Header,
}

impl Clock {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Log => "log",
            Self::Publish => "publish",
            Self::Header => "header",
        }
    }
}

/// What the values of a column are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Kind {
    /// Radians that wrap at 2π.
    Angle,
    /// Unit quaternions x, y, z, w; q and −q are the same rotation.
    QuaternionXyzw,
    /// A picture: the whole message is one.
    Image,
}

impl Kind {
    /// The value of the field metadata; pictures have metadata of their own.
    pub(crate) fn name(self) -> Option<&'static str> {
        match self {
            Self::Angle => Some("angle"),
            Self::QuaternionXyzw => Some("quaternion_xyzw"),
            Self::Image => None,
        }
    }
}

/// The value type of a column. Values that it cannot hold exactly are an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Dtype {
    Bool,
    Int8,
    Int16,
    Int32,
    Int64,
    Uint8,
    Uint16,
    Uint32,
    Uint64,
    Float16,
    Float32,
    Float64,
    Text,
    Binary,
}

impl Dtype {
    pub(crate) const ALL: [(Self, &'static str, DataType); 14] = [
        (Self::Bool, "bool", DataType::Boolean),
        (Self::Int8, "int8", DataType::Int8),
        (Self::Int16, "int16", DataType::Int16),
        (Self::Int32, "int32", DataType::Int32),
        (Self::Int64, "int64", DataType::Int64),
        (Self::Uint8, "uint8", DataType::UInt8),
        (Self::Uint16, "uint16", DataType::UInt16),
        (Self::Uint32, "uint32", DataType::UInt32),
        (Self::Uint64, "uint64", DataType::UInt64),
        (Self::Float16, "float16", DataType::Float16),
        (Self::Float32, "float32", DataType::Float32),
        (Self::Float64, "float64", DataType::Float64),
        (Self::Text, "text", DataType::Utf8),
        (Self::Binary, "binary", DataType::Binary),
    ];

    /// The Arrow type.
    pub(crate) fn data_type(self) -> DataType {
        let found = Self::ALL.into_iter().find(|(dtype, ..)| *dtype == self);
        found.map_or(DataType::Null, |(_, _, data_type)| data_type)
    }

    /// The name in a mapping of an Arrow type.
    pub(crate) fn name_of(data_type: &DataType) -> Option<&'static str> {
        let found = Self::ALL.into_iter().find(|(.., known)| known == data_type);
        found.map(|(_, name, _)| name)
    }
}

/// What becomes of a name or value that a message lacks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Missing {
    /// The recording is refused.
    #[default]
    Error,
    /// The value is null: the whole row of the column, for vectors.
    Null,
}

/// What becomes of a step for which a column has no sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum OnMiss {
    /// The step is left out.
    Drop,
    /// The value is null.
    Null,
    /// The episode ends before the step, and another begins at the next whole one.
    Split,
    /// The recording is refused.
    Error,
}

/// The moments at which there is a step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Grid {
    /// At a fixed pace from the first moment at which every required topic has spoken.
    Pace(Pace),
    /// At every message of a topic.
    Topic(String),
    /// At every message of a topic that also numbers the rows; columns match by equal time.
    Index(Index),
}

/// A topic that numbers the rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Index {
    pub(crate) topic: String,
    /// Path of the episode number.
    pub(crate) episode: String,
    /// Path of the step number.
    pub(crate) step: String,
    /// Path of the time in the episode.
    pub(crate) t_ns: Option<String>,
}

/// Where episodes begin and end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum EpisodeRule {
    /// A file is an episode.
    File,
    /// A new one begins after a silence of more than `gap_ns` on a topic.
    Gap { topic: String, gap_ns: u64 },
    /// By the messages of a topic.
    Marker(Marker),
    /// By the numbers of [`Grid::Index`].
    Index,
}

/// A topic whose messages begin and end episodes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Marker {
    pub(crate) topic: String,
    pub(crate) on: MarkerOn,
}

/// What a marker message says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum MarkerOn {
    /// A text that begins with `start` or `end`.
    Text {
        field: String,
        start: String,
        end: Option<String>,
        /// A word in the end text.
        success: Option<String>,
        failure: Option<String>,
    },
    /// A flag that is true while an episode runs.
    Bool { field: String },
    /// Every message begins one.
    Message,
}

/// Where a column stands in the canonical table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    Observation,
    Action,
    Reward,
    Terminated,
    Truncated,
    Info,
}

/// One column of the table.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Column {
    /// Full name, such as `observation.joints`.
    pub(crate) name: String,
    pub(crate) role: Role,
    pub(crate) from: From,
    /// Value type, where it is not that of the field.
    pub(crate) dtype: Option<Dtype>,
    pub(crate) shape: Option<Vec<usize>>,
    pub(crate) unit: Option<String>,
    pub(crate) kind: Option<Kind>,
    pub(crate) align: Align,
    /// How far the sample may be, see [`super::align::pick`].
    pub(crate) reach: Option<u64>,
    pub(crate) on_miss: OnMiss,
    /// Whether the grid waits for its topic.
    pub(crate) required: bool,
    /// Further field metadata, verbatim.
    pub(crate) metadata: BTreeMap<String, String>,
}

/// What a column is made of.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum From {
    /// Fields of a topic.
    Topic(TopicFields),
    /// The value of another column (by its place) at the next step of the episode.
    NextOf(usize),
}

/// Fields of the messages of a topic.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TopicFields {
    pub(crate) topic: String,
    /// Paths whose values are joined; empty for a picture.
    pub(crate) paths: Vec<String>,
    /// Names of the values.
    pub(crate) names: Option<Vec<String>>,
    pub(crate) names_field: NamesField,
    pub(crate) missing: Missing,
}

/// The field that lists the names of the values, by which they are picked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum NamesField {
    /// A text list `name` beside the values, if there is one.
    Beside,
    /// None: values are taken by their place.
    None,
    /// This path.
    Path(String),
}

/// Something said once per recording or episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Recorded {
    /// In a metadata record of the file.
    Metadata { record: String, key: String },
    /// In the mapping.
    Text(String),
    /// By a topic: the newest text at the end of the episode.
    Topic { topic: String, field: String },
}

/// A checked mapping.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Mapping {
    /// The TOML it was read from.
    pub(crate) text: String,
    pub(crate) clock: Clock,
    pub(crate) grid: Grid,
    pub(crate) episodes: EpisodeRule,
    /// In the order of the table.
    pub(crate) columns: Vec<Column>,
    pub(crate) success: Option<Recorded>,
    pub(crate) task: Option<Recorded>,
}

impl Mapping {
    /// Reads a mapping file.
    ///
    /// # Errors
    /// It cannot be read, or what [`Self::parse`] finds; the file is named.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let read = || {
            let size = std::fs::metadata(path).map_err(|e| DatasetError::io("open", e))?;
            if size.len() > MAX_BYTES {
                return Err(DatasetError::corrupt(format!(
                    "a mapping of {} bytes, expected at most {MAX_BYTES}",
                    size.len()
                )));
            }
            let text = std::fs::read_to_string(path).map_err(|e| DatasetError::io("read", e))?;
            Self::parse(&text)
        };
        read().map_err(|error| error.in_file(path))
    }

    /// Checks a mapping.
    ///
    /// # Errors
    /// [`DatasetError::Mapping`] with the line of the first fault.
    pub(crate) fn parse(text: &str) -> Result<Self> {
        check::parse(text)
    }

    /// All topics it names, each once, in order.
    pub(crate) fn topics(&self) -> Vec<&str> {
        let mut topics: Vec<&str> = Vec::new();
        let grid = match &self.grid {
            Grid::Pace(_) => None,
            Grid::Topic(topic) => Some(topic),
            Grid::Index(index) => Some(&index.topic),
        };
        let episodes = match &self.episodes {
            EpisodeRule::File | EpisodeRule::Index => None,
            EpisodeRule::Gap { topic, .. } => Some(topic),
            EpisodeRule::Marker(marker) => Some(&marker.topic),
        };
        let recorded = [&self.success, &self.task].into_iter().flatten();
        let recorded = recorded.filter_map(|recorded| match recorded {
            Recorded::Topic { topic, .. } => Some(topic),
            _ => None,
        });
        let columns = self.columns.iter().filter_map(|column| match &column.from {
            From::Topic(fields) => Some(&fields.topic),
            From::NextOf(_) => None,
        });
        let all = grid
            .into_iter()
            .chain(episodes)
            .chain(columns)
            .chain(recorded);
        for topic in all {
            if !topics.contains(&topic.as_str()) {
                topics.push(topic);
            }
        }
        topics
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_example_is_a_mapping() {
        let mapping = Mapping::parse(include_str!("../../../../examples/piper_pika.toml")).unwrap();
        let names: Vec<_> = mapping
            .columns
            .iter()
            .map(|column| column.name.as_str())
            .collect();
        let first = ["observation.joints", "observation.end_position"];
        assert_eq!(names[..2], first, "in the order of the file");
        assert_eq!(names.last(), Some(&"action.gripper"));
        assert_eq!(mapping.grid, Grid::Pace(Pace::MicroHertz(30_000_000)));
        assert_eq!(mapping.topics().len(), 7);
        assert_eq!(mapping.columns[0].reach, Some(50_000_000));
    }

    #[test]
    fn faults_are_named_with_their_line() {
        let joints = "[observation.q]\ntopic = \"/q\"\nfield = \"position\"\n";
        let grid = "[grid]\nrate_hz = 30\n";
        for (toml, line, part) in [
            ("clock = \"wall\"".to_owned(), 1, "unknown variant"),
            ("[grid".to_owned(), 1, ""),
            (joints.to_owned(), 1, "no [grid]"),
            (grid.to_owned(), 1, "no columns"),
            (format!("{grid}topic = \"/q\"\n{joints}"), 1, "exactly one"),
            (format!("{grid}{joints}max_age_s = -1\n"), 3, "max_age_s"),
            (format!("{grid}{joints}max_gap_s = 1\n"), 3, "max_gap_s"),
            (format!("{grid}{joints}colour = \"red\"\n"), 6, "colour"),
            (
                format!("{grid}{joints}[action]\ntopic = \"/c\"\n"),
                6,
                "`field` is missing",
            ),
            (
                format!("{grid}{joints}[action]\nnext_of = \"p\"\n"),
                6,
                "names no",
            ),
            (
                format!("{grid}{joints}on_miss = \"drop\"\n[action]\nnext_of = \"q\"\n"),
                1,
                "exclude",
            ),
            (
                format!("{grid}{joints}required = false\n[action]\nnext_of = \"q\"\n"),
                1,
                "never null",
            ),
            (
                format!(
                    "{grid}{joints}[action]\ntopic = \"/c\"\nfield = \"x\"\non_miss = \"null\"\n"
                ),
                6,
                "cannot be null",
            ),
            (
                format!("{grid}{joints}[episodes]\nby = \"marker\"\ntopic = \"/e\"\n"),
                6,
                "needs `start`",
            ),
            (
                format!("{grid}{joints}[episodes]\nby = \"moon\"\n"),
                7,
                "moon",
            ),
            (
                format!("{grid}{joints}[task]\nkey = \"task\"\n"),
                6,
                "[task] needs",
            ),
        ] {
            let error = Mapping::parse(&toml).unwrap_err();
            let DatasetError::Mapping {
                line: found,
                message,
            } = &error
            else {
                panic!("{toml}\n{error:?}");
            };
            assert!(message.contains(part), "{toml}\n{message}");
            assert_eq!(*found, line, "{toml}\n{message}");
        }
    }

    #[test]
    fn one_action_or_several_and_columns_of_their_own_name() {
        let grid = "[grid]\nstep_ns = 1000000\n";
        let several = format!(
            "{grid}[action.b]\ntopic = \"/b\"\nfield = \"x\"\n[action.a]\ntopic = \"/a\"\nfield = \"x\"\n"
        );
        let columns = Mapping::parse(&several).unwrap().columns;
        assert_eq!(columns[0].name, "action.b");
        assert_eq!(columns[1].name, "action.a");
        let one = format!(
            "{grid}[action]\ntopic = \"/b\"\nfield = \"x\"\n[observation.\"\"]\ntopic = \"/o\"\nfield = \"x\"\n"
        );
        let columns = Mapping::parse(&one).unwrap().columns;
        assert_eq!(columns[0].name, "observation");
        assert_eq!(columns[1].name, "action");
    }
}
