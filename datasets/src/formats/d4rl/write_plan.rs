//! Which column of a table becomes which array of a D4RL file.

use arrow::datatypes::{DataType, Field, Schema};
use serde_json::{Value, json};

use super::flat::{INFOS, NEXT_OBSERVATIONS};
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::sink::{Loss, LossEffect, SinkInput};
use crate::spec::{LeafKind, LeafSpec, arrow_type};

/// The arrays of a file and the columns they come from.
pub(super) struct Plan {
    pub(super) observation: Concat,
    pub(super) action: Concat,
    pub(super) next: Next,
    /// Place and shape (`[]` or `[1]`), if there are rewards.
    pub(super) reward: Option<Scalar>,
    pub(super) terminated: Option<Scalar>,
    pub(super) truncated: Option<Scalar>,
    pub(super) infos: Vec<Info>,
}

/// Leaves that are written as one array.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Concat {
    pub(super) leaves: Vec<Leaf>,
    /// Type of all values.
    pub(super) value_type: DataType,
    /// Shape of a row: that of the only leaf, else the sum of the widths.
    pub(super) row_shape: Vec<usize>,
}

/// A leaf of an observation or action.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Leaf {
    pub(super) column: String,
    /// Place in the table.
    pub(super) index: usize,
    pub(super) value_type: DataType,
    pub(super) shape: Vec<usize>,
}

/// Where `next_observations` come from.
#[derive(Debug, PartialEq)]
pub(super) enum Next {
    /// Columns that record them.
    Recorded(Concat),
    /// The rows after the steps.
    Rows,
    /// They are not written.
    Absent,
}

/// A column with one value a step.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Scalar {
    /// Place in the table.
    pub(super) index: usize,
    /// Type in the file.
    pub(super) value_type: DataType,
    /// `[]`, or `[1]` as the source had it.
    pub(super) row_shape: Vec<usize>,
}

/// A column that is written as it is.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Info {
    pub(super) column: String,
    pub(super) index: usize,
    pub(super) key: String,
    pub(super) value_type: DataType,
    pub(super) row_shape: Vec<usize>,
}

impl Plan {
    /// Sorts the columns; what has no place is a loss.
    ///
    /// # Errors
    /// No numeric observation or action.
    pub(super) fn new(input: &SinkInput<'_>, losses: &mut Vec<Loss>) -> Result<Self> {
        let schema = input.schema;
        let observation = concat(schema, schema::OBSERVATION, &input.info.observation, losses)?;
        let action = concat(schema, schema::ACTION, &input.info.action, losses)?;
        let next = next(input, &observation);
        note_others(schema, &next, losses);
        Ok(Self {
            next,
            observation,
            action,
            reward: scalar(schema, schema::REWARD, losses),
            terminated: scalar(schema, schema::TERMINATED, losses),
            truncated: scalar(schema, schema::TRUNCATED, losses),
            infos: infos(schema, losses),
        })
    }
}

impl Concat {
    /// Where each leaf is in a row, for those who want to take it apart again.
    pub(super) fn layout(&self) -> Option<Value> {
        if self.leaves.len() < 2 {
            return None;
        }
        let mut offset = 0;
        let mut layout = Vec::new();
        for leaf in &self.leaves {
            layout.push(json!({"column": leaf.column, "offset": offset, "shape": leaf.shape}));
            offset += leaf.width();
        }
        Some(Value::Array(layout))
    }
}

impl Leaf {
    pub(super) fn width(&self) -> usize {
        self.shape.iter().product()
    }
}

/// The numeric leaves under a root, in the order of the state vector.
fn concat(
    schema: &Schema,
    root: &str,
    specs: &[LeafSpec],
    losses: &mut Vec<Loss>,
) -> Result<Concat> {
    let mut leaves = Vec::new();
    for (index, field) in schema.fields().iter().enumerate() {
        if !schema::belongs_to(field.name(), root) {
            continue;
        }
        match numeric(field, specs) {
            Some((value_type, shape)) => leaves.push(Leaf {
                column: field.name().clone(),
                index,
                value_type,
                shape,
            }),
            None => {
                let detail = "D4RL holds numbers only: no text, no flags, no pictures";
                losses.push(Loss::new(field.name(), LossEffect::Dropped, detail));
            }
        }
    }
    let Some(value_type) = promoted(&leaves) else {
        return Err(DatasetError::MissingColumn {
            role: "numeric",
            name: format!("\"{root}\""),
            found: schema::column_names(schema),
        });
    };
    let concat = Concat {
        row_shape: match leaves.as_slice() {
            [only] => only.shape.clone(),
            several => vec![several.iter().map(Leaf::width).sum()],
        },
        leaves,
        value_type,
    };
    concat.note(root, losses);
    Ok(concat)
}

