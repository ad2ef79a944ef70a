//! Where an agent went: the maze from above, with the path of every episode.
//!
//! The path is colored by step or by the K-Sim of each step. Axes are in meters and equally scaled; the frame is
//! the simulator's, with y upward.

use ksim_envs::maze::Maze;
use svg::node::element::{Circle, Group};

use super::panel::{self, Marker, Panel};
use super::scale::ColorScale;
use super::{document, text};

/// Points of a path that are drawn at most: beyond, only every second, third, … is, and the panel says so.
const MAX_POINTS: usize = 2_000;
/// Pixels of the longer side of a maze.
const SIDE: f64 = 300.0;
/// Most panels beside each other.
const MAX_COLUMNS: usize = 4;

/// One episode to draw.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodePath {
    /// What it is called, such as `episode 3`.
    pub title: String,
    /// What is worth knowing about it, such as its return; may be empty.
    pub note: String,
    /// Position before every step, and after the last where it is known; in meters.
    pub positions_m: Vec<[f64; 2]>,
    /// Its goals, in the order in which it had them.
    pub goals_m: Vec<[f64; 2]>,
    /// What every step is colored by, as a [`Measure`] says.
    pub scores: Option<Vec<f64>>,
}

/// What the scores of steps are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Measure {
    /// K-Sim, from 0 to 1 in every figure.
    #[default]
    KSim,
    /// Novelty of the plan under way, from the smallest to the largest of the figure.
    Novelty,
}

/// How episodes share the figure.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Layout {
    /// A panel for every episode.
    #[default]
    Panels,
    /// All episodes in one panel.
    Together,
}

/// Why a figure cannot be drawn.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FigureError {
    /// Nothing to draw.
    #[error("there are no episodes to draw")]
    NoEpisodes,
    /// A position, goal or score that is not finite.
    #[error("{title}, step {step}: the {what} is not finite")]
    NotFinite {
        /// The episode.
        title: String,
        /// `position` or `score`.
        what: &'static str,
        /// Its row, from 0.
        step: usize,
    },
    /// Scores for some episodes only, or not one for every step.
    #[error("{title} has {found} scores, expected one for each of its {expected} steps")]
    Scores {
        /// The episode.
        title: String,
        /// Steps.
        expected: usize,
        /// Scores.
        found: usize,
    },
}

/// Draws episodes in a maze, as an SVG document. With scores, paths are colored by them as K-Sim, else by step.
///
/// # Errors
/// As [`draw_by`].
pub fn draw(
    heading: &str,
    maze: &Maze,
    episodes: &[EpisodePath],
    layout: Layout,
) -> Result<String, FigureError> {
    draw_by(heading, maze, episodes, layout, Measure::KSim)
}

/// As [`draw`], with scores that are something else.
///
/// # Errors
/// Nothing to draw, numbers that are not finite, or scores that do not fit the paths.
pub fn draw_by(
    heading: &str,
    maze: &Maze,
    episodes: &[EpisodePath],
    layout: Layout,
    measure: Measure,
) -> Result<String, FigureError> {
    check(episodes)?;
    let has_scores = episodes.iter().all(|episode| episode.scores.is_some());
    let last = episodes.iter().map(|episode| episode.positions_m.len());
    let scale = match (has_scores, measure) {
        (true, Measure::KSim) => ColorScale::k_sim(),
        (true, Measure::Novelty) => {
            let scores = episodes
                .iter()
                .filter_map(|episode| episode.scores.as_ref());
            ColorScale::novelty(scores.flatten().copied())
        }
        (false, _) => ColorScale::steps(last.max().unwrap_or(0).saturating_sub(2)),
    };
    let panels: Vec<Panel<'_>> = match layout {
        Layout::Panels => episodes.iter().map(Panel::of).collect(),
        Layout::Together => vec![Panel::together(episodes)],
    };
    let frame = panel::Frame::new(maze, SIDE);
    let n_columns = columns(panels.len());
    let size = frame.size();
    let mut figure = Group::new();
    for (place, panel) in panels.iter().enumerate() {
        let [column, row] = [place % n_columns, place / n_columns].map(|n| n as f64);
        let at = format!("translate({} {})", column * size[0], HEAD + row * size[1]);
        figure = figure.add(panel.draw(&frame, &scale).set("transform", at));
    }
    let [width, height] = [
        n_columns as f64 * size[0],
        panels.len().div_ceil(n_columns) as f64 * size[1],
    ];
    let bar = scale.bar(width + 4.0, HEAD + frame.bottom(), frame.height());
    let whole = [width.max(MIN_WIDTH) + BAR, HEAD + height + FOOT];
    let document = document(whole, heading)
        .add(figure)
        .add(bar)
        .add(legend(HEAD + height + 14.0));
    Ok(format!("{document}\n"))
}

