//! Curves: numbers over updates, or over a setting, one panel below the other.

use svg::Document;
use svg::node::element::{Circle, Group, Line, Path, Rectangle};

use super::scale::ticks;
use super::{px, text};

/// Pixels of a panel's plot, of what surrounds it, and above all panels.
const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 150.0;
const LEFT: f64 = 76.0;
const RIGHT: f64 = 18.0;
const TOP: f64 = 24.0;
const BOTTOM: f64 = 40.0;
const HEAD: f64 = 30.0;
/// Dark blue, for the curve.
const COLOR: &str = "#1f4e79";

/// How a quantity lies along its axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// Equal distances are equal differences.
    Linear,
    /// Equal distances are equal factors; all numbers must be above 0.
    Logarithmic,
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
    let x_axis = Axis::across(across, curves);
    let panel_height = TOP + HEIGHT + BOTTOM;
    let size = [
        LEFT + WIDTH + RIGHT,
        HEAD + panel_height * curves.len() as f64,
    ];
    let mut document = Document::new()
        .set("width", px(size[0]))
        .set("height", px(size[1]))
        .set("viewBox", (0, 0, px(size[0]), px(size[1])))
        .set("font-family", "sans-serif")
        .add(
            Rectangle::new()
                .set("width", px(size[0]))
                .set("height", px(size[1]))
                .set("fill", "#fff"),
        )
        .add(text(heading, [10.0, 20.0], 14.0, "start"));
    for (number, curve) in curves.iter().enumerate() {
        let y = HEAD + panel_height * number as f64;
        let panel = panel(curve, &x_axis, across, x_label);
        document = document.add(panel.set("transform", format!("translate(0 {})", px(y))));
    }
    Ok(format!("{document}\n"))
}

