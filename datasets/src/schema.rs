//! The canonical table of steps.
//!
//! | column | type | note |
//! |---|---|---|
//! | [`EPISODE_INDEX`] | `Int64`, no nulls | rows of an episode are contiguous |
//! | [`STEP_INDEX`] | `Int64`, no nulls | from 0 inside an episode |
//! | [`T_NS`] | `Int64` | nanoseconds since the start of the episode, where the source has a clock |
//! | [`OBSERVATION`]`[.path]` | leaf columns | one per leaf of the observation space |
//! | [`ACTION`]`[.path]` | leaf columns | null on a final-observation row |
//! | [`REWARD`] | `Float64` or the source's type | null on a final-observation row |
//! | [`TERMINATED`], [`TRUNCATED`] | `Boolean` | null on a final-observation row |
//! | [`NEXT_OBSERVATION`] | as the observation | D4RL's own `next_observations`, where recorded |
//! | [`INFO`]`.path` | leaf columns | null where a row has none |
//!
//! A column the source does not record is absent. **The N+1 rule:** an episode of N steps has N+1 rows if
//! the observation after its last step is known, and then the extra row has a null action, reward and flags;
//! else it has N rows. So the observation after step i is always the next row of the same episode.
//!
//! Leaf columns keep the source's value type (no widening; big-endian becomes native). A scalar is a plain
//! column, a vector a `FixedSizeList`, a higher rank the extension type `arrow.fixed_shape_tensor` over a
//! `FixedSizeList`, text `Utf8`, an encoded picture `Binary` with [`IMAGE_CODEC`] and [`IMAGE_SHAPE`].
//! Names of nested keys join with `.` (a dot inside a key is `~1`, a tilde `~0`); tuple elements are `[0]`.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, FieldRef, Schema, SchemaRef};

/// Episode number of a row.
pub const EPISODE_INDEX: &str = "episode_index";
/// Step number inside the episode, from 0.
pub const STEP_INDEX: &str = "step_index";
/// Nanoseconds since the start of the episode.
pub const T_NS: &str = "t_ns";
/// Observation before the action, or prefix of its leaf columns.
pub const OBSERVATION: &str = "observation";
/// Action taken, or prefix of its leaf columns.
pub const ACTION: &str = "action";
/// Reward of the step.
pub const REWARD: &str = "reward";
/// The task ended at this step.
pub const TERMINATED: &str = "terminated";
/// The episode was cut at this step, by a time limit for instance.
pub const TRUNCATED: &str = "truncated";
/// D4RL's recorded observation after the step.
pub const NEXT_OBSERVATION: &str = "next_observation";
/// Prefix of everything else that is recorded per step.
pub const INFO: &str = "info";
/// The column that says whether a step reached the goal.
pub const INFO_SUCCESS: &str = "info.success";
/// Root of the columns with the scores of a step, as `ksim export` adds them.
pub const INFO_K_SIM: &str = "info.k_sim";
/// Root of the columns with the demonstration's step that a step was matched with.
pub const INFO_DEMONSTRATION: &str = "info.demonstration";

/// Schema metadata: version of this layout.
pub const VERSION_KEY: &str = "episodes.version";
/// The version written.
pub const VERSION: &str = "1";
/// Schema metadata: format of the source.
pub const SOURCE_FORMAT: &str = "source.format";
/// Schema metadata: version of the writer of the source.
pub const SOURCE_VERSION: &str = "source.version";
/// Schema metadata: the source's own metadata, verbatim JSON.
pub const SOURCE_METADATA: &str = "source.metadata";
/// Schema metadata: id of the dataset.
pub const SOURCE_ID: &str = "source.id";
/// Schema metadata: observation space as strict JSON.
pub const SPACE_OBSERVATION: &str = "space.observation";
/// Schema metadata: action space as strict JSON.
pub const SPACE_ACTION: &str = "space.action";
/// Schema metadata: environment specification as JSON.
pub const ENV_SPEC: &str = "env_spec";

/// Field metadata of an encoded picture: `jpeg` or `png`.
pub const IMAGE_CODEC: &str = "image.codec";
/// Field metadata of an encoded picture: its shape as a JSON list.
pub const IMAGE_SHAPE: &str = "image.shape";
/// Schema metadata: what the source records of its episodes (seed, attributes), as a JSON list of objects
/// with `episode_index`. Formats with a place of their own for it do not write this key.
pub const EPISODE_RECORDS: &str = "episodes.records";
/// Schema metadata: steps per second, where the source has a fixed rate.
pub const FPS: &str = "fps";

