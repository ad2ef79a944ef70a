//! The columns of a dataset, as the file of its first episode and its spaces have them.

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, FieldRef, Fields, Schema};

use super::super::space::{Space, key_order};
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::source::Warning;
use crate::spec::{LeafKind, LeafSpec};

/// Which rows of an episode a column has values in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Rule {
    /// All rows.
    Observation,
    /// All but the padding in the last one.
    Step,
    /// Wherever it is not null.
    Info,
}

/// A canonical column and where it comes from.
#[derive(Debug, Clone)]
pub(super) struct Leaf {
    /// Names from the file's column down to the leaf.
    pub(super) path: Vec<String>,
    pub(super) field: FieldRef,
    /// Type in the file of the first episode.
    pub(super) stored: DataType,
    pub(super) rule: Rule,
}

/// The columns of one file.
#[derive(Debug, Default)]
pub(super) struct Leaves {
    pub(super) observation: Vec<LeafSpec>,
    pub(super) action: Vec<LeafSpec>,
    pub(super) columns: Vec<Leaf>,
    pub(super) warnings: Vec<Warning>,
}

impl Leaves {
    /// Lists the leaves of a file.
    ///
    /// # Errors
    /// Observations, actions or rewards are missing or of a type that cannot be.
    pub(super) fn new(file: &Schema, observation: &Space, action: &Space) -> Result<Self> {
        let mut leaves = Self::default();
        let require = |name: &str| {
            file.field_with_name(name)
                .map_err(|_| DatasetError::MissingKey {
                    key: name.to_owned(),
                    found: schema::column_names(file),
                })
        };
        let mut specs = leaves.walk(
            require("observations")?,
            Node::root("observations", schema::OBSERVATION, Rule::Observation),
            observation,
        )?;
        leaves.observation.append(&mut specs);
        let mut specs = leaves.walk(
            require("actions")?,
            Node::root("actions", schema::ACTION, Rule::Step),
            action,
        )?;
        leaves.action.append(&mut specs);
        leaves.scalar(require("rewards")?, schema::REWARD)?;
        for (name, column) in [
            ("terminations", schema::TERMINATED),
            ("truncations", schema::TRUNCATED),
        ] {
            if let Ok(field) = file.field_with_name(name) {
                leaves.scalar(field, column)?;
            }
        }
        if let Ok(field) = file.field_with_name("infos") {
            leaves.walk(
                field,
                Node::root("infos", schema::INFO, Rule::Info),
                &Space::Unknown,
            )?;
        }
        Ok(leaves)
    }

    fn scalar(&mut self, field: &Field, column: &str) -> Result<()> {
        let stored = field.data_type();
        let fits = match column {
            schema::REWARD => schema::is_number(stored),
            _ => *stored == DataType::Boolean,
        };
        if !fits {
            return Err(wrong_type(
                &[field.name().clone()],
                stored,
                "one number or flag a row",
            ));
        }
        self.columns.push(Leaf {
            path: vec![field.name().clone()],
            field: Arc::new(schema::leaf_field(column, stored.clone(), &[], true)),
            stored: stored.clone(),
            rule: Rule::Step,
        });
        Ok(())
    }

    /// Adds the leaves under a column and returns what they are.
    fn walk(&mut self, field: &Field, node: Node, space: &Space) -> Result<Vec<LeafSpec>> {
        let DataType::Struct(children) = field.data_type() else {
            return Ok(self.leaf(field, node, space)?.into_iter().collect());
        };
        let mut specs = Vec::new();
        for (child, column, space) in ordered(children, &node.column, space) {
            let mut path = node.path.clone();
            path.push(child.name().clone());
            let child_node = Node {
                path,
                column,
                rule: node.rule,
            };
            specs.append(&mut self.walk(&child, child_node, space)?);
        }
        Ok(specs)
    }

    fn leaf(&mut self, field: &Field, node: Node, space: &Space) -> Result<Option<LeafSpec>> {
        let stored = field.data_type();
        let Some((kind, shape, data_type)) = self.interpret(field, &node, space) else {
            if node.rule == Rule::Info {
                self.warnings.push(Warning::ColumnLeftOut {
                    column: node.column,
                    reason: "its type or shape cannot be a column",
                });
                return Ok(None);
            }
            let expected = "numbers, lists of numbers of one length, text or pictures";
            return Err(wrong_type(&node.path, stored, expected));
        };
        let field = match data_type {
            DataType::Binary => schema::image_field(&node.column, "jpeg", &shape),
            _ => schema::leaf_field(
                &node.column,
                data_type.clone(),
                &shape,
                node.rule != Rule::Observation,
            ),
        };
        self.columns.push(Leaf {
            path: node.path,
            field: Arc::new(field),
            stored: stored.clone(),
            rule: node.rule,
        });
        Ok(Some(LeafSpec {
            column: node.column,
            kind,
            shape,
            data_type,
        }))
    }

