//! Figures, as SVG: the same data gives the same bytes.

mod chart;
pub mod curve;
pub mod lines;
mod panel;
pub mod paths;
mod scale;
pub mod search;

pub use scale::Palettes;

use svg::Document;
use svg::node::element::{Rectangle, Text};

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

/// A white page of so many pixels with a heading.
fn document([width, height]: [f64; 2], heading: &str) -> Document {
    let (width, height) = (px(width), px(height));
    let background = Rectangle::new()
        .set("width", width)
        .set("height", height)
        .set("fill", "#fff");
    Document::new()
        .set("width", width)
        .set("height", height)
        .set("viewBox", (0, 0, width, height))
        .set("font-family", "sans-serif")
        .add(background)
        .add(text(heading, [10.0, 20.0], 14.0, "start"))
}
