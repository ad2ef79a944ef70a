//! Several lines over numbers, one panel below the other.

use svg::node::element::Group;

use super::chart::{Across, Chart, Series, Stroke};
use super::curve::{Point, Scale};
use super::{document, px};

/// Pixels of a panel's plot, and above all panels.
const SIZE: [f64; 2] = [460.0, 190.0];
const HEAD: f64 = 26.0;
/// The color of what others are compared with: the last of the palette.
const DARK: usize = 6;
/// Lines of a panel, beside dashed ones, that have a color each.
pub const MAX_LINES: usize = DARK;

/// A panel of lines.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// What it shows.
    pub title: String,
    /// What lies from left to right.
    pub x_label: String,
    /// What lies from bottom to top.
    pub y_label: &'static str,
    /// A number of the x axis to mark, and its name.
    pub mark: Option<(f64, String)>,
    /// Its lines, in the order of their colors; dashed ones are dark.
    pub lines: Vec<Line>,
}

/// A line.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Its name, beside its end.
    pub name: String,
    /// Whether it is what the others are compared with.
    pub is_dashed: bool,
    /// Its points (x, y), from left to right; those that are not finite are left out.
    pub points: Vec<[f64; 2]>,
}

/// Draws panels below each other, as an SVG document. `None` if there are none, or no points in one of them.
pub fn draw(heading: &str, panels: &[Panel]) -> Option<String> {
    let is_empty = |panel: &Panel| panel.lines.iter().all(|line| line.points.is_empty());
    if panels.is_empty() || panels.iter().any(is_empty) {
        return None;
    }
    let charts: Vec<Chart> = panels.iter().map(chart).collect();
    let panel_height = charts[0].outer_size()[1];
    let widths = charts.iter().map(|chart| chart.outer_size()[0]);
    let width = widths.fold(0.0, f64::max);
    let mut group = Group::new();
    for (place, chart) in charts.iter().enumerate() {
        let at = format!("translate(0 {})", px(HEAD + panel_height * place as f64));
        group = group.add(chart.draw().set("transform", at));
    }
    let height = HEAD + panel_height * charts.len() as f64;
    let document = document([width, height], heading).add(group);
    Some(format!("{document}\n"))
}

fn chart(panel: &Panel) -> Chart {
    let series = panel.lines.iter().enumerate().map(|(place, line)| Series {
        name: line.name.clone(),
        color: if line.is_dashed { DARK } else { place },
        stroke: match line.is_dashed {
            true => Stroke::Dashed,
            false => Stroke::Plain,
        },
        points: line
            .points
            .iter()
            .map(|&[x, y]| Point {
                x,
                y,
                interval: None,
            })
            .collect(),
    });
    Chart {
        title: panel.title.clone(),
        x_label: panel.x_label.clone(),
        across: Across::Numbers {
            scale: Scale::Linear,
            ends: None,
        },
        y_label: panel.y_label,
        y_scale: Scale::Linear,
        mark: panel.mark.clone(),
        series: series.collect(),
        size: SIZE,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panels_have_their_lines_and_the_same_bytes_every_time() {
        let line = |name: &str, is_dashed| Line {
            name: name.to_owned(),
            is_dashed,
            points: vec![[0.0, 0.5], [1.0, 1.0]],
        };
        let panel = Panel {
            title: "a<b".to_owned(),
            x_label: "step".to_owned(),
            y_label: "K-Sim",
            mark: Some((0.25, "γ".to_owned())),
            lines: vec![line("one", false), line("held out", true)],
        };
        let svg = draw("", &[panel.clone(), panel.clone()]).unwrap();
        assert_eq!(draw("", &[panel.clone(), panel.clone()]), Some(svg.clone()));
        assert_eq!(svg.matches("stroke-dasharray=\"5 4\"").count(), 2);
        // A quarter of the way between the points, which are 6 % of it inside.
        assert_eq!(
            svg.matches("x1=\"185.32\" x2=\"185.32\" y1=\"34\"").count(),
            2,
            "{svg}"
        );
        assert!(svg.contains("a&lt;b") && svg.contains("held out"), "{svg}");
        let empty = Panel {
            lines: Vec::new(),
            ..panel
        };
        assert_eq!((draw("", &[]), draw("", &[empty])), (None, None));
    }
}