impl Concat {
    fn note(&self, root: &str, losses: &mut Vec<Loss>) {
        if self.leaves.len() > 1 {
            let names: Vec<String> = self
                .leaves
                .iter()
                .map(|leaf| format!("{} ({})", leaf.column, leaf.width()))
                .collect();
            let detail = format!(
                "one array of the leaves in this order: {}",
                names.join(", ")
            );
            losses.push(Loss::new(root, LossEffect::Changed, detail));
        }
        for leaf in &self.leaves {
            if leaf.value_type != self.value_type {
                let detail = format!(
                    "{} became {}, the type of the whole array",
                    leaf.value_type, self.value_type
                );
                losses.push(Loss::new(&leaf.column, LossEffect::Changed, detail));
            }
        }
    }
}

/// Value type and shape of a leaf that can be part of a state vector.
fn numeric(field: &Field, specs: &[LeafSpec]) -> Option<(DataType, Vec<usize>)> {
    let guessed = LeafSpec::of_field(field)?;
    let known = specs.iter().find(|leaf| leaf.column == *field.name());
    let kind = known.map_or(guessed.kind, |leaf| leaf.kind);
    let is_numeric = kind != LeafKind::Image && schema::is_number(&guessed.data_type);
    (is_numeric && guessed.width() > 0).then_some((guessed.data_type, guessed.shape))
}

/// The narrowest type that holds the values of all leaves; 64-bit integers beside floats are checked when
/// they are converted.
fn promoted(leaves: &[Leaf]) -> Option<DataType> {
    let (first, rest) = leaves.split_first()?;
    if rest.iter().all(|leaf| leaf.value_type == first.value_type) {
        return Some(first.value_type.clone());
    }
    let mut types = leaves.iter().map(|leaf| &leaf.value_type);
    let is_wide = |t: &DataType| {
        use DataType::{Float64, Int32, Int64, UInt32, UInt64};
        matches!(t, Float64 | Int32 | Int64 | UInt32 | UInt64)
    };
    let all_integers = types.clone().all(DataType::is_integer);
    Some(match all_integers {
        true if types.all(|t| *t != DataType::UInt64) => DataType::Int64,
        true => DataType::Float64,
        false if types.any(is_wide) => DataType::Float64,
        false => DataType::Float32,
    })
}

/// Where next observations come from.
fn next(input: &SinkInput<'_>, observation: &Concat) -> Next {
    let recorded = observation.leaves.iter().map(|leaf| {
        let path = leaf.column.strip_prefix(schema::OBSERVATION)?;
        let column = format!("{}{path}", schema::NEXT_OBSERVATION);
        let (index, field) = input.schema.column_with_name(&column)?;
        let (value_type, shape) = schema::row_shape(field)?;
        let same = value_type == leaf.value_type && shape == leaf.shape;
        same.then_some(Leaf {
            column,
            index,
            value_type,
            shape,
        })
    });
    match recorded.collect::<Option<Vec<Leaf>>>() {
        Some(leaves) => Next::Recorded(Concat {
            leaves,
            ..observation.clone()
        }),
        None if input.episodes.iter().any(|episode| episode.has_final_obs) => Next::Rows,
        None => Next::Absent,
    }
}

/// A column with one value a row.
fn scalar(schema: &Schema, name: &str, losses: &mut Vec<Loss>) -> Option<Scalar> {
    let (index, field) = schema.column_with_name(name)?;
    let is_flag = name != schema::REWARD;
    let fits = match field.data_type() {
        DataType::Boolean => is_flag,
        other => !is_flag && schema::is_number(other),
    };
    if !fits {
        let detail = if is_flag {
            "it is no flag"
        } else {
            "it is no number"
        };
        losses.push(Loss::new(name, LossEffect::Dropped, detail));
        return None;
    }
    let noted = |key: &str| field.metadata().get(key).map(String::as_str);
    // Flags get back the type that the source had them in.
    let source = noted(schema::SOURCE_DTYPE)
        .filter(|_| is_flag)
        .and_then(arrow_type);
    Some(Scalar {
        index,
        value_type: source.unwrap_or_else(|| field.data_type().clone()),
        row_shape: match noted(schema::SOURCE_SHAPE) {
            Some("[1]") => vec![1],
            _ => Vec::new(),
        },
    })
}

