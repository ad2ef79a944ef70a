//! What checks must know about a dataset before its rows.

use arrow::datatypes::{DataType, Field, SchemaRef};
use serde_json::Value;

use crate::format::Format;
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource};
use crate::spec::{LeafKind, LeafSpec};

/// What a column is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    Index,
    Time,
    Observation,
    Action,
    Reward,
    Flag,
    NextObservation,
    Info,
}

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Float,
    /// Integers and flags.
    Number,
    /// Text and pictures.
    Opaque,
}

/// A column of the scan.
#[derive(Debug, Clone)]
pub(super) struct Column {
    pub(super) name: String,
    pub(super) role: Role,
    pub(super) kind: Kind,
    /// Values in a row.
    pub(super) width: usize,
    /// Whether plain differences mean nothing (angles, quaternions).
    pub(super) wraps: bool,
    /// Whether a value says that the row is a step.
    pub(super) marks_steps: bool,
}

impl Column {
    fn new(field: &Field) -> Self {
        let leaf = LeafSpec::of_field(field);
        let is_picture = leaf
            .as_ref()
            .is_some_and(|leaf| leaf.kind == LeafKind::Image);
        let value_type = leaf.as_ref().map(|leaf| leaf.data_type.clone());
        let kind = match value_type {
            _ if is_picture => Kind::Opaque,
            Some(value_type) if value_type.is_floating() => Kind::Float,
            Some(value_type) if value_type.is_integer() || value_type == DataType::Boolean => {
                Kind::Number
            }
            _ => Kind::Opaque,
        };
        let role = role(field.name());
        Self {
            name: field.name().clone(),
            kind,
            width: leaf.map_or(1, |leaf| leaf.width()),
            wraps: field.metadata().contains_key(schema::KIND),
            marks_steps: matches!(role, Role::Action | Role::Reward | Role::Flag),
            role,
        }
    }

    /// Name of one value: the column's own where there is only one.
    pub(super) fn value_name(&self, index: usize) -> String {
        match self.width {
            1 => self.name.clone(),
            _ => format!("{}[{index}]", self.name),
        }
    }
}

fn role(name: &str) -> Role {
    match name {
        schema::EPISODE_INDEX | schema::STEP_INDEX => Role::Index,
        schema::T_NS => Role::Time,
        schema::REWARD => Role::Reward,
        schema::TERMINATED | schema::TRUNCATED => Role::Flag,
        _ if schema::belongs_to(name, schema::OBSERVATION) => Role::Observation,
        _ if schema::belongs_to(name, schema::ACTION) => Role::Action,
        _ if schema::belongs_to(name, schema::NEXT_OBSERVATION) => Role::NextObservation,
        _ => Role::Info,
    }
}

/// Data sets of a kind that is known to have faults of its own, or rules that no file records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Family {
    /// D4RL's antmaze, with its version where the name tells: 0 also stands for 1.
    Antmaze(Option<u8>),
    Maze2d,
    Kitchen,
    Adroit,
    Locomotion,
    Robomimic,
    Other,
}

impl Family {
    /// By the words of the id and of the file's name.
    fn of(info: &DatasetInfo, is_d4rl: bool) -> Self {
        if info.format == Format::Robomimic {
            return Self::Robomimic;
        }
        let stem = info.path.file_stem().unwrap_or_default().to_string_lossy();
        let name = format!("{} {stem}", info.id).to_ascii_lowercase();
        let words: Vec<&str> = name.split(|c: char| !c.is_ascii_alphanumeric()).collect();
        let has = |word: &str| words.contains(&word);
        let is_antmaze = has("antmaze") || words.windows(2).any(|pair| pair == ["ant", "maze"]);
        if is_antmaze {
            // Minari's versions are numbers of its own.
            let version = match () {
                () if !is_d4rl => None,
                () if has("v2") || has("fixed") => Some(2),
                () if has("v0") || has("v1") || has("sparse") => Some(0),
                () => None,
            };
            return Self::Antmaze(version);
        }
        if !is_d4rl {
            return Self::Other;
        }
        match () {
            () if has("maze2d") => Self::Maze2d,
            () if has("kitchen") => Self::Kitchen,
            () if ["adroit", "pen", "hammer", "door", "relocate"]
                .iter()
                .any(|w| has(w)) =>
            {
                Self::Adroit
            }
            () if ["locomotion", "hopper", "halfcheetah", "walker2d", "ant"]
                .iter()
                .any(|w| has(w)) =>
            {
                Self::Locomotion
            }
            () => Self::Other,
        }
    }
}

