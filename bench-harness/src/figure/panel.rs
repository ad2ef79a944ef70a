//! One maze with the paths in it.

use ksim_envs::maze::{CELL_SIZE_M, Maze};
use svg::node::element::{Group, Line, Path, Rectangle};

use super::paths::{EpisodePath, disc, stride};
use super::scale::{ColorScale, ticks};
use super::{px, text};

/// Pixels left of the maze, above, right and below.
const LEFT: f64 = 44.0;
const TOP: f64 = 34.0;
const RIGHT: f64 = 12.0;
const BOTTOM: f64 = 38.0;

/// Where meters lie in a panel.
pub(super) struct Frame<'a> {
    maze: &'a Maze,
    /// Pixels of a meter.
    scale: f64,
}

impl<'a> Frame<'a> {
    /// A panel whose maze has a longer side of so many pixels.
    pub(super) fn new(maze: &'a Maze, side: f64) -> Self {
        let [width, height] = size_m(maze);
        let scale = side / width.max(height);
        Self { maze, scale }
    }

    /// Pixels of a panel, margins included.
    pub(super) fn size(&self) -> [f64; 2] {
        let [width, _] = size_m(self.maze);
        [LEFT + width * self.scale + RIGHT, self.bottom() + BOTTOM]
    }

    /// Pixels from the top of a panel to the lower edge of its maze.
    pub(super) fn bottom(&self) -> f64 {
        TOP + self.height()
    }

    /// Pixels of the maze's height.
    pub(super) fn height(&self) -> f64 {
        size_m(self.maze)[1] * self.scale
    }

    /// Pixels of a point in meters.
    fn at(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [width, height] = size_m(self.maze);
        [
            LEFT + (x + width / 2.0) * self.scale,
            TOP + (height / 2.0 - y) * self.scale,
        ]
    }
}

/// Width and height, in meters; the center is the origin.
fn size_m(maze: &Maze) -> [f64; 2] {
    [maze.n_columns(), maze.n_rows()].map(|n| n as f64 * CELL_SIZE_M)
}

/// A place that is marked.
#[derive(Debug, Clone, Copy)]
pub(super) enum Marker {
    /// Of the first observation.
    Start,
    /// Of the last.
    End,
    /// Where the task leads.
    Goal,
}

impl Marker {
    /// The marker around a point in pixels: told apart by form, not only by color.
    pub(super) fn draw(self, [x, y]: [f64; 2]) -> Group {
        let group = Group::new();
        match self {
            Self::Start => group.add(
                disc([x, y], 4.5)
                    .set("fill", "#fff")
                    .set("stroke", "#222")
                    .set("stroke-width", 1.8),
            ),
            Self::End => {
                let (left, right) = (px(x - 4.0), px(x + 4.0));
                let (top, bottom) = (px(y - 4.0), px(y + 4.0));
                let cross = format!("M{left} {top}L{right} {bottom}M{left} {bottom}L{right} {top}");
                [("#fff", 4.5), ("#222", 2.2)]
                    .into_iter()
                    .fold(group, |group, (color, width)| {
                        let line = Path::new().set("d", cross.as_str()).set("stroke", color);
                        group.add(line.set("stroke-width", width))
                    })
            }
            Self::Goal => group.add(
                Path::new()
                    .set("d", star([x, y], 9.0))
                    .set("fill", "#d55e00")
                    .set("stroke", "#fff"),
            ),
        }
    }
}

/// A star with five rays.
fn star([x, y]: [f64; 2], radius: f64) -> String {
    let corner = |i: u32| {
        let angle = f64::from(i) * std::f64::consts::PI / 5.0;
        let radius = if i.is_multiple_of(2) {
            radius
        } else {
            radius * 0.42
        };
        [x + radius * angle.sin(), y - radius * angle.cos()]
    };
    let corners: Vec<[f64; 2]> = (0..10).map(corner).collect();
    format!("{}Z", polyline(&corners))
}

/// A panel's content.
pub(super) struct Panel<'a> {
    title: String,
    note: String,
    episodes: &'a [EpisodePath],
}

impl<'a> Panel<'a> {
    /// One episode.
    pub(super) fn of(episode: &'a EpisodePath) -> Self {
        Self {
            title: episode.title.clone(),
            note: episode.note.clone(),
            episodes: std::slice::from_ref(episode),
        }
    }

    /// Several episodes.
    pub(super) fn together(episodes: &'a [EpisodePath]) -> Self {
        let title = match episodes {
            [one] => one.title.clone(),
            _ => format!("{} episodes", episodes.len()),
        };
        Self {
            title,
            note: String::new(),
            episodes,
        }
    }

    /// The panel, its upper left corner at the origin.
    pub(super) fn draw(&self, frame: &Frame<'_>, scale: &ColorScale) -> Group {
        let mut group = Group::new()
            .add(text(&self.title, [LEFT, 14.0], 12.0, "start").set("font-weight", "bold"))
            .add(text(&self.full_note(), [LEFT, 28.0], 10.0, "start"))
            .add(walls(frame))
            .add(axes(frame));
        for episode in self.episodes {
            group = group.add(path(episode, frame, scale));
        }
        // Above all paths, so that none hides another's goal.
        for episode in self.episodes {
            for &goal in &episode.goals_m {
                group = group.add(Marker::Goal.draw(frame.at(goal)));
            }
            let (first, last) = (episode.positions_m.first(), episode.positions_m.last());
            for (marker, point) in [(Marker::Start, first), (Marker::End, last)] {
                if let Some(&point) = point {
                    group = group.add(marker.draw(frame.at(point)));
                }
            }
        }
        group
    }

