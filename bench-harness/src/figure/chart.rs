//! One panel of lines over numbers: axes, intervals, and names beside the lines.

use svg::node::element::{Circle, Group, Line, Path};

use super::curve::{Point, Scale};
use super::scale::ticks;
use super::{px, text};

/// Pixels left of the lines, above, and below.
const LEFT: f64 = 58.0;
const TOP: f64 = 34.0;
const BOTTOM: f64 = 40.0;
/// Room right of the lines, and for their names if they have some: as much as these need, within bounds.
const RIGHT: f64 = 18.0;
const NAMES: [f64; 2] = [150.0, 300.0];
/// Pixels left and right of a name.
const BESIDE: [f64; 2] = [8.0, 6.0];
/// Pixels between two names, at least.
const NAME_STEP: f64 = 12.0;

/// Told apart by any eyes: the palette of Okabe and Ito.
const COLORS: [&str; 7] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#222222",
];

/// A line.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Series {
    /// What it is; empty if its panel says so.
    pub(super) name: String,
    /// Which color; lines that belong together share one.
    pub(super) color: usize,
    pub(super) stroke: Stroke,
    pub(super) points: Vec<Point>,
}

/// How a line is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stroke {
    Plain,
    /// With a dot at every point.
    Dotted,
    Dashed,
}

/// What lies from left to right.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Across {
    Numbers {
        scale: Scale,
        /// What the axis holds beside the points.
        ends: Option<[f64; 2]>,
    },
    /// Equal steps with a name each; x counts from 0.
    Names(Vec<String>),
}

/// A panel.
#[derive(Debug, Clone)]
pub(super) struct Chart {
    pub(super) title: String,
    pub(super) x_label: String,
    pub(super) across: Across,
    pub(super) y_label: &'static str,
    pub(super) y_scale: Scale,
    /// A number to mark across, and its name.
    pub(super) mark: Option<(f64, String)>,
    pub(super) series: Vec<Series>,
    /// Pixels of the part with the lines.
    pub(super) size: [f64; 2],
}

/// An axis with its range in pixels.
struct Axis {
    scale: Scale,
    low: f64,
    high: f64,
    pixels: [f64; 2],
}

impl Axis {
    /// Of numbers that it is to hold; what has no place on it does not count.
    fn new(scale: Scale, values: impl Iterator<Item = f64>, pixels: [f64; 2]) -> Self {
        let fits = |v: &f64| scale.holds(*v);
        let (low, high) = values
            .filter(fits)
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                (low.min(v), high.max(v))
            });
        let (low, high) = match (low <= high, scale) {
            (false, _) => (1.0, 10.0),
            (true, Scale::Logarithmic) => (low / 1.25, high * 1.25),
            (true, Scale::Linear) => {
                let margin = ((high - low) * 0.06).max(high.abs().max(1.0) * 1e-3);
                (low - margin, high + margin)
            }
        };
        Self {
            scale,
            low,
            high,
            pixels,
        }
    }

    fn at(&self, value: f64) -> Option<f64> {
        let place = |v: f64| match self.scale {
            Scale::Linear => v,
            Scale::Logarithmic => v.ln(),
        };
        let share = (place(value) - place(self.low)) / (place(self.high) - place(self.low));
        let at = self.pixels[0] + share * (self.pixels[1] - self.pixels[0]);
        at.is_finite().then_some(at)
    }

    /// Numbers to write, the least and the greatest of which are inside.
    fn ticks(&self) -> Vec<f64> {
        if self.scale == Scale::Linear {
            return ticks(self.low, self.high, 5);
        }
        let decades = (self.high / self.low).log10();
        let factors: &[f64] = match decades {
            d if d > 2.5 => &[1.0],
            d if d > 1.2 => &[1.0, 3.0],
            _ => &[1.0, 2.0, 5.0],
        };
        let first = self.low.log10().floor() as i32;
        (first..=first + decades.ceil() as i32 + 1)
            .flat_map(|power| factors.iter().map(move |factor| factor * 10f64.powi(power)))
            .filter(|tick| (self.low..=self.high).contains(tick))
            .collect()
    }
}

