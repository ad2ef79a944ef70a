//! The columns of a Minari dataset, as its first episode and its spaces have them.

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::datatypes::{DataType, FieldRef};

use super::space::{Space, key_order, tuple_index};
use crate::error::{DatasetError, Result};
use crate::formats::hdf5::{
    Array, ColumnSource, Element, H5File, MAX_DEPTH, MemberKind, RowRule, StepColumn, array_paths,
    join, members, nested_without_end,
};
use crate::schema;
use crate::source::Warning;
use crate::spec::{LeafKind, LeafSpec};

/// The leaves of one episode.
pub(super) struct Structure {
    pub(super) observation: Vec<LeafSpec>,
    pub(super) action: Vec<LeafSpec>,
    pub(super) columns: Vec<StepColumn>,
    /// Fields of the columns, and of those a dataset without episodes would have.
    pub(super) fields: Vec<FieldRef>,
    pub(super) warnings: Vec<Warning>,
}

/// Lists the leaves of the episode in group `episode`.
///
/// # Errors
/// Observations, actions or rewards are missing or of a type that cannot be.
pub(super) fn structure(
    file: &H5File,
    episode: &str,
    observation_space: &Space,
    action_space: &Space,
) -> Result<Structure> {
    let group = file.group(episode)?;
    let mut walk = Walk::new(file, episode);
    let top = members(&group, episode)?;
    let find = |name: &str| {
        top.iter()
            .find(|member| member.name == name)
            .map(|member| member.kind)
    };
    let require = |name: &str| {
        find(name).ok_or_else(|| DatasetError::MissingKey {
            key: join(episode, name),
            found: top
                .iter()
                .map(|member| member.name.as_str())
                .collect::<Vec<_>>()
                .join(", "),
        })
    };
    let kind = require("observations")?;
    walk.node(
        kind,
        Node::root("observations", schema::OBSERVATION, RowRule::Observation),
        observation_space,
    )?;
    let observation = std::mem::take(&mut walk.leaves);
    let kind = require("actions")?;
    walk.node(
        kind,
        Node::root("actions", schema::ACTION, RowRule::Step),
        action_space,
    )?;
    let action = std::mem::take(&mut walk.leaves);
    require("rewards")?;
    walk.scalar("rewards", schema::REWARD)?;
    for (key, column) in [
        ("terminations", schema::TERMINATED),
        ("truncations", schema::TRUNCATED),
    ] {
        if find(key) == Some(MemberKind::Array) {
            walk.scalar(key, column)?;
        }
    }
    if let Some(kind) = find("infos") {
        walk.node(
            kind,
            Node::root("infos", schema::INFO, RowRule::Info),
            &Space::Unknown,
        )?;
    }
    Ok(walk.finish(observation, action))
}

struct Walk<'f> {
    file: &'f H5File,
    episode: &'f str,
    columns: Vec<StepColumn>,
    leaves: Vec<LeafSpec>,
    warnings: Vec<Warning>,
}

/// A place in the tree of an episode.
#[derive(Clone, Copy)]
struct Node<'n> {
    /// Path inside the episode.
    key: &'n str,
    column: &'n str,
    rule: RowRule,
    depth: usize,
}

impl<'n> Node<'n> {
    fn root(key: &'n str, column: &'n str, rule: RowRule) -> Self {
        Self {
            key,
            column,
            rule,
            depth: 0,
        }
    }
}

impl<'f> Walk<'f> {
    fn new(file: &'f H5File, episode: &'f str) -> Self {
        Self {
            file,
            episode,
            columns: Vec::new(),
            leaves: Vec::new(),
            warnings: Vec::new(),
        }
    }

    fn finish(self, observation: Vec<LeafSpec>, action: Vec<LeafSpec>) -> Structure {
        let fields = self.columns.iter();
        Structure {
            observation,
            action,
            fields: fields.map(|column| Arc::clone(&column.field)).collect(),
            columns: self.columns,
            warnings: self.warnings,
        }
    }

    fn node(&mut self, kind: MemberKind, node: Node<'_>, space: &Space) -> Result<()> {
        if kind == MemberKind::Array {
            return self.leaf(node, space);
        }
        if node.depth > MAX_DEPTH {
            return Err(nested_without_end(node.key));
        }
        let path = join(self.episode, node.key);
        let group = self.file.group(&path)?;
        let mut parts = members(&group, &path)?;
        parts.sort_by(|a, b| key_order(&a.name, &b.name));
        for part in parts {
            let column = match tuple_index(&part.name) {
                Some(index) if !matches!(space, Space::Dict(_)) => {
                    format!("{}[{index}]", node.column)
                }
                _ => schema::join_key(node.column, &part.name),
            };
            let key = join(node.key, &part.name);
            let child = Node {
                key: &key,
                column: &column,
                depth: node.depth + 1,
                ..node
            };
            self.node(part.kind, child, space.member(&part.name))?;
        }
        Ok(())
    }