/// The info columns, by the key they get.
fn infos(schema: &Schema, losses: &mut Vec<Loss>) -> Vec<Info> {
    let mut infos: Vec<Info> = Vec::new();
    for (index, field) in schema.fields().iter().enumerate() {
        if !schema::belongs_to(field.name(), schema::INFO) {
            continue;
        }
        let mut lost = |effect, detail| losses.push(Loss::new(field.name(), effect, detail));
        let Some((value_type, row_shape)) = stored(field) else {
            lost(LossEffect::Dropped, "D4RL has no such type");
            continue;
        };
        let key = match field.metadata().get(schema::SOURCE_KEY) {
            Some(key) => key.clone(),
            None => key(field.name()),
        };
        let inside = |outer: &str, inner: &str| {
            inner
                .strip_prefix(outer)
                .is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
        };
        let collides = |other: &Info| inside(&other.key, &key) || inside(&key, &other.key);
        let is_name = |part: &str| !part.is_empty() && part != "." && !part.contains('\0');
        if infos.iter().any(collides) || !key.split('/').all(is_name) {
            lost(
                LossEffect::Dropped,
                "its key cannot be a name in the file beside the others",
            );
            continue;
        }
        if field.name().contains('[') {
            lost(
                LossEffect::Changed,
                "elements of tuples become keys named by their number",
            );
        }
        infos.push(Info {
            column: field.name().clone(),
            index,
            key,
            value_type,
            row_shape,
        });
    }
    infos
}

/// `infos/a/b` for `info.a.b`.
fn key(column: &str) -> String {
    let path = column.strip_prefix(schema::INFO).unwrap_or(column);
    let parts = path
        .split(['.', '['])
        .map(|part| part.trim_end_matches(']'));
    let parts = parts
        .filter(|part| !part.is_empty())
        .map(schema::unescape_key);
    parts.fold(INFOS.to_owned(), |key, part| format!("{key}/{part}"))
}

/// Value type and row shape of an info that can be stored.
fn stored(field: &Field) -> Option<(DataType, Vec<usize>)> {
    let (value_type, shape) = schema::row_shape(field)?;
    let fits = value_type != DataType::Binary && shape.iter().product::<usize>() > 0;
    fits.then_some((value_type, shape))
}

/// Columns that no array takes.
fn note_others(schema: &Schema, next: &Next, losses: &mut Vec<Loss>) {
    const TAKEN: [&str; 5] = [
        schema::EPISODE_INDEX,
        schema::STEP_INDEX,
        schema::REWARD,
        schema::TERMINATED,
        schema::TRUNCATED,
    ];
    const ROOTS: [&str; 3] = [schema::OBSERVATION, schema::ACTION, schema::INFO];
    for field in schema.fields() {
        let name = field.name();
        let is_root = |root: &&str| schema::belongs_to(name, root);
        if TAKEN.contains(&name.as_str()) || ROOTS.iter().any(is_root) {
            continue;
        }
        let is_next = match next {
            Next::Recorded(concat) => concat.leaves.iter().any(|leaf| leaf.column == *name),
            _ => false,
        };
        if !is_next {
            let detail = match schema::belongs_to(name, schema::NEXT_OBSERVATION) {
                true => format!("it does not go with the observations into {NEXT_OBSERVATIONS}"),
                false => "D4RL has no place for it".to_owned(),
            };
            losses.push(Loss::new(name, LossEffect::Dropped, detail));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leaves_of_several_types_get_one_that_holds_them() {
        use DataType::{Float16, Float32, Float64, Int8, Int32, Int64, UInt64};
        let type_of = |types: &[DataType]| {
            let leaf = |value_type: &DataType| Leaf {
                column: String::new(),
                index: 0,
                value_type: value_type.clone(),
                shape: vec![],
            };
            promoted(&types.iter().map(leaf).collect::<Vec<_>>()).unwrap()
        };
        assert_eq!(type_of(&[Float16, Float16]), Float16);
        assert_eq!(type_of(&[Float32, Float64]), Float64);
        assert_eq!(type_of(&[Float16, Int8]), Float32);
        assert_eq!(type_of(&[Float32, Int32]), Float64);
        assert_eq!(type_of(&[Int8, Int64]), Int64);
        assert_eq!(type_of(&[UInt64, Int8]), Float64);
    }

    #[test]
    fn columns_get_their_keys_back() {
        assert_eq!(key("info"), "infos");
        assert_eq!(key("info.qpos"), "infos/qpos");
        assert_eq!(key("info.a~1b.c[0]"), "infos/a.b/c/0");
    }
}
