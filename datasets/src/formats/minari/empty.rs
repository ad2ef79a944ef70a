//! The columns of a dataset without episodes, as its spaces declare them.

use std::sync::Arc;

use arrow::datatypes::{DataType, Field, FieldRef};
use serde_json::Value;

use super::metadata::Metadata;
use super::space::{Space, key_order};
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::spec::{LeafKind, LeafSpec};

/// The leaves of both spaces.
pub(super) struct SpaceLeaves {
    pub(super) observation: Vec<LeafSpec>,
    pub(super) action: Vec<LeafSpec>,
}

impl SpaceLeaves {
    /// Lists the leaves of the spaces in the metadata.
    ///
    /// # Errors
    /// [`DatasetError::Metadata`] if a space is missing or has a part whose columns cannot be told.
    pub(super) fn new(metadata: &Metadata) -> Result<Self> {
        // Minari's own rule: pictures are encoded unless the field says that they are not.
        let encoded = metadata.fields.get("jpeg_encoding") != Some(&Value::Bool(false));
        let leaves = |field: &'static str, space: &Option<Value>, root: &str| {
            let mut leaves = Vec::new();
            let known = collect(&Space::of(space), root, encoded, &mut leaves);
            known.map(|()| leaves).ok_or_else(|| DatasetError::Metadata {
                field: field.to_owned(),
                actual: match space {
                    None => "missing".to_owned(),
                    Some(_) => "of a type that is not known".to_owned(),
                },
                expected: "a space that tells the columns, since there is no episode to tell them",
            })
        };
        Ok(Self {
            observation: leaves(
                "observation_space",
                &metadata.observation_space,
                schema::OBSERVATION,
            )?,
            action: leaves("action_space", &metadata.action_space, schema::ACTION)?,
        })
    }

    /// The fields of all step columns; Minari records rewards as `float64`.
    pub(super) fn fields(&self) -> Vec<FieldRef> {
        let field = |leaf: &LeafSpec, nullable| match leaf.data_type {
            DataType::Binary => schema::image_field(&leaf.column, "jpeg", &leaf.shape),
            _ => schema::leaf_field(&leaf.column, leaf.data_type.clone(), &leaf.shape, nullable),
        };
        let observation = self.observation.iter().map(|leaf| field(leaf, false));
        let action = self.action.iter().map(|leaf| field(leaf, true));
        let rest = [
            (schema::REWARD, DataType::Float64),
            (schema::TERMINATED, DataType::Boolean),
            (schema::TRUNCATED, DataType::Boolean),
        ];
        observation
            .chain(action)
            .chain(rest.map(|(name, data_type)| Field::new(name, data_type, true)))
            .map(Arc::new)
            .collect()
    }
}

/// Adds the leaves under `column`; `None` if one of them cannot be a column.
fn collect(space: &Space, column: &str, encoded: bool, leaves: &mut Vec<LeafSpec>) -> Option<()> {
    match space {
        Space::Leaf {
            kind,
            shape,
            data_type,
        } => {
            let shape = shape.clone()?;
            let width = shape
                .iter()
                .try_fold(1usize, |n, &dim| n.checked_mul(dim))?;
            i32::try_from(width).ok().filter(|&width| width > 0)?;
            let data_type = match kind {
                LeafKind::Image if encoded => DataType::Binary,
                _ => data_type.clone()?,
            };
            leaves.push(LeafSpec {
                column: column.to_owned(),
                kind: *kind,
                shape,
                data_type,
            });
        }
        Space::Dict(parts) => {
            let mut parts: Vec<_> = parts.iter().collect();
            parts.sort_by(|a, b| key_order(&a.0, &b.0));
            for (key, part) in parts {
                collect(part, &schema::join_key(column, key), encoded, leaves)?;
            }
        }
        Space::Tuple(parts) => {
            for (index, part) in parts.iter().enumerate() {
                collect(part, &format!("{column}[{index}]"), encoded, leaves)?;
            }
        }
        Space::Unknown => return None,
    }
    Some(())
}