/// Schema metadata: which time of a recording orders its messages: `log`, `publish` or `header`.
pub const CLOCK: &str = "clock";
/// Schema metadata: the mapping by which a recording was aligned, verbatim.
pub const ALIGN: &str = "align";

/// Field metadata: names of the values of a row, as a JSON list in C order.
pub const NAMES: &str = "names";
/// Field metadata: unit of the values, such as `rad`, `m` or `m/s`.
pub const UNIT: &str = "unit";
/// Field metadata: what the values are where a plain difference would mislead: `angle` (wraps at 2π) or
/// `quaternion_xyzw` (q and −q are the same rotation).
pub const KIND: &str = "kind";
/// Field metadata: value type in the source, where the column has another one (flags).
pub const SOURCE_DTYPE: &str = "source.dtype";

/// Field metadata: shape of a row in the source as a JSON list, where the column has another one (`[1]` of
/// rewards and flags).
pub const SOURCE_SHAPE: &str = "source.shape";
/// Field metadata: key of the array in the source, where the column's name does not tell it.
pub const SOURCE_KEY: &str = "source.key";

const EXTENSION_NAME: &str = "ARROW:extension:name";
const EXTENSION_METADATA: &str = "ARROW:extension:metadata";
const TENSOR: &str = "arrow.fixed_shape_tensor";
/// Name of list elements, as Parquet writers agree.
const ELEMENT: &str = "element";

/// True for the integer and float types a state vector can hold.
pub fn is_number(data_type: &DataType) -> bool {
    data_type.is_integer() || data_type.is_floating()
}

/// The field of a leaf column whose rows have `shape`.
pub fn leaf_field(name: &str, value_type: DataType, shape: &[usize], nullable: bool) -> Field {
    match shape {
        [] => Field::new(name, value_type, nullable),
        _ => {
            // The number of values in a row was bounded by the reader before it came here.
            let size = i32::try_from(shape.iter().product::<usize>()).unwrap_or(i32::MAX);
            let field = Field::new(
                name,
                DataType::FixedSizeList(element(value_type), size),
                nullable,
            );
            if shape.len() == 1 {
                field
            } else {
                field.with_metadata(tensor_metadata(shape))
            }
        }
    }
}

/// The child field of list columns.
pub(crate) fn element(value_type: DataType) -> FieldRef {
    Arc::new(Field::new(ELEMENT, value_type, true))
}

/// The field of an encoded picture.
pub fn image_field(name: &str, codec: &str, shape: &[usize]) -> Field {
    Field::new(name, DataType::Binary, true).with_metadata(HashMap::from([
        (IMAGE_CODEC.to_owned(), codec.to_owned()),
        (IMAGE_SHAPE.to_owned(), shape_json(shape)),
    ]))
}

/// Value type and row shape of a leaf column; `None` for other types.
pub fn row_shape(field: &Field) -> Option<(DataType, Vec<usize>)> {
    match field.data_type() {
        DataType::FixedSizeList(child, size) => {
            let width = usize::try_from(*size).ok()?;
            let shape = tensor_shape(field).filter(|shape| {
                shape.iter().try_fold(1usize, |n, d| n.checked_mul(*d)) == Some(width)
            });
            is_number(child.data_type()).then(|| {
                (
                    child.data_type().clone(),
                    shape.unwrap_or_else(|| vec![width]),
                )
            })
        }
        DataType::Binary => Some((
            DataType::Binary,
            parse_shape(field.metadata().get(IMAGE_SHAPE)?)?,
        )),
        DataType::Utf8 => Some((DataType::Utf8, Vec::new())),
        other if is_number(other) || *other == DataType::Boolean => {
            Some((other.clone(), Vec::new()))
        }
        _ => None,
    }
}

/// True if `column` is `root` or one of its leaves (`root.x`, `root[0]`).
pub fn belongs_to(column: &str, root: &str) -> bool {
    column
        .strip_prefix(root)
        .is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']))
}

/// One step of a path of nested keys, escaped.
pub fn escape_key(key: &str) -> String {
    key.replace('~', "~0").replace('.', "~1")
}

