//! What a topic can be, by its type and name.

use super::decode::{FieldKind, FieldLength};
use super::inspect::TopicInspection;

/// What a topic can be.
pub(super) enum Shape {
    Joints { values: &'static str },
    Pose { prefix: String },
    Picture,
    Numbers(Vec<String>),
    Nothing,
}

/// Tells by the fields.
pub(super) fn shape(topic: &TopicInspection) -> Shape {
    let has = |path: &str| topic.fields.iter().any(|field| field.path == path);
    let is_bytes = |path: &str| {
        topic
            .fields
            .iter()
            .any(|field| field.path == path && field.kind == FieldKind::Bytes)
    };
    if is_bytes("data")
        && (has("format") && !topic.schema.contains("Video") || has("encoding") && has("step"))
    {
        return Shape::Picture;
    }
    for values in ["position", "joints[].position"] {
        let names = match values {
            "position" => "name",
            _ => "joints[].name",
        };
        if has(values) && has(names) && !topic.names.is_empty() {
            return Shape::Joints { values };
        }
    }
    if let Some(field) = topic
        .fields
        .iter()
        .find(|field| field.path.ends_with("orientation.w"))
    {
        let prefix = field.path.trim_end_matches("orientation.w").to_owned();
        return match has(&format!("{prefix}position.x")) {
            true => Shape::Pose { prefix },
            false => Shape::Nothing,
        };
    }
    let is_data = |path: &str| {
        let first = path.split('.').next().unwrap_or_default();
        !["header", "layout", "timestamp", "t", "stamp", "time"].contains(&first)
            && !path.contains("[]")
    };
    let numbers: Vec<String> = topic
        .numeric_fields()
        .filter(|field| is_data(&field.path))
        .filter(|field| matches!(field.kind, FieldKind::Number(_)))
        .map(|field| field.path.clone())
        .collect();
    let is_list = |path: &String| {
        let lists = topic
            .fields
            .iter()
            .filter(|field| field.length != FieldLength::One);
        lists.into_iter().any(|field| field.path == *path)
    };
    match numbers.is_empty() || numbers.len() > 64 {
        true => Shape::Nothing,
        // One list is the message (Float64MultiArray); counters beside it are not.
        false
            if numbers.iter().filter(|path| is_list(path)).count() == 1
                && is_list(&numbers[0])
                && numbers[0] == "data" =>
        {
            Shape::Numbers(vec!["data".to_owned()])
        }
        false => Shape::Numbers(numbers),
    }
}

/// Whether a joint or topic is one of a gripper.
pub(super) fn is_gripper(name: &str) -> bool {
    let name = name.to_lowercase();
    ["gripper", "finger", "grasp", "jaw"]
        .iter()
        .any(|word| name.contains(word))
}

/// A column name from a topic.
pub(super) fn slug(topic: &str) -> String {
    let parts: Vec<&str> = topic
        .split(|c: char| !c.is_ascii_alphanumeric() && c != '_')
        .filter(|part| {
            !part.is_empty() && !["image_raw", "compressed", "image", "color"].contains(part)
        })
        .collect();
    match parts.is_empty() {
        true => "values".to_owned(),
        false => parts.join("_"),
    }
}