/// A number as short as it is exact enough to read.
fn number(value: f64) -> String {
    let size = value.abs();
    match value {
        0.0 => "0".to_owned(),
        _ if !(1e-3..1e5).contains(&size) => {
            let power = size.log10().floor() as i32;
            let factor = value / 10f64.powi(power);
            format!("{}e{power}", (factor * 10.0).round() / 10.0)
        }
        _ => format!("{}", (value * 1e4).round() / 1e4),
    }
}

impl Chart {
    /// Pixels of the whole panel.
    pub(super) fn outer_size(&self) -> [f64; 2] {
        let names = self.series.iter().filter(|series| !series.name.is_empty());
        let widest = names
            .map(|series| text_width(&series.name))
            .reduce(f64::max);
        let right = widest.map_or(RIGHT, |widest| {
            (widest + BESIDE[0] + BESIDE[1]).clamp(NAMES[0], NAMES[1])
        });
        [LEFT + self.size[0] + right, TOP + self.size[1] + BOTTOM]
    }

    /// The panel, its upper left corner at the origin.
    pub(super) fn draw(&self) -> Group {
        let [width, height] = self.size;
        let (right, bottom) = (LEFT + width, TOP + height);
        let points = || self.series.iter().flat_map(|one| &one.points);
        let ys = points().flat_map(|p| [p.y].into_iter().chain(p.interval.into_iter().flatten()));
        let pixels = [LEFT, right];
        let x = match &self.across {
            Across::Numbers { scale, ends } => {
                let xs = points().map(|p| p.x).chain(ends.iter().flatten().copied());
                Axis::new(*scale, xs, pixels)
            }
            Across::Names(names) => Axis {
                scale: Scale::Linear,
                low: -0.5,
                high: names.len().max(1) as f64 - 0.5,
                pixels,
            },
        };
        let y = Axis::new(self.y_scale, ys, [bottom, TOP]);
        let mut group = Group::new()
            .add(text(&self.title, [LEFT, 18.0], 12.0, "start").set("font-weight", "bold"))
            .add(self.frame(&x, &y));
        if let Some((value, name)) = &self.mark
            && let Some(at) = x.at(*value).filter(|at| (LEFT..=right).contains(at))
        {
            let mark = straight([at, TOP], [at, bottom], "#777").set("stroke-dasharray", "2 3");
            let name = text(name, [at + 3.0, TOP + 9.0], 10.0, "start");
            group = group.add(mark).add(name);
        }
        let mut names: Vec<(f64, &Series)> = Vec::new();
        for series in &self.series {
            group = group.add(line(series, &x, &y));
            let end = series.points.last().and_then(|last| y.at(last.y));
            if let Some(at) = end.filter(|_| !series.name.is_empty()) {
                names.push((at, series));
            }
        }
        names.sort_by(|a, b| a.0.total_cmp(&b.0));
        let places = spread(names.iter().map(|(at, _)| *at).collect(), [TOP, bottom]);
        for (at, (_, series)) in places.into_iter().zip(names) {
            let shown = shortened(&series.name, NAMES[1] - BESIDE[0] - BESIDE[1]);
            let name = text(&shown, [right + BESIDE[0], at + 3.5], 10.0, "start");
            group = group.add(name.set("fill", color(series)));
        }
        group
    }