fn check(curve: &Curve) -> Result<(), CurveError> {
    let fits = |value: f64| value.is_finite() && (curve.scale == Scale::Linear || value > 0.0);
    for (number, point) in curve.points.iter().enumerate() {
        let interval = point.interval.into_iter().flatten();
        let wrong = [point.y]
            .into_iter()
            .chain(interval)
            .find(|value| !fits(*value));
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

/// A range of numbers along some pixels.
#[derive(Debug, Clone, Copy)]
struct Axis {
    low: f64,
    high: f64,
    scale: Scale,
}

impl Axis {
    fn new(values: impl Iterator<Item = f64> + Clone, scale: Scale) -> Self {
        let low = values.clone().fold(f64::INFINITY, f64::min);
        let high = values.fold(f64::NEG_INFINITY, f64::max);
        // A curve that does not change lies in the middle.
        let (low, high) = match (high > low, scale) {
            (true, _) => (low, high),
            (false, Scale::Linear) => (low - 0.5, high + 0.5),
            (false, Scale::Logarithmic) => (low / 2.0, high * 2.0),
        };
        Self { low, high, scale }
    }

    fn across(across: &Across<'_>, curves: &[Curve]) -> Self {
        match across {
            Across::Numbers => {
                let points = curves.iter().flat_map(|curve| &curve.points);
                Self::new(points.map(|point| point.x), Scale::Linear)
            }
            Across::Names(names) => Self {
                low: -0.5,
                high: names.len().max(1) as f64 - 0.5,
                scale: Scale::Linear,
            },
        }
    }

    /// Share of the way from low to high.
    fn share(&self, value: f64) -> f64 {
        let of = |value: f64| match self.scale {
            Scale::Linear => value,
            Scale::Logarithmic => value.log10(),
        };
        (of(value) - of(self.low)) / (of(self.high) - of(self.low))
    }

    /// Round numbers within.
    fn ticks(&self) -> Vec<f64> {
        let powers = || {
            let first = self.low.log10().ceil() as i32;
            let last = self.high.log10().floor() as i32;
            (first..=last)
                .map(|power| 10f64.powi(power))
                .collect::<Vec<_>>()
        };
        match self.scale {
            Scale::Logarithmic if powers().len() > 1 => powers(),
            _ => ticks(self.low, self.high, 4),
        }
    }
}

fn panel(curve: &Curve, x_axis: &Axis, across: &Across<'_>, x_label: &str) -> Group {
    let values = curve.points.iter().flat_map(|point| {
        let [low, high] = point.interval.unwrap_or([point.y; 2]);
        [point.y, low, high]
    });
    let y_axis = Axis::new(values, curve.scale);
    let at = |x: f64, y: f64| {
        [
            LEFT + WIDTH * x_axis.share(x),
            TOP + HEIGHT * (1.0 - y_axis.share(y)),
        ]
    };
    let mut group = Group::new()
        .add(text(&curve.title, [LEFT, TOP - 8.0], 12.0, "start").set("font-weight", "bold"))
        .add(frame());
    for tick in y_axis.ticks() {
        let [_, y] = at(x_axis.low, tick);
        group = group
            .add(line([LEFT, y], [LEFT + WIDTH, y], "#ddd"))
            .add(text(&number(tick), [LEFT - 6.0, y + 3.5], 10.0, "end"));
    }
    let marks: Vec<(f64, String)> = match across {
        Across::Numbers => x_axis.ticks().into_iter().map(|x| (x, number(x))).collect(),
        Across::Names(names) => {
            let names = names.iter().enumerate();
            names
                .map(|(place, name)| (place as f64, name.clone()))
                .collect()
        }
    };
    let bottom = TOP + HEIGHT;
    for (x, name) in marks {
        let [x, _] = at(x, y_axis.low);
        group = group
            .add(line([x, bottom], [x, bottom + 4.0], "#222"))
            .add(text(&name, [x, bottom + 15.0], 10.0, "middle"));
    }
    group = group.add(text(
        x_label,
        [LEFT + WIDTH / 2.0, bottom + 30.0],
        11.0,
        "middle",
    ));
    group.add(data(curve, at, matches!(across, Across::Names(_))))
}

fn frame() -> Rectangle {
    Rectangle::new()
        .set("x", LEFT)
        .set("y", TOP)
        .set("width", WIDTH)
        .set("height", HEIGHT)
        .set("fill", "none")
        .set("stroke", "#222")
}

fn line([x1, y1]: [f64; 2], [x2, y2]: [f64; 2], color: &str) -> Line {
    Line::new()
        .set("x1", px(x1))
        .set("y1", px(y1))
        .set("x2", px(x2))
        .set("y2", px(y2))
        .set("stroke", color)
}

/// The curve, with its intervals, and a dot for every point where there are few.
fn data(curve: &Curve, at: impl Fn(f64, f64) -> [f64; 2], has_dots: bool) -> Group {
    let mut way = String::new();
    let mut group = Group::new();
    for (number, point) in curve.points.iter().enumerate() {
        let [x, y] = at(point.x, point.y);
        way += &format!("{}{x:.2} {y:.2}", if number == 0 { "M" } else { "L" });
        if let Some([low, high]) = point.interval {
            group = group.add(line(at(point.x, low), at(point.x, high), COLOR));
        }
        if has_dots {
            let dot = Circle::new()
                .set("cx", px(x))
                .set("cy", px(y))
                .set("r", 3.0);
            group = group.add(dot.set("fill", COLOR));
        }
    }
    let path = Path::new()
        .set("d", way)
        .set("fill", "none")
        .set("stroke", COLOR)
        .set("stroke-width", 1.6)
        .set("stroke-linejoin", "round");
    group.add(path)
}

/// A number as it is read best.
fn number(value: f64) -> String {
    match value.abs() {
        0.0 => "0".to_owned(),
        1e-3..1e5 => value.to_string(),
        _ => format!("{value:e}"),
    }
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
        // Equal factors: top, middle and bottom of the panel.
        assert!(
            svg.contains("M76.00 24.00L336.00 99.00L596.00 174.00"),
            "{svg}"
        );
        let curves = [curve("rate", Scale::Linear, &[0.0, 2.0, 1.0])];
        let svg = draw("", "update", &Across::Numbers, &curves).unwrap();
        assert!(
            svg.contains("M76.00 174.00L336.00 24.00L596.00 99.00"),
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
        // A quarter and three quarters of the width; from the top to the bottom.
        assert!(
            svg.contains(r#"x1="466" x2="466" y1="174" y2="24""#),
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
