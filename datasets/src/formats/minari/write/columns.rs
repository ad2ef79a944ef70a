//! Which column of a table goes where in an episode.

use arrow::datatypes::{DataType, Field, Schema};

use super::tree::{Node, keys};
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::sink::{Loss, LossEffect};

/// Shortest side of a picture that Minari takes for one.
const MIN_PICTURE_SIDE: usize = 32;

/// The columns of a table by their place in an episode.
pub(in super::super) struct Columns {
    pub(in super::super) observation: Group,
    pub(in super::super) action: Group,
    /// Without a tree if there are none.
    pub(in super::super) infos: Group,
    /// Places of columns in the table.
    pub(super) reward: Option<usize>,
    pub(super) terminated: Option<usize>,
    pub(super) truncated: Option<usize>,
    /// The column with the next observation for each observation leaf, if all have one.
    pub(super) next_observation: Option<Vec<usize>>,
}

/// The leaves of observations, actions or infos.
#[derive(Debug, Clone, Default)]
pub(in super::super) struct Group {
    pub(in super::super) tree: Option<Node>,
    pub(in super::super) leaves: Vec<Leaf>,
}

/// A column of a table.
#[derive(Debug, Clone)]
pub(in super::super) struct Leaf {
    pub(in super::super) column: String,
    /// Place in the table.
    pub(super) index: usize,
    /// Type of the column.
    #[cfg_attr(
        not(feature = "hdf5"),
        allow(dead_code, reason = "used by the HDF5 writer")
    )]
    pub(super) data_type: DataType,
    /// Type of one value.
    pub(in super::super) value_type: DataType,
    /// Shape of one row.
    pub(in super::super) shape: Vec<usize>,
}

impl Columns {
    /// Sorts the columns; those without a place are losses.
    ///
    /// # Errors
    /// No observation or no action is left.
    pub(super) fn new(schema: &Schema, losses: &mut Vec<Loss>) -> Result<Self> {
        let observation = group(schema, schema::OBSERVATION, losses)?;
        let action = group(schema, schema::ACTION, losses)?;
        for (role, group) in [("observation", &observation), ("action", &action)] {
            if group.leaves.is_empty() {
                return Err(DatasetError::MissingColumn {
                    role,
                    name: "that Minari can hold".to_owned(),
                    found: schema::column_names(schema),
                });
            }
        }
        let next_observation = observation.leaves.iter().map(|leaf| {
            let path = leaf.column.strip_prefix(schema::OBSERVATION)?;
            let index = schema
                .index_of(&format!("{}{path}", schema::NEXT_OBSERVATION))
                .ok()?;
            let same = schema.field(index).data_type() == schema.field(leaf.index).data_type();
            same.then_some(index)
        });
        let columns = Self {
            next_observation: next_observation.collect(),
            infos: info_group(schema, losses)?,
            observation,
            action,
            reward: number(schema, schema::REWARD, losses),
            terminated: flag(schema, schema::TERMINATED, losses),
            truncated: flag(schema, schema::TRUNCATED, losses),
        };
        columns.note_inventions(losses);
        note_others(schema, losses);
        Ok(columns)
    }

    fn note_inventions(&self, losses: &mut Vec<Loss>) {
        let mut invented =
            |item, detail| losses.push(Loss::new(item, LossEffect::Invented, detail));
        if self.reward.is_none() {
            invented(schema::REWARD, "Minari demands rewards: all are 0");
        }
        match (self.terminated, self.truncated) {
            (Some(_), Some(_)) => {}
            (None, Some(_)) => invented(
                schema::TERMINATED,
                "Minari demands terminations: none of the steps terminates",
            ),
            (Some(_), None) => invented(
                schema::TRUNCATED,
                "Minari demands truncations: the last step of an episode that does not terminate is truncated",
            ),
            (None, None) => invented(
                "terminated, truncated",
                "Minari demands flags: the last step of every episode is truncated",
            ),
        }
    }
}

/// The leaves under a root that can be stored.
fn group(schema: &Schema, root: &str, losses: &mut Vec<Loss>) -> Result<Group> {
    let mut group = Group::default();
    for (index, field) in schema.fields().iter().enumerate() {
        if !schema::belongs_to(field.name(), root) {
            continue;
        }
        match leaf(field, index, root) {
            Ok(leaf) => group.leaves.push(leaf),
            Err(reason) => losses.push(Loss::new(field.name(), LossEffect::Dropped, reason)),
        }
    }
    let keyed: Vec<_> = group
        .leaves
        .iter()
        .enumerate()
        .map(|(place, leaf)| (keys(&leaf.column, root), place))
        .collect();
    group.tree = Node::build(&keyed)?;
    Ok(group)
}

