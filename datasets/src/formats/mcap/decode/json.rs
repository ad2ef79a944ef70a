//! JSON messages. A schema only describes; the messages are read as they are.

use arrow::datatypes::DataType;
use serde_json::{Map, Number, Value as Json};

use super::extract::Slot;
use super::fault::{Fault, exact_i64, exact_u64, fault, time_ns};
use super::path::{FieldPath, PathStep};
use super::{FieldDescription, FieldKind, FieldLength, MAX_LISTED, Value};

/// What is known of the messages: their JSON Schema, if it can be read.
#[derive(Debug, Clone)]
pub(super) struct JsonType {
    schema: Option<Json>,
}

impl JsonType {
    pub(super) fn new(schema: &[u8]) -> Self {
        Self {
            schema: serde_json::from_slice(schema).ok(),
        }
    }

    pub(super) fn describe(&self) -> Vec<FieldDescription> {
        let mut found = Vec::new();
        if let Some(schema) = &self.schema {
            describe_members(schema, "", false, &mut found);
        }
        found
    }
}

fn describe_members(
    schema: &Json,
    prefix: &str,
    in_array: bool,
    found: &mut Vec<FieldDescription>,
) {
    let members = schema.get("properties").and_then(Json::as_object);
    for (name, schema) in members.into_iter().flatten() {
        // A name that is no part of a path cannot be asked for.
        if name.is_empty() || name.contains(['.', '[', ']']) || found.len() >= MAX_LISTED {
            continue;
        }
        let path = format!("{prefix}{name}");
        match type_of(schema) {
            Some("object") if !is_time_schema(schema) || in_array => {
                describe_members(schema, &format!("{path}."), in_array, found);
            }
            Some("array") if in_array => {}
            Some("array") => {
                let items = schema.get("items").unwrap_or(&Json::Null);
                if type_of(items) == Some("object") {
                    describe_members(items, &format!("{path}[]."), true, found);
                } else if type_of(items) != Some("array") {
                    let kind = kind_of(items);
                    let length = length_of(schema);
                    found.push(FieldDescription { path, kind, length });
                }
            }
            _ => found.push(FieldDescription {
                path,
                kind: kind_of(schema),
                length: match in_array {
                    true => FieldLength::Variable { max: None },
                    false => FieldLength::One,
                },
            }),
        }
    }
}

/// The type, `null` left out.
fn type_of(schema: &Json) -> Option<&str> {
    match schema.get("type")? {
        Json::Array(types) => types
            .iter()
            .filter_map(Json::as_str)
            .find(|&name| name != "null"),
        other => other.as_str(),
    }
}

fn kind_of(schema: &Json) -> FieldKind {
    match type_of(schema) {
        Some("number") => FieldKind::Number(DataType::Float64),
        Some("integer") => FieldKind::Number(DataType::Int64),
        Some("boolean") => FieldKind::Bool,
        Some("string") => FieldKind::Text,
        Some("object") if is_time_schema(schema) => FieldKind::Time,
        _ => FieldKind::Any,
    }
}

fn is_time_schema(schema: &Json) -> bool {
    let members = schema.get("properties").and_then(Json::as_object);
    members.is_some_and(is_time)
}

/// Whether an object has the two members of a time, and no others.
fn is_time(map: &Map<String, Json>) -> bool {
    map.len() == 2 && map.contains_key("sec") && fraction(map).is_some()
}

fn fraction(map: &Map<String, Json>) -> Option<&Json> {
    map.get("nsec").or_else(|| map.get("nanosec"))
}

fn length_of(schema: &Json) -> FieldLength {
    let bound = |key: &str| {
        let bound = schema.get(key).and_then(Json::as_u64);
        bound.and_then(|n| usize::try_from(n).ok())
    };
    match (bound("minItems"), bound("maxItems")) {
        (Some(min), Some(max)) if min == max => FieldLength::Fixed(max),
        (_, max) => FieldLength::Variable { max },
    }
}

fn parse(data: &[u8]) -> Result<Json, Fault> {
    serde_json::from_slice(data).map_err(|error| fault(format!("it is not JSON: {error}")))
}

/// Decodes a message.
pub(super) fn decode(data: &[u8]) -> Result<Value, Fault> {
    parse(data).map(tree)
}

