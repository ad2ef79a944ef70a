//! Curves: numbers over updates, or over a setting, one panel below the other.

use svg::node::element::Group;

use super::chart::{self, Chart, Series, Stroke};
use super::{document, px};

/// Pixels of a panel's plot, and above all panels.
const SIZE: [f64; 2] = [520.0, 150.0];
const HEAD: f64 = 26.0;

/// How a quantity lies along its axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// Equal distances are equal differences.
    Linear,
    /// Equal distances are equal factors; all numbers must be above 0.
    Logarithmic,
}

impl Scale {
    /// Whether a number has a place on it.
    pub(super) fn holds(self, value: f64) -> bool {
        value.is_finite() && (self == Self::Linear || value > 0.0)
    }
}

/// Where the points of all panels lie from left to right.
#[derive(Debug, Clone, PartialEq)]
pub enum Across<'a> {
    /// Numbers, such as updates, from the smallest to the largest.
    Numbers,
    /// Equal steps with a name each; x counts from 0.
    Names(&'a [String]),
}

/// A point of a curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Place from left to right.
    pub x: f64,
    /// Value.
    pub y: f64,
    /// `[low, high]` around the value.
    pub interval: Option<[f64; 2]>,
}

/// A curve with its axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// What it is.
    pub title: String,
    /// How values lie.
    pub scale: Scale,
    /// At least one.
    pub points: Vec<Point>,
}

/// Why curves cannot be drawn.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CurveError {
    /// Nothing to draw.
    #[error("there is nothing to draw")]
    Empty,
    /// A number that has no place.
    #[error("\"{title}\", point {point}: {value} has no place on its axis")]
    Value {
        /// The curve.
        title: String,
        /// Number of the point, from 0.
        point: usize,
        /// Its value.
        value: String,
    },
}

/// Draws curves below each other, as an SVG document.
///
/// # Errors
/// No curve, a curve without points, or numbers that are not finite or, on a logarithmic axis, not above 0.
pub fn draw(
    heading: &str,
    x_label: &str,
    across: &Across<'_>,
    curves: &[Curve],
) -> Result<String, CurveError> {
    if curves.is_empty() || curves.iter().any(|curve| curve.points.is_empty()) {
        return Err(CurveError::Empty);
    }
    for curve in curves {
        check(curve)?;
    }
    let xs = curves.iter().flat_map(|curve| &curve.points).map(|p| p.x);
    let across = match across {
        Across::Numbers => chart::Across::Numbers {
            scale: Scale::Linear,
            // All panels have the same.
            ends: Some([
                xs.clone().fold(f64::INFINITY, f64::min),
                xs.fold(f64::NEG_INFINITY, f64::max),
            ]),
        },
        Across::Names(names) => chart::Across::Names(names.to_vec()),
    };
    let charts: Vec<Chart> = curves
        .iter()
        .map(|curve| chart(curve, &across, x_label))
        .collect();
    let [width, panel_height] = charts[0].outer_size();
    let mut panels = Group::new();
    for (place, chart) in charts.iter().enumerate() {
        let at = format!("translate(0 {})", px(HEAD + panel_height * place as f64));
        panels = panels.add(chart.draw().set("transform", at));
    }
    let height = HEAD + panel_height * charts.len() as f64;
    let document = document([width, height], heading).add(panels);
    Ok(format!("{document}\n"))
}

/// A panel of one curve.
fn chart(curve: &Curve, across: &chart::Across, x_label: &str) -> Chart {
    let stroke = match across {
        chart::Across::Numbers { .. } => Stroke::Plain,
        chart::Across::Names(_) => Stroke::Dotted,
    };
    Chart {
        title: curve.title.clone(),
        x_label: x_label.to_owned(),
        across: across.clone(),
        y_label: "",
        y_scale: curve.scale,
        mark: None,
        series: vec![Series {
            name: String::new(),
            color: 0,
            stroke,
            points: curve.points.clone(),
        }],
        size: SIZE,
    }
}

fn check(curve: &Curve) -> Result<(), CurveError> {
    for (number, point) in curve.points.iter().enumerate() {
        let interval = point.interval.into_iter().flatten();
        let wrong = [point.y]
            .into_iter()
            .chain(interval)
            .find(|value| !curve.scale.holds(*value));
        let wrong = wrong.or((!point.x.is_finite()).then_some(point.x));
        if let Some(value) = wrong {
            return Err(CurveError::Value {
                title: curve.title.clone(),
                point: number,
                value: value.to_string(),
            });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(title: &str, scale: Scale, values: &[f64]) -> Curve {
        let points = values.iter().enumerate().map(|(x, y)| Point {
            x: x as f64,
            y: *y,
            interval: None,
        });
        Curve {
            title: title.to_owned(),
            scale,
            points: points.collect(),
        }
    }

    #[test]
    fn values_lie_where_their_axis_says() {
        let curves = [curve("loss", Scale::Logarithmic, &[100.0, 10.0, 1.0])];
        let svg = draw("", "update", &Across::Numbers, &curves).unwrap();
        // Equal factors are equal distances.
        assert!(
            svg.contains("M85.86 40.63L318.00 109.00L550.14 177.37"),
            "{svg}"
        );
        let curves = [curve("rate", Scale::Linear, &[0.0, 2.0, 1.0])];
        let svg = draw("", "update", &Across::Numbers, &curves).unwrap();
        assert!(
            svg.contains("M85.86 175.96L318.00 42.04L550.14 109.00"),
            "{svg}"
        );
    }

    #[test]
    fn names_stand_below_their_points_and_intervals_are_drawn() {
        let names = ["0".to_owned(), "1e3".to_owned()];
        let mut one = curve("K-Sim <1>", Scale::Linear, &[0.5, 0.5]);
        one.points[1].interval = Some([0.25, 0.75]);
        let svg = draw("λ", "λ", &Across::Names(&names), &[one.clone(), one]).unwrap();
        assert_eq!(svg.matches("<circle").count(), 4);
        assert!(
            svg.contains("1e3") && svg.contains("K-Sim &lt;1&gt;"),
            "{svg}"
        );
        // At three quarters of the width, almost from the bottom to the top.
        assert!(
            svg.contains(r#"x1="448" x2="448" y1="175.96" y2="42.04""#),
            "{svg}"
        );
    }

    #[test]
    fn what_cannot_be_drawn_is_an_error() {
        let draw = |curves: &[Curve]| draw("", "", &Across::Numbers, curves);
        assert_eq!(draw(&[]), Err(CurveError::Empty));
        assert_eq!(
            draw(&[curve("a", Scale::Linear, &[])]),
            Err(CurveError::Empty)
        );
        for (scale, value) in [(Scale::Linear, f64::NAN), (Scale::Logarithmic, 0.0)] {
            let error = draw(&[curve("a", scale, &[1.0, value])]).unwrap_err();
            assert!(error.to_string().contains("\"a\", point 1"), "{error}");
        }
        // One value, and one that does not change.
        draw(&[curve("a", Scale::Logarithmic, &[3.0])]).unwrap();
        draw(&[curve("a", Scale::Linear, &[0.0, 0.0])]).unwrap();
    }
}
