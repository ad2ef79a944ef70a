//! JSON as Python writes it: with the words `NaN`, `Infinity` and `-Infinity`.

use serde_json::Value;

use crate::error::{DatasetError, Result};

/// Parses JSON in which those words may stand for numbers; they become strings of the same name.
///
/// # Errors
/// [`DatasetError::Json`] naming `what`.
pub(crate) fn parse(text: &str, what: &str) -> Result<Value> {
    serde_json::from_str(&quoted(text)).map_err(|source| DatasetError::Json {
        what: what.to_owned(),
        source,
    })
}

/// JSON as Python writes it: strings that [`parse`] makes of the words are the words again.
pub(crate) fn write(value: &Value) -> String {
    let mut text = String::new();
    append(value, &mut text);
    text
}

fn append(value: &Value, text: &mut String) {
    let mut list = |open, close, items: &mut dyn Iterator<Item = (Option<&String>, &Value)>| {
        text.push(open);
        for (place, (key, item)) in items.enumerate() {
            if place > 0 {
                text.push_str(", ");
            }
            if let Some(key) = key {
                text.push_str(&Value::from(key.as_str()).to_string());
                text.push_str(": ");
            }
            append(item, text);
        }
        text.push(close);
    };
    match value {
        Value::Array(items) => list('[', ']', &mut items.iter().map(|item| (None, item))),
        Value::Object(fields) => {
            list(
                '{',
                '}',
                &mut fields.iter().map(|(key, item)| (Some(key), item)),
            );
        }
        Value::String(word) if WORDS.contains(&word.as_str()) => text.push_str(word),
        plain => text.push_str(&plain.to_string()),
    }
}

/// Python's words for numbers that JSON has not.
const WORDS: [&str; 3] = ["-Infinity", "Infinity", "NaN"];

/// Puts quotes around the words, outside of strings only.
fn quoted(text: &str) -> String {
    let mut strict = String::with_capacity(text.len() + 64);
    let mut rest = text;
    while !rest.is_empty() {
        if let Some(inside) = rest.strip_prefix('"') {
            let end = end_of_string(inside) + 1;
            strict.push_str(&rest[..end]);
            rest = &rest[end..];
        } else if let Some(word) = WORDS.into_iter().find(|word| rest.starts_with(word)) {
            strict.push('"');
            strict.push_str(word);
            strict.push('"');
            rest = &rest[word.len()..];
        } else {
            let plain = rest.find(['"', '-', 'I', 'N']).unwrap_or(rest.len());
            // A minus or letter that starts no word is one plain character.
            let plain = if plain == 0 {
                rest.chars().next().map_or(0, char::len_utf8)
            } else {
                plain
            };
            strict.push_str(&rest[..plain]);
            rest = &rest[plain..];
        }
    }
    strict
}

/// Length of the string and its closing quote; the whole rest if it never closes.
fn end_of_string(inside: &str) -> usize {
    let mut escaped = false;
    for (at, byte) in inside.bytes().enumerate() {
        match byte {
            _ if escaped => escaped = false,
            b'\\' => escaped = true,
            b'"' => return at + 1,
            _ => {}
        }
    }
    inside.len()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    #[test]
    fn pythons_words_become_strings_outside_of_strings_only() {
        let text =
            r#"{"low": [-Infinity, Infinity, NaN, -1.5], "text": "NaN \" Infinity", "n": null}"#;
        let value = parse(text, "x").unwrap();
        let low = json!(["-Infinity", "Infinity", "NaN", -1.5]);
        assert_eq!(
            value,
            json!({"low": low, "text": "NaN \" Infinity", "n": null})
        );
    }

    #[test]
    fn what_is_written_is_read_again() {
        let text = r#"{"a\"b": [-Infinity, NaN, 1.5], "n": null, "t": "Infinity?"}"#;
        assert_eq!(write(&parse(text, "x").unwrap()), text);
    }

    #[test]
    fn other_words_and_open_strings_stay_errors() {
        for bad in ["[Nan]", "[-]", "\"abc", "{", "", "[Infinit]", "\u{e9}"] {
            assert!(
                matches!(parse(bad, "x"), Err(DatasetError::Json { .. })),
                "{bad}"
            );
        }
    }

    proptest! {
        #[test]
        fn strict_json_is_left_alone(text in "[\\PC\"\\\\NI-]{0,40}") {
            let strict = serde_json::to_string(&text).unwrap();
            prop_assert_eq!(parse(&strict, "x").unwrap(), json!(text));
            let _ = parse(&text, "x");
        }
    }
}