    fn frame(&self, x: &Axis, y: &Axis) -> Group {
        let [right, bottom] = [LEFT + self.size[0], TOP + self.size[1]];
        let mut group = Group::new()
            .add(straight([LEFT, bottom], [right, bottom], "#222"))
            .add(straight([LEFT, TOP], [LEFT, bottom], "#222"));
        let marks: Vec<(f64, String)> = match &self.across {
            Across::Numbers { .. } => x.ticks().into_iter().map(|x| (x, number(x))).collect(),
            Across::Names(names) => (0..).map(f64::from).zip(names.iter().cloned()).collect(),
        };
        for (mark, name) in marks {
            if let Some(at) = x.at(mark) {
                let label = text(&name, [at, bottom + 15.0], 10.0, "middle");
                group = group
                    .add(straight([at, bottom], [at, bottom + 4.0], "#222"))
                    .add(label);
            }
        }
        for tick in y.ticks() {
            if let Some(at) = y.at(tick) {
                let label = text(&number(tick), [LEFT - 7.0, at + 3.5], 10.0, "end");
                group = group
                    .add(straight([LEFT, at], [right, at], "#e4e4e0"))
                    .add(label);
            }
        }
        let (middle, turn) = (f64::midpoint(TOP, bottom), px(f64::midpoint(TOP, bottom)));
        let turn = format!("rotate(-90 14 {turn})");
        let below = [f64::midpoint(LEFT, right), bottom + 31.0];
        group
            .add(text(&self.x_label, below, 11.0, "middle"))
            .add(text(self.y_label, [14.0, middle], 11.0, "middle").set("transform", turn))
    }
}

/// Ascending places of names, moved as little as keeps them apart and between both ends.
fn spread(mut places: Vec<f64>, [top, bottom]: [f64; 2]) -> Vec<f64> {
    let n_gaps = places.len().saturating_sub(1).max(1);
    let step = NAME_STEP.min((bottom - top) / n_gaps as f64);
    let mut least = top;
    for place in &mut places {
        *place = place.max(least);
        least = *place + step;
    }
    let mut most = bottom;
    for place in places.iter_mut().rev() {
        *place = place.min(most);
        most = *place - step;
    }
    places
}

/// Pixels that a name takes at 10 pixels to the em, about: fonts differ, so rather more.
fn text_width(name: &str) -> f64 {
    let width = |c: char| match c {
        'i' | 'j' | 'l' | '.' | ',' | ':' | ';' | '|' | '\'' | ' ' | '-' | '/' | '·' | '…' => {
            4.0
        }
        'm' | 'w' | 'M' | 'W' | '@' | '%' => 10.0,
        'A'..='Z' => 7.5,
        c if c.is_ascii() => 6.5,
        _ => 10.0,
    };
    name.chars().map(width).sum()
}

/// The name, without its middle if it takes more pixels: what tells names apart is mostly at an end.
fn shortened(name: &str, pixels: f64) -> String {
    if text_width(name) <= pixels {
        return name.to_owned();
    }
    let chars: Vec<char> = name.chars().collect();
    let shown = |n: usize| {
        let (front, back) = (n.div_ceil(2), n / 2);
        let ends = chars[..front].iter().chain(['…'].iter());
        ends.chain(&chars[chars.len() - back..]).collect::<String>()
    };
    let fits = |n: &usize| text_width(&shown(*n)) <= pixels;
    shown((0..chars.len()).rev().find(fits).unwrap_or(0))
}

fn color(series: &Series) -> &'static str {
    COLORS[series.color % COLORS.len()]
}

fn line(series: &Series, x: &Axis, y: &Axis) -> Group {
    let mut group = Group::new();
    let mut path = String::new();
    for point in &series.points {
        let (Some(left), Some(top)) = (x.at(point.x), y.at(point.y)) else {
            continue;
        };
        path += &format!(
            "{}{left:.2} {top:.2}",
            if path.is_empty() { "M" } else { "L" }
        );
        if let Some([low, high]) = point.interval.map(|ends| ends.map(|end| y.at(end)))
            && let (Some(low), Some(high)) = (low, high)
        {
            group = group.add(straight([left, low], [left, high], color(series)));
        }
        if series.stroke == Stroke::Dotted {
            let disc = Circle::new()
                .set("cx", px(left))
                .set("cy", px(top))
                .set("r", 2.6);
            group = group.add(disc.set("fill", color(series)));
        }
    }
    let mut stroke = Path::new()
        .set("d", path)
        .set("fill", "none")
        .set("stroke", color(series))
        .set("stroke-width", 1.6)
        .set("stroke-linejoin", "round");
    if series.stroke == Stroke::Dashed {
        stroke = stroke.set("stroke-dasharray", "5 4");
    }
    group.add(stroke)
}

