//! Nested keys of observation, action and info columns.

use crate::error::{DatasetError, Result};
use crate::schema;

/// A part of a space: leaves are places in a list of columns.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Node {
    Leaf(usize),
    Dict(Vec<(String, Node)>),
    Tuple(Vec<Node>),
}

/// One step from a part to a part of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Key {
    Name(String),
    Index(usize),
}

/// The keys that lead to a leaf, and its place in the list of columns.
pub(crate) type KeyedLeaf = (Vec<Key>, usize);

/// The keys that lead from `root` to `column`.
pub(crate) fn keys(column: &str, root: &str) -> Vec<Key> {
    let mut rest = column.strip_prefix(root).unwrap_or(column);
    let mut keys = Vec::new();
    while !rest.is_empty() {
        let (name, after) = if let Some(open) = rest.strip_prefix('.') {
            let end = open.find('.').unwrap_or(open.len());
            open.split_at(end)
        } else {
            let end = rest.find('.').unwrap_or(rest.len());
            rest.split_at(end)
        };
        let (name, indices) = split_indices(name);
        if rest.starts_with('.') || !name.is_empty() {
            keys.push(Key::Name(schema::unescape_key(name)));
        }
        keys.extend(indices.into_iter().map(Key::Index));
        rest = after;
    }
    keys
}

/// `name[0][1]` as `name` and its indices.
fn split_indices(text: &str) -> (&str, Vec<usize>) {
    let mut name = text;
    let mut indices = Vec::new();
    while let Some((before, digits)) = name
        .strip_suffix(']')
        .and_then(|open| open.rsplit_once('['))
    {
        let Ok(index) = digits.parse() else { break };
        indices.push(index);
        name = before;
    }
    indices.reverse();
    (name, indices)
}

impl Node {
    /// The tree of leaves with these keys; `None` without leaves.
    ///
    /// # Errors
    /// The keys of one leaf lead through another.
    pub(crate) fn build(leaves: &[KeyedLeaf]) -> Result<Option<Self>> {
        match leaves {
            [] => Ok(None),
            [(keys, leaf)] if keys.is_empty() => Ok(Some(Self::Leaf(*leaf))),
            several => {
                let mut parts: Vec<(Key, Vec<KeyedLeaf>)> = Vec::new();
                for (keys, leaf) in several {
                    let Some((first, rest)) = keys.split_first() else {
                        let what = "a column that is both a leaf and a group of leaves".to_owned();
                        return Err(DatasetError::Unsupported { what });
                    };
                    let below = (rest.to_vec(), *leaf);
                    match parts.iter_mut().find(|(key, _)| key == first) {
                        Some((_, leaves)) => leaves.push(below),
                        None => parts.push((first.clone(), vec![below])),
                    }
                }
                Self::of_parts(parts).map(Some)
            }
        }
    }

    fn of_parts(parts: Vec<(Key, Vec<KeyedLeaf>)>) -> Result<Self> {
        let is_tuple = (0..)
            .zip(&parts)
            .all(|(place, (key, _))| *key == Key::Index(place));
        let mut built = Vec::with_capacity(parts.len());
        for (key, leaves) in parts {
            // What is no whole tuple (a part was left out) becomes a dictionary.
            let name = match key {
                Key::Name(name) => name,
                Key::Index(index) => format!("_index_{index}"),
            };
            if let Some(node) = Self::build(&leaves)? {
                built.push((name, node));
            }
        }
        Ok(if is_tuple {
            Self::Tuple(built.into_iter().map(|(_, node)| node).collect())
        } else {
            Self::Dict(built)
        })
    }

    /// The names on the way to every leaf, where elements of tuples are named by `element`.
    #[cfg_attr(
        not(feature = "hdf5"),
        allow(dead_code, reason = "used by the HDF5 writer")
    )]
    pub(crate) fn paths(&self, element: fn(usize) -> String) -> Vec<(usize, Vec<String>)> {
        let below = |name: String, node: &Self| {
            let paths = node.paths(element).into_iter();
            let extended = paths.map(move |(leaf, mut path)| {
                path.insert(0, name.clone());
                (leaf, path)
            });
            extended.collect::<Vec<_>>()
        };
        match self {
            Self::Leaf(leaf) => vec![(*leaf, Vec::new())],
            Self::Dict(parts) => parts
                .iter()
                .flat_map(|(name, node)| below(name.clone(), node))
                .collect(),
            Self::Tuple(parts) => parts
                .iter()
                .enumerate()
                .flat_map(|(index, node)| below(element(index), node))
                .collect(),
        }
    }

    /// Whether a tuple is among the parts.
    pub(crate) fn has_tuple(&self) -> bool {
        match self {
            Self::Leaf(_) => false,
            Self::Dict(parts) => parts.iter().any(|(_, node)| node.has_tuple()),
            Self::Tuple(_) => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree(columns: &[&str]) -> Result<Option<Node>> {
        let leaves: Vec<_> = columns
            .iter()
            .enumerate()
            .map(|(i, c)| (keys(c, "observation"), i))
            .collect();
        Node::build(&leaves)
    }

    #[test]
    fn columns_become_spaces() {
        assert_eq!(tree(&["observation"]).unwrap(), Some(Node::Leaf(0)));
        let nested = tree(&[
            "observation.a~1b[0].c",
            "observation.a~1b[1]",
            "observation.t~01",
        ]);
        let inner = Node::Dict(vec![("c".to_owned(), Node::Leaf(0))]);
        let expected = Node::Dict(vec![
            ("a.b".to_owned(), Node::Tuple(vec![inner, Node::Leaf(1)])),
            ("t~1".to_owned(), Node::Leaf(2)),
        ]);
        assert_eq!(nested.unwrap(), Some(expected));
        let tuple = tree(&["observation[0]", "observation[1][0]"]).unwrap();
        assert_eq!(
            tuple,
            Some(Node::Tuple(vec![
                Node::Leaf(0),
                Node::Tuple(vec![Node::Leaf(1)])
            ]))
        );
    }

    #[test]
    fn a_tuple_with_a_gap_is_a_dictionary() {
        let gap = tree(&["observation[1]"]).unwrap().unwrap();
        assert_eq!(
            gap,
            Node::Dict(vec![("_index_1".to_owned(), Node::Leaf(0))])
        );
    }

    #[test]
    fn a_leaf_above_others_is_refused() {
        assert!(tree(&["observation.a", "observation.a.b"]).is_err());
        assert!(tree(&["observation", "observation.b"]).is_err());
    }
}