/// Pixels above the panels, below them, and right of them.
const HEAD: f64 = 28.0;
const FOOT: f64 = 26.0;
const BAR: f64 = 66.0;
/// Room for the legend.
const MIN_WIDTH: f64 = 260.0;

/// Every how many-th point is drawn.
pub(super) fn stride(n_points: usize) -> usize {
    n_points.div_ceil(MAX_POINTS).max(1)
}

fn check(episodes: &[EpisodePath]) -> Result<(), FigureError> {
    let has_scores = episodes.iter().any(|episode| episode.scores.is_some());
    for episode in episodes {
        let mut points = episode.positions_m.iter().chain(&episode.goals_m);
        if let Some(step) = points.position(|point| !point.iter().all(|m| m.is_finite())) {
            return Err(not_finite(episode, "position", step));
        }
        let mut scores = episode.scores.iter().flatten();
        if let Some(step) = scores.position(|score| !score.is_finite()) {
            return Err(not_finite(episode, "score", step));
        }
        let n_points = episode.positions_m.len();
        let found = episode.scores.as_ref().map_or(0, Vec::len);
        // A path without its final position has a score more than it has segments.
        if has_scores && found != n_points && found + 1 != n_points {
            return Err(FigureError::Scores {
                title: episode.title.clone(),
                expected: n_points.saturating_sub(1),
                found,
            });
        }
    }
    match episodes
        .iter()
        .any(|episode| !episode.positions_m.is_empty())
    {
        true => Ok(()),
        false => Err(FigureError::NoEpisodes),
    }
}

fn not_finite(episode: &EpisodePath, what: &'static str, step: usize) -> FigureError {
    FigureError::NotFinite {
        title: episode.title.clone(),
        what,
        step,
    }
}

/// Panels beside each other: near a square.
fn columns(n_panels: usize) -> usize {
    (1..MAX_COLUMNS)
        .find(|n| n * n >= n_panels)
        .unwrap_or(MAX_COLUMNS)
}

/// What the markers mean, below the panels.
fn legend(y: f64) -> Group {
    let entries = [
        (Marker::Start, "start"),
        (Marker::End, "end"),
        (Marker::Goal, "goal"),
    ];
    let mut group = Group::new();
    let mut x = 16.0;
    for (marker, name) in entries {
        group = group
            .add(marker.draw([x, y - 4.0]))
            .add(text(name, [x + 11.0, y], 11.0, "start"));
        x += 64.0;
    }
    group
}

