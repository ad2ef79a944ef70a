//! Figures of the paper (Curiosity-Diffuser), as far as they are known, to stand beside ours.
//!
//! Success rates in Minari's AntMaze. The paper chose λ per task on the environments it reports: its table has the
//! best of a sweep. The MuJoCo scores and the K-Sim table of the paper are not known here.

use serde::Serialize;

/// When an episode counts as a success.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rule {
    /// The goal was reached at any step.
    Ever,
    /// The agent was at the goal at the last step.
    AtEnd,
}

impl Rule {
    /// In words.
    pub fn describe(self) -> &'static str {
        match self {
            Self::Ever => "at any step",
            Self::AtEnd => "at the last step",
        }
    }
}

/// A success rate of the paper.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PaperFigure {
    /// The task.
    pub task: &'static str,
    /// Family of the planner.
    pub family: &'static str,
    /// Success rate, in [0, 1].
    pub success: f64,
    /// How the released code counts it for this planner.
    pub rule: Rule,
    /// Weight of curiosity behind it, where it has one.
    pub curiosity: Option<f64>,
}

const CURIOSITY: &str = "curiosity-diffuser";
const DIFFUSER: &str = "diffuser";

const fn at_end(task: &'static str, success: f64, curiosity: f64) -> PaperFigure {
    PaperFigure {
        task,
        family: CURIOSITY,
        success,
        rule: Rule::AtEnd,
        curiosity: Some(curiosity),
    }
}

const fn ever(task: &'static str, success: f64) -> PaperFigure {
    PaperFigure {
        task,
        family: DIFFUSER,
        success,
        rule: Rule::Ever,
        curiosity: None,
    }
}

/// The paper's AntMaze table.
const FIGURES: [PaperFigure; 8] = [
    at_end("antmaze-medium-play", 0.5867, 1e6),
    at_end("antmaze-medium-diverse", 0.24, 1e5),
    at_end("antmaze-large-play", 0.34, 1e6),
    at_end("antmaze-large-diverse", 0.42, 1e6),
    ever("antmaze-medium-play", 0.013),
    ever("antmaze-medium-diverse", 0.007),
    ever("antmaze-large-play", 0.007),
    ever("antmaze-large-diverse", 0.020),
];

/// A point of the paper's figure of success against λ.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SweepPoint {
    /// The task.
    pub task: &'static str,
    /// Weight of curiosity.
    pub curiosity: f64,
    /// Success rate at the last step, in [0, 1].
    pub success: f64,
}

const fn swept(task: &'static str, curiosity: f64, success: f64) -> SweepPoint {
    SweepPoint {
        task,
        curiosity,
        success,
    }
}

/// The points of that figure that are known. Those without curiosity differ from the table's Diffuser.
pub const SWEEP: [SweepPoint; 9] = [
    swept("antmaze-medium-play", 0.0, 0.047),
    swept("antmaze-medium-play", 1e6, 0.5867),
    swept("antmaze-medium-diverse", 0.0, 0.027),
    swept("antmaze-medium-diverse", 1e5, 0.24),
    swept("antmaze-medium-diverse", 1e6, 0.22),
    swept("antmaze-large-play", 0.0, 0.0),
    swept("antmaze-large-play", 1e6, 0.34),
    swept("antmaze-large-diverse", 0.0, 0.013),
    swept("antmaze-large-diverse", 1e6, 0.42),
];

/// The paper's name of a task: as it was said, else as the name of the dataset shows.
pub(crate) fn task(said: Option<&str>, dataset: Option<&str>) -> Option<String> {
    if let Some(task) = said {
        return Some(task.to_owned());
    }
    let name = dataset?.to_lowercase().replace(['/', '_'], "-");
    let known = FIGURES.iter().map(|figure| figure.task);
    let mut known = known.filter(|task| name.contains(task));
    known.next().map(str::to_owned)
}

/// What the paper has for a task and a family.
pub(super) fn figure(task: &str, family: &str) -> Option<&'static PaperFigure> {
    FIGURES
        .iter()
        .find(|figure| figure.task == task && figure.family == family)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tasks_are_found_by_the_names_of_their_datasets() {
        let task = |dataset: &str| task(None, Some(dataset));
        let medium = Some("antmaze-medium-play".to_owned());
        assert_eq!(task("D4RL/antmaze/medium-play-v1"), medium);
        assert_eq!(task("antmaze-medium-play"), medium);
        assert_eq!(task("hopper-medium-v2"), None);
        assert_eq!(
            figure("antmaze-large-play", "diffuser").unwrap().success,
            0.007
        );
        assert_eq!(figure("antmaze-large-play", "rediffuser"), None);
    }

    #[test]
    fn the_table_is_the_best_of_the_sweep() {
        for figure in FIGURES.iter().filter(|figure| figure.family == CURIOSITY) {
            let of_task = SWEEP.iter().filter(|point| point.task == figure.task);
            let best = of_task.map(|point| point.success).fold(0.0, f64::max);
            assert_eq!(figure.success, best, "{}", figure.task);
        }
    }
}