fn straight(from: [f64; 2], to: [f64; 2], color: &str) -> Line {
    Line::new()
        .set("x1", px(from[0]))
        .set("y1", px(from[1]))
        .set("x2", px(to[0]))
        .set("y2", px(to[1]))
        .set("stroke", color)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithmic_ticks_are_round_and_inside() {
        let axis = |values: [f64; 2]| Axis::new(Scale::Logarithmic, values.into_iter(), [0.0, 1.0]);
        assert_eq!(axis([1e4, 1e7]).ticks(), [1e4, 1e5, 1e6, 1e7]);
        assert_eq!(axis([10.0, 60.0]).ticks(), [10.0, 20.0, 50.0]);
        assert_eq!(axis([5.0, 5.0]).ticks(), [5.0]);
    }

    #[test]
    fn names_stay_apart_and_inside() {
        let ends = vec![100.0, 185.0, 188.0, 189.0];
        assert_eq!(spread(ends, [0.0, 190.0]), [100.0, 166.0, 178.0, 190.0]);
        let many = spread(vec![190.0; 39], [0.0, 190.0]);
        assert_eq!((many[0], many[38]), (0.0, 190.0));
        assert!(
            many.windows(2)
                .all(|pair| (pair[1] - pair[0] - 5.0).abs() < 1e-9)
        );
    }

    #[test]
    fn a_long_name_has_more_room_or_keeps_its_ends() {
        let name = "a_rather_long_name_of_rollouts · planner.parquet";
        assert_eq!(shortened(name, 400.0), name);
        let short = shortened(name, 100.0);
        assert!(
            short.starts_with("a_rath") && short.ends_with("arquet"),
            "{short}"
        );
        assert!(text_width(&short) <= 100.0);
        let width = |name: &str| {
            let series = Series {
                name: name.to_owned(),
                color: 0,
                stroke: Stroke::Plain,
                points: Vec::new(),
            };
            let chart = Chart {
                title: String::new(),
                x_label: String::new(),
                across: Across::Names(Vec::new()),
                y_label: "",
                y_scale: Scale::Linear,
                mark: None,
                series: vec![series],
                size: [100.0, 100.0],
            };
            chart.outer_size()[0] - LEFT - 100.0
        };
        assert_eq!([width(""), width("a")], [RIGHT, NAMES[0]]);
        assert!((200.0..NAMES[1]).contains(&width(&name[..39])));
        assert_eq!(width(&name.repeat(3)), NAMES[1]);
    }

    #[test]
    fn numbers_are_short() {
        let shown = [0.0, 0.25, 1e-5, 30_000.0, 1e6, 120.0, -0.03].map(number);
        assert_eq!(shown, ["0", "0.25", "1e-5", "30000", "1e6", "120", "-0.03"]);
    }

    #[test]
    fn what_cannot_be_placed_is_left_out() {
        let axis = Axis::new(
            Scale::Logarithmic,
            [0.0, 1.0, 10.0].into_iter(),
            [0.0, 100.0],
        );
        assert_eq!(axis.at(0.0), None);
        assert!(axis.at(1.0).unwrap() > 0.0);
        let nothing = Axis::new(Scale::Linear, [f64::NAN].into_iter(), [0.0, 100.0]);
        assert_eq!(nothing.at(1.0), Some(0.0));
    }
}