fn tree(json: Json) -> Value {
    match json {
        Json::Null => Value::Null,
        Json::Bool(flag) => Value::Bool(flag),
        Json::Number(number) => match (number.as_i64(), number.as_u64()) {
            (Some(value), _) => Value::Int(value),
            (None, Some(value)) => Value::Uint(value),
            (None, None) => Value::Float64(number.as_f64().unwrap_or(f64::NAN)),
        },
        Json::String(text) => Value::Text(text),
        Json::Array(items) => Value::List(items.into_iter().map(tree).collect()),
        Json::Object(map) => Value::Struct(
            map.into_iter()
                .map(|(name, value)| (name.into(), tree(value)))
                .collect(),
        ),
    }
}

/// Takes some fields out of a message.
pub(super) fn extract(data: &[u8], paths: &[FieldPath], slots: &mut [Slot]) -> Result<(), Fault> {
    let json = parse(data)?;
    for (path, slot) in paths.iter().zip(slots) {
        take(&json, &path.steps, slot).map_err(|fault| fault.in_member(&path.to_string()))?;
    }
    Ok(())
}

fn take(json: &Json, steps: &[PathStep], slot: &mut Slot) -> Result<(), Fault> {
    match steps {
        _ if json.is_null() => Ok(()),
        [] => whole(json, slot),
        [step, rest @ ..] => match (step, json) {
            (PathStep::Member(name), Json::Object(map)) => match map.get(name) {
                Some(member) => take(member, rest, slot),
                None => Ok(()),
            },
            (PathStep::Index(index), Json::Array(items)) => match items.get(*index) {
                Some(item) => take(item, rest, slot),
                None => Ok(()),
            },
            (PathStep::Each, Json::Array(items)) => {
                slot.mark_present();
                for (i, item) in items.iter().enumerate() {
                    take_single(item, rest, slot)?;
                    if slot.len() == i {
                        slot.add_number(f64::NAN);
                    }
                }
                check_one_kind(slot)
            }
            _ => Err(fault(format!("there is {} on the way", name_of(json)))),
        },
    }
}

/// A member of an element: one value or none.
fn take_single(json: &Json, steps: &[PathStep], slot: &mut Slot) -> Result<(), Fault> {
    match (steps, json) {
        (_, Json::Null) => Ok(()),
        ([], Json::Number(_) | Json::Bool(_) | Json::String(_)) => single(json, slot),
        ([PathStep::Member(name), rest @ ..], Json::Object(map)) => match map.get(name) {
            Some(member) => take_single(member, rest, slot),
            None => Ok(()),
        },
        ([], _) => Err(fault(format!("{} is no single value", name_of(json)))),
        _ => Err(fault(format!("there is {} on the way", name_of(json)))),
    }
}

fn whole(json: &Json, slot: &mut Slot) -> Result<(), Fault> {
    match json {
        Json::Object(map) if is_time(map) => {
            let seconds = map.get("sec").and_then(Json::as_i64);
            let ns = fraction(map).and_then(Json::as_i64);
            let (Some(seconds), Some(ns)) = (seconds, ns) else {
                return Err(fault("a time is not two integers"));
            };
            let ns = time_ns(seconds, ns, true)?;
            slot.set_time((ns != 0).then_some(ns));
            Ok(())
        }
        Json::Array(items) => {
            slot.mark_present();
            for item in items {
                match item {
                    Json::Null => slot.add_number(f64::NAN),
                    item => single(item, slot)?,
                }
            }
            check_one_kind(slot)
        }
        other => single(other, slot),
    }
}

fn single(json: &Json, slot: &mut Slot) -> Result<(), Fault> {
    match json {
        Json::Bool(flag) => slot.add_number(f64::from(u8::from(*flag))),
        Json::Number(value) => slot.add_number(exact(value)?),
        Json::String(text) => slot.add_text(text),
        other => return Err(fault(format!("{} is no value", name_of(other)))),
    }
    Ok(())
}

fn exact(number: &Number) -> Result<f64, Fault> {
    match (number.as_i64(), number.as_u64()) {
        (Some(value), _) => exact_i64(value),
        (None, Some(value)) => exact_u64(value),
        (None, None) => number
            .as_f64()
            .ok_or_else(|| fault(format!("{number} is no f64"))),
    }
}

fn check_one_kind(slot: &Slot) -> Result<(), Fault> {
    if !slot.numbers().is_empty() && slot.texts().len() > 0 {
        return Err(fault("numbers and texts are mixed"));
    }
    Ok(())
}