    /// The note, and how much of the paths is drawn.
    fn full_note(&self) -> String {
        let strides = self
            .episodes
            .iter()
            .map(|one| stride(one.positions_m.len()));
        match (strides.max().unwrap_or(1), self.note.as_str()) {
            (1, note) => note.to_owned(),
            (n, "") => format!("1 of {n} steps drawn"),
            (n, note) => format!("{note}; 1 of {n} steps drawn"),
        }
    }
}

/// The walls, on a light floor. All walls are one path: no seams show between them.
fn walls(frame: &Frame<'_>) -> Group {
    let [width, height] = size_m(frame.maze).map(|m| m * frame.scale);
    let floor = Rectangle::new()
        .set("x", LEFT)
        .set("y", TOP)
        .set("width", px(width))
        .set("height", px(height))
        .set("fill", "#f4f4f2");
    let side = CELL_SIZE_M * frame.scale;
    let mut walls = String::new();
    for (row, column) in frame.maze.walls() {
        let [x, y] = [LEFT + column as f64 * side, TOP + row as f64 * side];
        walls += &format!("M{x:.2} {y:.2}h{side:.2}v{side:.2}h-{side:.2}Z");
    }
    let walls = Path::new()
        .set("d", walls)
        .set("fill", "#8a8a86")
        .set("stroke", "#8a8a86")
        .set("stroke-width", 0.4);
    Group::new().add(floor).add(walls)
}

/// Frame, ticks and their numbers.
fn axes(frame: &Frame<'_>) -> Group {
    let [width, height] = size_m(frame.maze);
    let (bottom, right) = (frame.bottom(), LEFT + width * frame.scale);
    let line = |from: [f64; 2], to: [f64; 2]| {
        Line::new()
            .set("x1", px(from[0]))
            .set("y1", px(from[1]))
            .set("x2", px(to[0]))
            .set("y2", px(to[1]))
            .set("stroke", "#222")
    };
    let mut group = Group::new()
        .add(line([LEFT, bottom], [right, bottom]))
        .add(line([LEFT, TOP], [LEFT, bottom]));
    for tick in ticks(-width / 2.0, width / 2.0, 5) {
        let [x, _] = frame.at([tick, 0.0]);
        group = group.add(line([x, bottom], [x, bottom + 4.0])).add(text(
            &tick.to_string(),
            [x, bottom + 15.0],
            10.0,
            "middle",
        ));
    }
    for tick in ticks(-height / 2.0, height / 2.0, 5) {
        let [_, y] = frame.at([0.0, tick]);
        group = group.add(line([LEFT - 4.0, y], [LEFT, y])).add(text(
            &tick.to_string(),
            [LEFT - 7.0, y + 3.5],
            10.0,
            "end",
        ));
    }
    let middle = f64::midpoint(TOP, bottom);
    let turn = format!("rotate(-90 12 {})", px(middle));
    group
        .add(text(
            "x (m)",
            [f64::midpoint(LEFT, right), bottom + 29.0],
            11.0,
            "middle",
        ))
        .add(text("y (m)", [12.0, middle], 11.0, "middle").set("transform", turn))
}

/// A path in its colors, on a dark line that keeps the light ones visible.
fn path(episode: &EpisodePath, frame: &Frame<'_>, scale: &ColorScale) -> Group {
    let points = drawn(episode, frame);
    let all: Vec<[f64; 2]> = points.iter().map(|(_, at)| *at).collect();
    let stroke = |points: &[[f64; 2]], color: &str, width: f64| {
        Path::new()
            .set("d", polyline(points))
            .set("stroke", color)
            .set("stroke-width", width)
    };
    let mut group = Group::new()
        .set("fill", "none")
        .set("stroke-linejoin", "round")
        .set("stroke-linecap", "round")
        .add(stroke(&all, "#333", 3.6));
    let level = |(step, _): &(usize, [f64; 2])| {
        let score = episode.scores.as_ref().and_then(|scores| scores.get(*step));
        scale.level(score.copied().unwrap_or(*step as f64))
    };
    let segments = points.get(..points.len().saturating_sub(1)).unwrap_or(&[]);
    let mut start = 0;
    for run in segments.chunk_by(|a, b| level(a) == level(b)) {
        let end = start + run.len();
        if let (Some(points), Some(first)) = (all.get(start..=end), run.first()) {
            group = group.add(stroke(points, &scale.color(level(first)), 2.2));
        }
        start = end;
    }
    group
}

/// The points that are drawn, with their steps: the first and the last always are.
fn drawn(episode: &EpisodePath, frame: &Frame<'_>) -> Vec<(usize, [f64; 2])> {
    let positions = &episode.positions_m;
    let stride = stride(positions.len());
    let last = positions.len().saturating_sub(1);
    let kept = positions
        .iter()
        .enumerate()
        .filter(|(step, _)| step.is_multiple_of(stride) || *step == last);
    kept.map(|(step, at)| (step, frame.at(*at))).collect()
}

fn polyline(points: &[[f64; 2]]) -> String {
    let mut path = String::new();
    for (i, [x, y]) in points.iter().enumerate() {
        path += &format!("{}{x:.2} {y:.2}", if i == 0 { "M" } else { "L" });
    }
    path
}