    /// Kind, row shape and value type of a leaf, or `None` if it cannot be a column. The data decides; the
    /// space says what it means.
    fn interpret(
        &mut self,
        field: &Field,
        node: &Node,
        space: &Space,
    ) -> Option<(LeafKind, Vec<usize>, DataType)> {
        let (kind, declared) = match space {
            Space::Leaf { kind, shape, .. } => (Some(*kind), shape.clone()),
            _ => (None, None),
        };
        let (inferred, shape, data_type) = match field.data_type() {
            DataType::Utf8 | DataType::LargeUtf8 => (LeafKind::Text, Vec::new(), DataType::Utf8),
            DataType::Binary | DataType::LargeBinary => {
                let shape = declared.unwrap_or_default();
                return Some((LeafKind::Image, shape, DataType::Binary));
            }
            DataType::FixedSizeList(child, size) => {
                let width = usize::try_from(*size).ok().filter(|width| *width > 0)?;
                let recorded = declared.clone().or_else(|| info_shape(field));
                let shape = recorded
                    .filter(|shape| product(shape) == Some(width) && !shape.is_empty())
                    .unwrap_or_else(|| vec![width]);
                is_value(child.data_type())
                    .then(|| (LeafKind::Box, shape, child.data_type().clone()))?
            }
            other => is_value(other).then(|| (LeafKind::Box, Vec::new(), other.clone()))?,
        };
        if declared.is_some_and(|declared| declared != shape) {
            self.warnings.push(Warning::SpaceMismatch {
                column: node.column.clone(),
            });
        }
        let inferred = match (&data_type, shape.len()) {
            (DataType::UInt8, 2 | 3) => LeafKind::Image,
            _ => inferred,
        };
        Some((kind.unwrap_or(inferred), shape, data_type))
    }
}

/// A place in the tree of a file's columns.
struct Node {
    path: Vec<String>,
    column: String,
    rule: Rule,
}

impl Node {
    fn root(name: &str, column: &str, rule: Rule) -> Self {
        Self {
            path: vec![name.to_owned()],
            column: column.to_owned(),
            rule,
        }
    }
}

/// The parts of a struct in canonical order, with their columns and spaces. Elements of a tuple are named by
/// their number.
fn ordered<'s>(
    children: &Fields,
    column: &str,
    space: &'s Space,
) -> Vec<(FieldRef, String, &'s Space)> {
    let mut children: Vec<FieldRef> = children.iter().map(Arc::clone).collect();
    let index = |field: &Field| field.name().parse::<usize>().unwrap_or(usize::MAX);
    if let Space::Tuple(parts) = space {
        children.sort_by_key(|field| index(field));
        let part = |field: FieldRef| {
            let index = index(&field);
            let space = parts.get(index).unwrap_or(&Space::Unknown);
            (field, format!("{column}[{index}]"), space)
        };
        return children.into_iter().map(part).collect();
    }
    children.sort_by(|a, b| key_order(a.name(), b.name()));
    let part = |field: FieldRef| {
        let (name, space) = (
            schema::join_key(column, field.name()),
            space.member(field.name()),
        );
        (field, name, space)
    };
    children.into_iter().map(part).collect()
}

/// Paths of all leaves under `infos`, joined with slashes.
pub(super) fn info_paths(file: &Schema) -> BTreeSet<String> {
    fn collect(field: &Field, path: String, found: &mut BTreeSet<String>) {
        match field.data_type() {
            DataType::Struct(children) => {
                for child in children {
                    collect(child, format!("{path}/{}", child.name()), found);
                }
            }
            _ => {
                found.insert(path);
            }
        }
    }
    let mut found = BTreeSet::new();
    if let Ok(field) = file.field_with_name("infos") {
        collect(field, field.name().clone(), &mut found);
    }
    found
}

/// The shape Minari notes beside the lists of an info: `2,3`.
fn info_shape(field: &Field) -> Option<Vec<usize>> {
    let text = field.metadata().get("shape")?;
    text.split(',')
        .map(|part| part.trim().parse().ok())
        .collect()
}

fn product(shape: &[usize]) -> Option<usize> {
    shape.iter().try_fold(1usize, |n, &dim| n.checked_mul(dim))
}

fn is_value(data_type: &DataType) -> bool {
    schema::is_number(data_type) || *data_type == DataType::Boolean
}

/// A column of another type than it may have.
pub(super) fn wrong_type(
    path: &[String],
    actual: &DataType,
    expected: &'static str,
) -> DatasetError {
    DatasetError::WrongType {
        key: path.join("/"),
        actual: actual.to_string(),
        expected,
    }
}
