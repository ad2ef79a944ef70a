//! Which fields of a message type a path of the mapping means.

use arrow::datatypes::DataType;

use super::decode::{FieldDescription, FieldKind, FieldLength, FieldPath};
use crate::error::{DatasetError, Result};

/// What is taken out of a message.
#[derive(Default)]
pub(super) struct Paths {
    /// By a compiled plan.
    pub(super) planned: Vec<FieldPath>,
    /// From the whole decoded message: integers that f64 cannot hold, and JSON's words for numbers.
    pub(super) in_tree: Vec<FieldPath>,
}

impl Paths {
    pub(super) fn add(&mut self, path: FieldPath) -> usize {
        self.planned.push(path);
        self.planned.len() - 1
    }

    pub(super) fn add_to_tree(&mut self, path: FieldPath) -> usize {
        self.in_tree.push(path);
        self.in_tree.len() - 1
    }
}

/// The field at a path, or all fields of the struct there.
pub(super) fn leaves_of(fields: &[FieldDescription], path: &str) -> Result<Vec<FieldDescription>> {
    if let Some(field) = fields.iter().find(|field| field.path == path) {
        return Ok(vec![field.clone()]);
    }
    let inside: Vec<FieldDescription> = fields
        .iter()
        .filter(|field| {
            field
                .path
                .strip_prefix(path)
                .is_some_and(|rest| rest.starts_with('.'))
        })
        .cloned()
        .collect();
    let is_number = |field: &FieldDescription| {
        matches!(field.kind, FieldKind::Number(_) | FieldKind::Bool) && !field.path.contains("[]")
    };
    match inside.iter().all(is_number) {
        // An element of an array, or JSON that does not say: the messages will show.
        _ if inside.is_empty() => Ok(vec![FieldDescription {
            path: path.to_owned(),
            kind: element_kind(fields, path),
            length: FieldLength::One,
        }]),
        true => Ok(inside),
        false => Err(DatasetError::WrongType {
            key: path.to_owned(),
            actual: "a struct that holds more than numbers".to_owned(),
            expected: "numbers",
        }),
    }
}

/// Kind of `array[3]`: that of the array.
fn element_kind(fields: &[FieldDescription], path: &str) -> FieldKind {
    let array = path.split_once('[').map(|(array, _)| array);
    let member = path.rsplit_once(']').map_or("", |(_, member)| member);
    let found = array.and_then(|array| {
        let of_struct = format!("{array}[]{member}");
        fields
            .iter()
            .find(|field| field.path == array || field.path == of_struct)
    });
    match found.map(|field| field.kind.clone()) {
        Some(FieldKind::Bytes) => FieldKind::Number(DataType::UInt8),
        Some(kind) => kind,
        None => FieldKind::Any,
    }
}

/// A list of texts called `name` beside the only array of numbers: joints are to be told by their names.
pub(super) fn names_beside(fields: &[FieldDescription], paths: &[String]) -> Option<String> {
    let [path] = paths else {
        return None;
    };
    let parent = path.rsplit_once('.').map_or("", |(parent, _)| parent);
    let beside = match parent {
        "" => "name".to_owned(),
        parent => format!("{parent}.name"),
    };
    let is_list =
        |field: &&FieldDescription| field.length != FieldLength::One || field.path.contains("[]");
    let own = fields.iter().find(|field| field.path == *path)?;
    let names = fields
        .iter()
        .find(|field| field.path == beside && field.kind == FieldKind::Text);
    names
        .filter(is_list)
        .filter(|_| is_list(&own))
        .map(|_| beside)
}

/// Names of the fields of a struct, without what they have in common.
pub(super) fn leaf_names(fields: &[FieldDescription]) -> Option<Vec<String>> {
    if fields.len() < 2 || fields.iter().any(|field| field.length != FieldLength::One) {
        return None;
    }
    let parent_of = |path: &str| path.rsplit_once('.').map_or(0, |(parent, _)| parent.len());
    let first = &fields.first()?.path;
    let mut parent = &first[..parent_of(first)];
    let is_inside = |field: &FieldDescription, parent: &str| {
        let rest = field.path.strip_prefix(parent);
        parent.is_empty() || rest.is_some_and(|rest| rest.starts_with('.'))
    };
    while !fields.iter().all(|field| is_inside(field, parent)) {
        parent = &parent[..parent_of(parent)];
    }
    let short = |field: &FieldDescription| {
        let rest = field.path.strip_prefix(parent).unwrap_or(&field.path);
        rest.trim_start_matches('.').to_owned()
    };
    Some(fields.iter().map(short).collect())
}