/// Infos are always a group: a single column `info` becomes its member `info`.
fn info_group(schema: &Schema, losses: &mut Vec<Loss>) -> Result<Group> {
    let mut group = group(schema, schema::INFO, losses)?;
    if let Some(leaf @ Node::Leaf(_)) = group.tree.take_if(|tree| matches!(tree, Node::Leaf(_))) {
        losses.push(Loss::new(
            schema::INFO,
            LossEffect::Changed,
            "infos are groups in Minari: the column is `info` inside of it",
        ));
        group.tree = Some(Node::Dict(vec![(schema::INFO.to_owned(), leaf)]));
    }
    Ok(group)
}

/// The leaf a column is, or why it cannot be one.
fn leaf(field: &Field, index: usize, root: &str) -> Result<Leaf, &'static str> {
    let (value_type, shape) = value_shape(field).ok_or("Minari has no such type")?;
    if value_type == DataType::Binary {
        if root == schema::INFO {
            return Err("Minari has no pictures in infos");
        }
        if field
            .metadata()
            .get(schema::IMAGE_CODEC)
            .map(String::as_str)
            != Some("jpeg")
        {
            return Err("Minari's pictures are JPEG, and nothing is encoded anew");
        }
        let sides = shape.get(..2);
        let is_picture = matches!(shape.len(), 2 | 3)
            && sides.is_some_and(|sides| sides.iter().all(|&n| n >= MIN_PICTURE_SIDE));
        if !is_picture {
            return Err("Minari takes only arrays of 32 × 32 and more for pictures");
        }
    }
    let bad_key = |key: &super::tree::Key| match key {
        super::tree::Key::Name(name) => {
            name.is_empty() || name == "." || name.contains(['/', '\0'])
        }
        super::tree::Key::Index(_) => false,
    };
    if keys(field.name(), root).iter().any(bad_key) {
        return Err("a key that is empty or holds a slash cannot be a name in Minari");
    }
    Ok(Leaf {
        column: field.name().clone(),
        index,
        data_type: field.data_type().clone(),
        value_type,
        shape,
    })
}

/// Value type and row shape of what can be stored.
fn value_shape(field: &Field) -> Option<(DataType, Vec<usize>)> {
    if let DataType::FixedSizeList(child, size) = field.data_type()
        && *child.data_type() == DataType::Boolean
    {
        // Lists of flags are no leaves of a space, but infos may be.
        let child = child.as_ref().clone().with_data_type(DataType::Int8);
        let list = DataType::FixedSizeList(child.into(), *size);
        let (_, shape) = schema::row_shape(&field.clone().with_data_type(list))?;
        return Some((DataType::Boolean, shape));
    }
    let (value_type, shape) = schema::row_shape(field)?;
    (shape.iter().product::<usize>() > 0).then_some((value_type, shape))
}

fn number(schema: &Schema, name: &str, losses: &mut Vec<Loss>) -> Option<usize> {
    let (index, field) = schema.column_with_name(name)?;
    let data_type = field.data_type();
    if !schema::is_number(data_type) {
        losses.push(Loss::new(name, LossEffect::Dropped, "it is no number"));
        return None;
    }
    if *data_type != DataType::Float64 {
        let exact = match data_type {
            DataType::Int64 | DataType::UInt64 => "rounded beyond 2^53",
            _ => "every value as it was",
        };
        let detail = format!("{data_type} became Float64, {exact}");
        losses.push(Loss::new(name, LossEffect::Changed, detail));
    }
    Some(index)
}

fn flag(schema: &Schema, name: &str, losses: &mut Vec<Loss>) -> Option<usize> {
    let (index, field) = schema.column_with_name(name)?;
    if *field.data_type() != DataType::Boolean {
        losses.push(Loss::new(name, LossEffect::Dropped, "it is no flag"));
        return None;
    }
    Some(index)
}

/// Columns that no part of an episode takes.
fn note_others(schema: &Schema, losses: &mut Vec<Loss>) {
    const SCALARS: [&str; 5] = [
        schema::EPISODE_INDEX,
        schema::STEP_INDEX,
        schema::REWARD,
        schema::TERMINATED,
        schema::TRUNCATED,
    ];
    const ROOTS: [&str; 3] = [schema::OBSERVATION, schema::ACTION, schema::INFO];
    for field in schema.fields() {
        let name = field.name();
        if SCALARS.contains(&name.as_str())
            || ROOTS.iter().any(|root| schema::belongs_to(name, root))
        {
            continue;
        }
        let detail = match schema::belongs_to(name, schema::NEXT_OBSERVATION) {
            true => "Minari's next observation is the next row",
            false => "Minari has no place for it",
        };
        losses.push(Loss::new(name, LossEffect::Dropped, detail));
    }
}