    fn leaf(&mut self, node: Node<'_>, space: &Space) -> Result<()> {
        let path = join(self.episode, node.key);
        let array = match self.file.array(&path) {
            Ok(array) if array.width() > 0 => array,
            Ok(_) if node.rule == RowRule::Info => {
                return self.left_out(node, "its rows are empty");
            }
            Err(DatasetError::WrongType { .. } | DatasetError::ShapeMismatch { .. })
                if node.rule == RowRule::Info =>
            {
                return self.left_out(node, "its type or shape cannot be a column");
            }
            Ok(array) => {
                let (actual, expected) = (
                    array.row_shape().to_vec(),
                    "at least one value a row".to_owned(),
                );
                return Err(DatasetError::ShapeMismatch {
                    key: path,
                    actual,
                    expected,
                });
            }
            Err(error) => return Err(error),
        };
        let (kind, shape, element) = self.interpret(&array, node, space)?;
        let nullable = node.rule != RowRule::Observation;
        let field = match element {
            Element::Bytes => schema::image_field(node.column, "jpeg", &shape),
            _ => schema::leaf_field(node.column, element.data_type(), &shape, nullable),
        };
        let data_type = element.data_type();
        self.leaves.push(LeafSpec {
            column: node.column.to_owned(),
            kind,
            shape,
            data_type,
        });
        let width = if element == Element::Bytes {
            1
        } else {
            array.width()
        };
        self.columns.push(StepColumn {
            field: Arc::new(field),
            source: ColumnSource {
                key: node.key.to_owned(),
                element,
                width,
                rule: node.rule,
            },
        });
        Ok(())
    }

    fn left_out(&mut self, node: Node<'_>, reason: &'static str) -> Result<()> {
        self.warnings.push(Warning::ColumnLeftOut {
            column: node.column.to_owned(),
            reason,
        });
        Ok(())
    }

    /// Kind, row shape and stored type of a leaf. The data decides; the space says what it means.
    fn interpret(
        &mut self,
        array: &Array,
        node: Node<'_>,
        space: &Space,
    ) -> Result<(LeafKind, Vec<usize>, Element)> {
        let stored = array.row_shape().to_vec();
        let (kind, declared) = match space {
            Space::Leaf { kind, shape, .. } => (Some(*kind), shape.clone()),
            _ => (None, None),
        };
        if array.element() == Element::Bytes {
            return Ok((
                LeafKind::Image,
                declared.unwrap_or_default(),
                Element::Bytes,
            ));
        }
        // One plain byte row per picture: Minari writes these when all pictures have the same length.
        let flat_picture = array.element() == Element::U8
            && stored.len() == 1
            && kind == Some(LeafKind::Image)
            && declared.as_ref().is_some_and(|shape| shape.len() > 1);
        if flat_picture {
            return Ok((
                LeafKind::Image,
                declared.unwrap_or_default(),
                Element::Bytes,
            ));
        }
        if declared.is_some_and(|shape| shape != stored) {
            self.warnings.push(Warning::SpaceMismatch {
                column: node.column.to_owned(),
            });
        }
        let inferred = match (array.element(), stored.len()) {
            (Element::Text, _) => LeafKind::Text,
            (Element::U8, 2 | 3) => LeafKind::Image,
            _ => LeafKind::Box,
        };
        if array.element() == Element::Text && !stored.is_empty() {
            let expected = "one text a row".to_owned();
            return Err(DatasetError::ShapeMismatch {
                key: array.key().to_owned(),
                actual: stored,
                expected,
            });
        }
        Ok((kind.unwrap_or(inferred), stored, array.element()))
    }

    fn scalar(&mut self, key: &str, column: &str) -> Result<()> {
        let array = self.file.array(&join(self.episode, key))?;
        if !array.is_column() {
            let (actual, expected) = (array.row_shape().to_vec(), "one value a row".to_owned());
            return Err(DatasetError::ShapeMismatch {
                key: array.key().to_owned(),
                actual,
                expected,
            });
        }
        let element = array.element();
        let data_type = if column == schema::REWARD {
            element.data_type()
        } else {
            DataType::Boolean
        };
        let field = schema::leaf_field(column, data_type, &[], true);
        let source = ColumnSource {
            key: key.to_owned(),
            element,
            width: 1,
            rule: RowRule::Step,
        };
        self.columns.push(StepColumn {
            field: Arc::new(field),
            source,
        });
        Ok(())
    }
}

/// Steps and observation rows of an episode, by the shapes of its arrays alone.
///
/// # Errors
/// The arrays are not there.
pub(super) fn episode_lengths(
    file: &H5File,
    episode: &str,
    observation: &str,
) -> Result<(u64, u64)> {
    let length = |key: &str| Array::length(file.root(), &join(episode, key));
    Ok((length("rewards")?, length(observation)?))
}

/// The keys of an episode's info leaves. Links that lead out of the file are refused, wherever in the episode
/// they are.
///
/// # Errors
/// Such a link, or a damaged group.
pub(super) fn check_members(file: &H5File, episode: &str) -> Result<BTreeSet<String>> {
    let arrays = array_paths(file, episode)?.into_iter();
    Ok(arrays.filter(|key| key.starts_with("infos/")).collect())
}