fn name_of(json: &Json) -> &'static str {
    match json {
        Json::Null => "null",
        Json::Bool(_) => "a flag",
        Json::Number(_) => "a number",
        Json::String(_) => "a text",
        Json::Array(_) => "an array",
        Json::Object(_) => "an object",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::mcap::decode::Extracted;

    fn extract_paths(text: &str, paths: &[&str]) -> Result<Extracted, String> {
        let paths: Vec<FieldPath> = paths.iter().map(|path| path.parse().unwrap()).collect();
        let mut out = Extracted::default();
        extract(text.as_bytes(), &paths, out.start(paths.len(), 0).0)
            .map_err(|fault| fault.into_text())?;
        Ok(out)
    }

    #[test]
    fn fields_are_taken_wherever_they_are() {
        let text = r#"{"t": {"sec": 5, "nsec": 7}, "zero": {"sec": 0, "nanosec": 0}, "q": [1, null, 2.5],
            "deep": {"flag": true, "names": ["a", "b"]}, "no": null,
            "joints": [{"p": 1}, {}, {"p": 3}]}"#;
        let paths = [
            "t",
            "zero",
            "q",
            "q[2]",
            "deep.flag",
            "deep.names",
            "no",
            "no.more",
            "missing",
            "joints[].p",
            "joints[2].p",
            "joints[3].p",
            "t.nsec",
        ];
        let out = extract_paths(text, &paths).unwrap();
        let slot = |i: usize| &out.slots()[i];
        assert_eq!(slot(0).time_ns(), Some(5_000_000_007));
        assert!(!slot(1).present());
        let q = slot(2).numbers();
        assert!(q[0] == 1.0 && q[1].is_nan() && q[2] == 2.5);
        assert_eq!(slot(3).numbers(), [2.5]);
        assert_eq!(slot(4).numbers(), [1.0]);
        assert_eq!(slot(5).texts().collect::<Vec<_>>(), ["a", "b"]);
        for absent in [6, 7, 8, 11] {
            assert!(!slot(absent).present(), "{}", paths[absent]);
        }
        let p = slot(9).numbers();
        assert!(p[0] == 1.0 && p[1].is_nan() && p[2] == 3.0);
        assert_eq!(slot(10).numbers(), [3.0]);
        assert_eq!(slot(12).numbers(), [7.0]);
    }

    #[test]
    fn what_does_not_fit_is_an_error_that_names_the_path() {
        for (text, path, part) in [
            ("{\"a\": [1, \"x\"]}", "a", "mixed"),
            ("{\"a\": {\"b\": 1}}", "a", "a: an object is no value"),
            ("{\"a\": 1}", "a.b", "a number on the way"),
            ("{\"a\": [[1]]}", "a", "an array is no value"),
            ("{\"a\": 9007199254740993}", "a", "2^53"),
            ("{\"a\": NaN}", "a", "not JSON"),
            ("{\"a\": 1", "a", "not JSON"),
        ] {
            let error = extract_paths(text, &[path]).unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
        let deep = "[".repeat(100_000);
        assert!(decode(deep.as_bytes()).is_err());
    }

    #[test]
    fn a_schema_describes_the_fields() {
        let schema = br#"{"type": "object", "properties": {
            "t": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
            "q": {"type": "array", "items": {"type": "number"}, "minItems": 6, "maxItems": 6},
            "n": {"type": ["null", "integer"]}, "any": {}, "a.b": {"type": "number"},
            "joints": {"type": "array", "items": {"type": "object", "properties": {"p": {"type": "number"}}}}}}"#;
        let found = JsonType::new(schema).describe();
        let found: Vec<_> = found
            .into_iter()
            .map(|f| (f.path, f.kind, f.length))
            .collect();
        let number = FieldKind::Number(DataType::Float64);
        let any = FieldLength::Variable { max: None };
        let expected = [
            ("t", FieldKind::Time, FieldLength::One),
            ("q", number.clone(), FieldLength::Fixed(6)),
            ("n", FieldKind::Number(DataType::Int64), FieldLength::One),
            ("any", FieldKind::Any, FieldLength::One),
            ("joints[].p", number, any),
        ];
        assert_eq!(
            found,
            expected.map(|(path, kind, length)| (path.to_owned(), kind, length))
        );
        assert_eq!(JsonType::new(b"no schema").describe(), []);
    }
}