/// The key behind [`escape_key`].
pub fn unescape_key(key: &str) -> String {
    key.replace("~1", ".").replace("~0", "~")
}

/// `parent.key`, with the key escaped.
pub fn join_key(parent: &str, key: &str) -> String {
    format!("{parent}.{}", escape_key(key))
}

/// The schema of a scan of some columns.
///
/// # Errors
/// [`crate::DatasetError::MissingColumn`] if a name is not in the schema.
pub fn project(
    schema: &SchemaRef,
    columns: Option<&[String]>,
) -> crate::Result<(SchemaRef, Vec<usize>)> {
    let Some(columns) = columns else {
        return Ok((Arc::clone(schema), (0..schema.fields().len()).collect()));
    };
    for name in columns {
        if schema.index_of(name).is_err() {
            return Err(crate::DatasetError::MissingColumn {
                role: "dataset",
                name: format!("\"{name}\""),
                found: column_names(schema),
            });
        }
    }
    // Schema order, whatever the order asked for, so that a scan never depends on the caller's spelling.
    let indices: Vec<usize> = (0..schema.fields().len())
        .filter(|&i| columns.contains(schema.field(i).name()))
        .collect();
    let fields: Vec<FieldRef> = indices
        .iter()
        .map(|&i| Arc::clone(&schema.fields()[i]))
        .collect();
    Ok((
        Arc::new(Schema::new_with_metadata(fields, schema.metadata().clone())),
        indices,
    ))
}

/// The names of all columns.
pub(crate) fn all_names(schema: &Schema) -> Vec<String> {
    schema.fields().iter().map(|f| f.name().clone()).collect()
}

/// The names of all columns, for messages.
pub(crate) fn column_names(schema: &Schema) -> String {
    all_names(schema).join(", ")
}

fn tensor_metadata(shape: &[usize]) -> HashMap<String, String> {
    HashMap::from([
        (EXTENSION_NAME.to_owned(), TENSOR.to_owned()),
        (
            EXTENSION_METADATA.to_owned(),
            format!("{{\"shape\":{}}}", shape_json(shape)),
        ),
    ])
}

fn tensor_shape(field: &Field) -> Option<Vec<usize>> {
    if field.metadata().get(EXTENSION_NAME)? != TENSOR {
        return None;
    }
    let value: serde_json::Value =
        serde_json::from_str(field.metadata().get(EXTENSION_METADATA)?).ok()?;
    serde_json::from_value(value.get("shape")?.clone()).ok()
}

fn shape_json(shape: &[usize]) -> String {
    let numbers: Vec<String> = shape.iter().map(ToString::to_string).collect();
    format!("[{}]", numbers.join(","))
}

fn parse_shape(text: &str) -> Option<Vec<usize>> {
    serde_json::from_str(text).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_survive_the_field() {
        for shape in [vec![], vec![3], vec![2, 4], vec![2, 3, 4]] {
            let field = leaf_field("observation", DataType::Float32, &shape, false);
            assert_eq!(row_shape(&field), Some((DataType::Float32, shape)));
        }
        let image = image_field("observation.image", "jpeg", &[32, 40, 3]);
        assert_eq!(row_shape(&image), Some((DataType::Binary, vec![32, 40, 3])));
    }

    #[test]
    fn keys_with_dots_do_not_look_like_paths() {
        assert_eq!(join_key("info", "a.b~c"), "info.a~1b~0c");
    }

    #[test]
    fn a_prefix_is_a_whole_key() {
        assert!(belongs_to("observation", OBSERVATION));
        assert!(belongs_to("observation.x", OBSERVATION));
        assert!(belongs_to("observation[0]", OBSERVATION));
        assert!(!belongs_to("observations", OBSERVATION));
    }

    #[test]
    fn a_projection_keeps_schema_order_and_names_what_is_missing() {
        let schema = Arc::new(Schema::new(vec![
            Field::new("a", DataType::Int64, false),
            Field::new("b", DataType::Int64, false),
        ]));
        let columns = ["b".to_owned(), "a".to_owned()];
        assert_eq!(project(&schema, Some(&columns)).unwrap().1, [0, 1]);
        let error = project(&schema, Some(&["c".to_owned()])).unwrap_err();
        assert!(error.to_string().contains("columns are a, b"), "{error}");
    }
}