/// A disc, for markers and walls' corners alike.
pub(super) fn disc([x, y]: [f64; 2], radius: f64) -> Circle {
    Circle::new()
        .set("cx", super::px(x))
        .set("cy", super::px(y))
        .set("r", radius)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn maze() -> Maze {
        Maze::published("UMaze").expect("a published name")
    }

    fn episode(n_points: usize) -> EpisodePath {
        let at = |i: usize| {
            let angle = i as f64 / n_points as f64 * 3.0;
            [4.0 * angle.sin(), 4.0 * angle.cos()]
        };
        EpisodePath {
            title: "episode 0".to_owned(),
            note: "return 1".to_owned(),
            positions_m: (0..n_points).map(at).collect(),
            goals_m: vec![[-4.0, -4.0]],
            scores: None,
        }
    }

    #[test]
    fn names_are_text_and_no_markup() {
        let mut one = episode(3);
        one.title = "<script>&\u{7}".to_owned();
        let svg = draw("a<b", &maze(), &[one], Layout::Panels).unwrap();
        assert!(svg.contains("&lt;script&gt;&amp;\u{fffd}"), "{svg}");
        assert!(svg.contains("a&lt;b") && !svg.contains("<script"));
    }

    #[test]
    fn the_same_data_gives_the_same_bytes_and_each_episode_its_panel() {
        let episodes = vec![episode(50); 5];
        let panels = draw("", &maze(), &episodes, Layout::Panels).unwrap();
        assert_eq!(
            panels,
            draw("", &maze(), &episodes, Layout::Panels).unwrap()
        );
        assert_eq!(panels.matches("x (m)").count(), 5);
        let together = draw("", &maze(), &episodes, Layout::Together).unwrap();
        assert_eq!(together.matches("x (m)").count(), 1);
        assert!(together.contains("5 episodes"));
    }

    #[test]
    fn the_frame_is_the_simulators() {
        // The center of the maze, and the center of its upper left cell.
        let mut one = episode(2);
        one.positions_m = vec![[0.0, 0.0], [-8.0, 8.0]];
        let svg = draw("", &maze(), &[one], Layout::Panels).unwrap();
        assert!(svg.contains("M194.00 184.00L74.00 64.00"), "{svg}");
    }

    #[test]
    fn a_long_path_says_that_it_is_thinned_and_keeps_its_ends() {
        let short = draw("", &maze(), &[episode(2_000)], Layout::Panels).unwrap();
        assert!(!short.contains("steps drawn"));
        let long = draw("", &maze(), &[episode(6_500)], Layout::Panels).unwrap();
        assert!(long.contains("return 1; 1 of 4 steps drawn"));
        assert!(long.len() < 2 * short.len());
    }

    #[test]
    fn scores_color_the_path_and_must_fit_it() {
        let mut one = episode(3);
        let by_step = draw("", &maze(), &[one.clone()], Layout::Panels).unwrap();
        one.scores = Some(vec![0.1, 1.0]);
        let by_score = draw("", &maze(), &[one.clone()], Layout::Panels).unwrap();
        assert!(
            by_step.contains(">\nstep\n<") || by_step.contains(">step<"),
            "{by_step}"
        );
        assert!(by_score.contains("K-Sim of the step"));
        assert!(by_score.contains(&ColorScale::k_sim().color(63)));
        one.scores = Some(vec![0.1]);
        let error = draw("", &maze(), &[one], Layout::Panels).unwrap_err();
        assert!(
            error
                .to_string()
                .contains("1 scores, expected one for each of its 2"),
            "{error}"
        );
    }

    #[test]
    fn novelty_has_a_scale_of_its_own() {
        let mut one = episode(3);
        one.scores = Some(vec![2e-4, 4e-4]);
        let draw = |one: &EpisodePath| {
            let episodes = std::slice::from_ref(one);
            draw_by("", &maze(), episodes, Layout::Panels, Measure::Novelty).unwrap()
        };
        let svg = draw(&one);
        let scale = ColorScale::novelty([2e-4, 4e-4].into_iter());
        assert!(
            svg.contains("novelty of the plan") && svg.contains("0.0003"),
            "{svg}"
        );
        assert!(svg.contains(&scale.color(0)) && svg.contains(&scale.color(63)));
        // All the same: the scale has no width.
        one.scores = Some(vec![1.0, 1.0]);
        draw(&one);
    }

    #[test]
    fn what_cannot_be_drawn_is_an_error() {
        let none: Result<_, _> = draw("", &maze(), &[], Layout::Panels);
        assert_eq!(none, Err(FigureError::NoEpisodes));
        let mut one = episode(3);
        one.scores = Some(vec![0.5, f64::NAN]);
        let error = draw("", &maze(), &[one.clone()], Layout::Panels).unwrap_err();
        assert_eq!(
            error.to_string(),
            "episode 0, step 1: the score is not finite"
        );
        one.positions_m[1][0] = f64::NAN;
        let error = draw("", &maze(), &[one], Layout::Panels).unwrap_err();
        assert!(matches!(error, FigureError::NotFinite { step: 1, .. }));
    }
}