/// Everything known beforehand.
pub(super) struct Facts<'a> {
    pub(super) info: &'a DatasetInfo,
    pub(super) schema: SchemaRef,
    pub(super) columns: Vec<Column>,
    pub(super) family: Family,
    /// Step limit of the environment, and who says so.
    pub(super) step_limit: Option<(u64, &'static str)>,
    /// Steps per second, where recorded.
    pub(super) fps: Option<f64>,
}

impl<'a> Facts<'a> {
    pub(super) fn new(source: &'a dyn DatasetSource) -> Self {
        let (info, schema) = (source.info(), source.schema());
        let columns = schema
            .fields()
            .iter()
            .map(|field| Column::new(field))
            .collect();
        let original = schema.metadata().get(schema::SOURCE_FORMAT);
        let is_d4rl = info.format == Format::D4rlHdf5
            || original.is_some_and(|format| format == Format::D4rlHdf5.name());
        let family = Family::of(info, is_d4rl);
        let fps = schema.metadata().get(schema::FPS);
        Self {
            info,
            columns,
            family,
            step_limit: step_limit(info, family),
            fps: fps
                .and_then(|fps| fps.parse().ok())
                .filter(|fps: &f64| fps.is_finite() && *fps > 0.0),
            schema,
        }
    }

    /// Place and description of the columns of a role.
    pub(super) fn with_role(&self, role: Role) -> impl Iterator<Item = (usize, &Column)> {
        let columns = self.columns.iter().enumerate();
        columns.filter(move |(_, column)| column.role == role)
    }

    /// Place of a column.
    pub(super) fn find(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|column| column.name == name)
    }

    /// The column that starts with x and y: `achieved_goal`, or the only observation, of two values or more.
    pub(super) fn position(&self) -> Option<usize> {
        let achieved = schema::join_key(schema::OBSERVATION, "achieved_goal");
        self.find(&achieved)
            .or_else(|| self.find(schema::OBSERVATION))
            .filter(|&place| {
                self.columns[place].width >= 2 && self.columns[place].kind == Kind::Float
            })
    }

    /// Whether the words of a name occur in the id, however they are joined.
    pub(super) fn is_named(&self, words: &str) -> bool {
        self.info
            .id
            .to_ascii_lowercase()
            .replace(['_', ' '], "-")
            .contains(words)
    }
}

fn step_limit(info: &DatasetInfo, family: Family) -> Option<(u64, &'static str)> {
    let recorded = info.env_spec.as_ref().and_then(|spec| {
        spec.get("max_episode_steps")
            .and_then(Value::as_u64)
            .filter(|limit| *limit > 0)
    });
    if let Some(limit) = recorded {
        return Some((limit, "the recorded environment specification"));
    }
    // Limits of the registered D4RL environments. Larger ones of a family cover the smaller.
    match family {
        Family::Locomotion | Family::Antmaze(Some(_)) => Some((1000, "D4RL's environment")),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    #[test]
    fn families_are_told_by_words_not_by_letters() {
        let of = |name: &str, is_d4rl| {
            let info = DatasetInfo::new(name.into(), Format::D4rlHdf5, PathBuf::new());
            Family::of(&info, is_d4rl)
        };
        let fixed = "Ant_maze_u-maze_noisy_multistart_False_multigoal_False_sparse_fixed";
        assert_eq!(of(fixed, true), Family::Antmaze(Some(2)));
        assert_eq!(
            of("Ant_maze_u-maze_noisy_sparse", true),
            Family::Antmaze(Some(0))
        );
        assert_eq!(
            of("D4RL/antmaze/large-play-v1", false),
            Family::Antmaze(None)
        );
        assert_eq!(of("maze2d-umaze-sparse-v1", true), Family::Maze2d);
        assert_eq!(of("ant_medium-v2", true), Family::Locomotion);
        assert_eq!(of("pen-human-v1", true), Family::Adroit);
        assert_eq!(of("open-drawer", true), Family::Other);
        assert_eq!(of("mujoco/hopper/medium-v0", false), Family::Other);
    }
}
