//! Keeping the recorded spaces true to the columns.

use std::collections::HashMap;

use serde_json::Value;

use crate::schema;

/// One step of a path into a space.
enum Step {
    Key(String),
    Element(usize),
}

/// Takes a leaf out of the space it belongs to. A space that has no leaf of its own for the column, or that
/// is the leaf itself, is dropped whole: no description is better than a wrong one.
pub(super) fn remove(metadata: &mut HashMap<String, String>, column: &str) {
    edit(metadata, column, |parent, step| match (parent, step) {
        (Value::Object(subspaces), Step::Key(key)) => subspaces.shift_remove(key).is_some(),
        // The elements behind it would get other numbers.
        _ => false,
    });
}

/// Gives a leaf another value type.
pub(super) fn retype(metadata: &mut HashMap<String, String>, column: &str, dtype: &str) {
    edit(metadata, column, |parent, step| {
        let leaf = match step {
            Step::Key(key) => parent.get_mut(key),
            Step::Element(place) => parent.get_mut(*place),
        };
        let Some(Value::Object(leaf)) = leaf else {
            return false;
        };
        let is_box = leaf.get("type").and_then(Value::as_str) == Some("Box");
        if is_box {
            leaf.insert("dtype".to_owned(), dtype.into());
        }
        is_box
    });
}

/// Finds the container of a column's leaf and lets `change` loose on it; false drops the space.
fn edit(
    metadata: &mut HashMap<String, String>,
    column: &str,
    change: impl Fn(&mut Value, &Step) -> bool,
) {
    let spaces = [
        (schema::OBSERVATION, schema::SPACE_OBSERVATION),
        (schema::ACTION, schema::SPACE_ACTION),
    ];
    for (root, key) in spaces {
        let Some(json) = metadata
            .get(key)
            .filter(|_| schema::belongs_to(column, root))
        else {
            continue;
        };
        let space = serde_json::from_str::<Value>(json).ok();
        let changed = space.and_then(|space| {
            // The space as the only element of a list, so that a space that is a leaf has a container too.
            let mut whole = Value::Array(vec![space]);
            let mut path = vec![Step::Element(0)];
            path.extend(steps(&column[root.len()..]));
            let (last, parents) = path.split_last()?;
            let mut container = &mut whole;
            for step in parents {
                container = match step {
                    Step::Key(key) => container.get_mut(key)?,
                    Step::Element(place) => container.get_mut(*place)?,
                }
                .get_mut("subspaces")?;
            }
            change(container, last).then(|| whole[0].to_string())
        });
        match changed {
            Some(json) => metadata.insert(key.to_owned(), json),
            None => metadata.remove(key),
        };
    }
}

/// The steps of `.key[0].other`, unescaped.
fn steps(path: &str) -> Vec<Step> {
    path.split_inclusive(['.', '['])
        .filter_map(|part| {
            let part = part.trim_end_matches(['.', '[']);
            match part.strip_suffix(']') {
                Some(number) => number.parse().ok().map(Step::Element),
                None if part.is_empty() => None,
                None => Some(Step::Key(schema::unescape_key(part))),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOX: &str = r#"{"type":"Box","dtype":"float64","shape":[2]}"#;

    fn metadata(space: &str) -> HashMap<String, String> {
        HashMap::from([(schema::SPACE_OBSERVATION.to_owned(), space.to_owned())])
    }

    #[test]
    fn a_leaf_is_found_through_keys_and_elements() {
        let space = format!(
            r#"{{"type":"Dict","subspaces":{{"a.b":{{"type":"Tuple","subspaces":[{BOX},{BOX}]}},"c":{BOX}}}}}"#
        );
        let mut metadata = metadata(&space);
        retype(&mut metadata, "observation.a~1b[1]", "float32");
        remove(&mut metadata, "observation.c");
        let float = BOX.replace("float64", "float32");
        assert_eq!(
            metadata[schema::SPACE_OBSERVATION],
            format!(
                r#"{{"type":"Dict","subspaces":{{"a.b":{{"type":"Tuple","subspaces":[{BOX},{float}]}}}}}}"#
            )
        );
    }

    #[test]
    fn a_space_that_is_a_leaf_is_retyped_or_dropped_whole() {
        let mut whole = metadata(BOX);
        retype(&mut whole, "observation", "float32");
        assert!(whole[schema::SPACE_OBSERVATION].contains("float32"));
        remove(&mut whole, "observation");
        assert!(whole.is_empty());
        let mut unfit = metadata(BOX);
        retype(&mut unfit, "observation.x", "float32");
        assert!(unfit.is_empty(), "a space that does not fit says nothing");
    }
}
