//! Rollouts that tests of pages draw.

use std::path::Path;
use std::sync::Arc;

use arrow::array::{ArrayRef, BooleanArray, Float64Array, Int64Array, StringArray};

use crate::process::{list, write_parquet};

/// Rollouts through the U-shaped maze: smooth, with as much noise as asked for.
#[derive(Clone, Copy)]
pub(crate) struct Walks {
    pub(crate) n_episodes: usize,
    pub(crate) n_steps: usize,
    pub(crate) noise: f64,
    /// Whether success, reward and novelty are recorded.
    pub(crate) facts: bool,
    /// Name of every second episode's planner.
    pub(crate) planner: Option<&'static str>,
    /// Number of the first episode.
    pub(crate) first: i64,
    /// From the number of a step to that of the next.
    pub(crate) gap: i64,
    pub(crate) goals: Goals,
    /// What its positions and goals are called.
    pub(crate) names: [&'static str; 2],
}

#[derive(Clone, Copy)]
pub(crate) enum Goals {
    Fixed,
    Moving,
    Nan,
}

impl Walks {
    pub(crate) const fn new(n_episodes: usize, n_steps: usize, noise: f64) -> Self {
        Self {
            n_episodes,
            n_steps,
            noise,
            facts: false,
            planner: None,
            first: 0,
            gap: 1,
            goals: Goals::Fixed,
            names: ["observation.achieved_goal", "observation.desired_goal"],
        }
    }

    pub(crate) fn write(self, path: impl AsRef<Path>) {
        let n = self.n_episodes * self.n_steps;
        let at = |row: usize| ((row / self.n_steps) as f64, (row % self.n_steps) as f64);
        let (mut positions, mut states, mut actions) = (Vec::new(), Vec::new(), Vec::new());
        for row in 0..n {
            let (episode, step) = at(row);
            let noise =
                |i: f64| self.noise * ((row as f64 * 78.233 + i * 37.719).sin() * 43_758.5).fract();
            let angle = 3.0 * step / self.n_steps as f64 + 0.02 * (episode % 50.0);
            positions.extend([
                (4.0 * angle.sin() + noise(1.0)) as f32,
                (4.0 * angle.cos() + noise(2.0)) as f32,
            ]);
            states.extend((0..6).map(|i| {
                ((angle * (1.0 + f64::from(i))).sin() + noise(3.0 + f64::from(i))) as f32
            }));
            actions.extend(
                (0..3).map(|i| {
                    ((2.0 * angle + f64::from(i)).cos() + noise(9.0 + f64::from(i))) as f32
                }),
            );
        }
        let int = |of: &dyn Fn(i64, i64) -> i64| -> ArrayRef {
            let row = |row| of((row / self.n_steps) as i64, (row % self.n_steps) as i64);
            Arc::new((0..n).map(row).collect::<Int64Array>())
        };
        let goal = |i: usize| match self.goals {
            Goals::Fixed => -4.0,
            Goals::Moving => (i as f32 * 0.37).sin(),
            Goals::Nan => f32::NAN,
        };
        let goals: Vec<f32> = (0..2 * n).map(goal).collect();
        let mut columns: Vec<(&str, ArrayRef)> = vec![
            ("episode_index", int(&|episode, _| self.first + episode)),
            ("step_index", int(&|_, step| self.gap * step)),
            (self.names[0], list(2, &positions)),
            ("observation.observation", list(6, &states)),
            (self.names[1], list(2, &goals)),
            ("action", list(3, &actions)),
        ];
        if self.facts {
            let last = self.n_steps as f64 - 1.0;
            let reached = |row: usize| at(row).1 == last && at(row).0 % 3.0 != 0.0;
            let number = |of: &dyn Fn(usize) -> f64| -> ArrayRef {
                Arc::new((0..n).map(of).collect::<Float64Array>())
            };
            columns.push(("reward", number(&|row| f64::from(u8::from(reached(row))))));
            columns.push((
                "info.success",
                Arc::new(BooleanArray::from((0..n).map(reached).collect::<Vec<_>>())),
            ));
            columns.push(("info.novelty", number(&|row| 1e-3 * (1.0 + at(row).1))));
        }
        if let Some(planner) = self.planner {
            let name = |row| {
                if at(row).0 % 2.0 == 0.0 {
                    planner
                } else {
                    "plain"
                }
            };
            columns.push((
                "planner",
                Arc::new(StringArray::from_iter_values((0..n).map(name))),
            ));
        }
        write_parquet(path, columns);
    }
}
