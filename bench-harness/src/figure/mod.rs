//! Figures, as SVG: the same data gives the same bytes.

mod chart;
pub mod curve;
mod panel;
pub mod paths;
mod scale;
pub mod search;

use svg::node::element::Text;

/// Pixels as they are written: to two decimals, so that the last bits of a float do not show.
fn px(value: f64) -> f64 {
    // Adding 0 turns -0 into 0.
    (value * 100.0).round() / 100.0 + 0.0
}

/// A line of text. Control characters, which XML does not allow, become U+FFFD.
fn text(content: &str, [x, y]: [f64; 2], size: f64, anchor: &str) -> Text {
    let clean: String = content
        .chars()
        .map(|c| if c.is_control() { '\u{fffd}' } else { c })
        .collect();
    Text::new(clean)
        .set("x", px(x))
        .set("y", px(y))
        .set("font-size", size)
        .set("text-anchor", anchor)
        .set("fill", "#222")
}
