//! The document around the data.

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use sha2::{Digest as _, Sha256};

use serde_json::Value;

use super::data::Page;

const TEMPLATE: &str = include_str!("../../assets/page/page.html");
/// The charting library with its license, and its style.
const LIBRARY_LICENSE: &str = include_str!("../../assets/vendor/uplot-1.6.32/LICENSE");
const LIBRARY: &str = include_str!("../../assets/vendor/uplot-1.6.32/uPlot.iife.min.js");
const LIBRARY_STYLE: &str = include_str!("../../assets/vendor/uplot-1.6.32/uPlot.min.css");
const STYLE: &str = include_str!("../../assets/page/page.css");
/// Our own scripts, in the order in which they run.
const SCRIPTS: [&str; 8] = [
    include_str!("../../assets/page/js/1-format.js"),
    include_str!("../../assets/page/js/2-data.js"),
    include_str!("../../assets/page/js/3-theme.js"),
    include_str!("../../assets/page/js/4-tables.js"),
    include_str!("../../assets/page/js/5-charts.js"),
    include_str!("../../assets/page/js/6-overview.js"),
    include_str!("../../assets/page/js/7-map.js"),
    include_str!("../../assets/page/js/8-main.js"),
];

/// The page as one HTML document.
///
/// Names from files are in its title, escaped, and in the data, in which every `<` is written `\u003c`; the scripts put
/// them into the page as text. Should anything else ever get through, the policy of the page lets no script run but
/// the one whose hash it has, and lets nothing be loaded.
///
/// # Errors
/// Data that cannot be written as JSON.
pub fn html(page: &Page) -> Result<String, serde_json::Error> {
    let style = format!("{LIBRARY_STYLE}\n{STYLE}");
    let script = format!(
        "/*\n{LIBRARY_LICENSE}*/\n{LIBRARY}\n(() => {{\n\"use strict\";\n{}}})();\n",
        SCRIPTS.join("\n")
    );
    let policy = format!(
        "default-src 'none'; script-src {}; style-src {}; img-src data:; base-uri 'none'; form-action 'none'",
        hash(&script),
        hash(&style)
    );
    let mut data = serde_json::to_value(page)?;
    spell_out(&mut data);
    let data = data.to_string().replace('<', "\\u003c");
    let generator = format!("ksim {}", env!("CARGO_PKG_VERSION"));
    let parts = [
        ("policy", policy),
        ("generator", generator),
        ("title", escaped(&page.title)),
        ("style", style),
        ("data", data),
        ("script", script),
    ];
    Ok(filled(TEMPLATE, &parts))
}

/// Makes text of whole numbers that a script would round.
fn spell_out(value: &mut Value) {
    const EXACT: u64 = 1 << 53;
    match value {
        Value::Number(number) => {
            let signed = number.as_i64().map(i64::unsigned_abs);
            if signed.or(number.as_u64()).is_some_and(|size| size > EXACT) {
                *value = Value::String(number.to_string());
            }
        }
        Value::Array(values) => values.iter_mut().for_each(spell_out),
        Value::Object(fields) => fields.values_mut().for_each(spell_out),
        _ => {}
    }
}

/// The template with its `{{name}}`s replaced, once: what is filled in is not looked at again.
fn filled(template: &str, parts: &[(&str, String)]) -> String {
    let mut html = String::new();
    let mut rest = template;
    while let Some((before, after)) = rest.split_once("{{") {
        html.push_str(before);
        let (name, after) = after.split_once("}}").unwrap_or((after, ""));
        let part = parts.iter().find(|(own, _)| *own == name);
        html.push_str(part.map_or("", |(_, text)| text));
        rest = after;
    }
    html.push_str(rest);
    html
}

/// A source of a content security policy: exactly this text.
fn hash(text: &str) -> String {
    let digest = Sha256::digest(text.as_bytes());
    format!("'sha256-{}'", BASE64_STANDARD.encode(digest))
}

/// Text for HTML. Control characters, which it does not allow, become U+FFFD.
fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            c if c.is_control() => safe.push('\u{fffd}'),
            c => safe.push(c),
        }
    }
    safe
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_filled_in_once() {
        let parts = [("a", "{{b}}".to_owned()), ("b", "x".to_owned())];
        assert_eq!(filled("<{{a}}|{{b}}|{{c}}>", &parts), "<{{b}}|x|>");
    }

    #[test]
    fn no_script_ends_its_own_element_and_none_of_the_assets_names_another_place() {
        for text in SCRIPTS.into_iter().chain([LIBRARY, STYLE, LIBRARY_STYLE]) {
            let lower = text.to_lowercase();
            assert!(!lower.contains("</script") && !lower.contains("</style"));
            assert!(!lower.contains("@import") && !lower.contains("url("));
        }
    }

    #[test]
    fn whole_numbers_keep_all_their_digits() {
        let mut data = serde_json::json!({"a": [1u64 << 53, (1u64 << 53) + 1, -9007199254740993i64, u64::MAX, 1e300]});
        spell_out(&mut data);
        let expected = serde_json::json!({
            "a": [1u64 << 53, "9007199254740993", "-9007199254740993", "18446744073709551615", 1e300]
        });
        assert_eq!(data, expected);
    }

    #[test]
    fn titles_are_text() {
        assert_eq!(escaped("<b>&\"\u{7}"), "&lt;b&gt;&amp;&quot;\u{fffd}");
    }
}
