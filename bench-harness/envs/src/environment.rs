//! What every environment is: a specification, a seeded reset, and a step.

use crate::error::EnvironmentError;

/// A named run of numbers in a flat vector.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// Its name in Gymnasium's dictionary, such as `achieved_goal`; empty if the vector has a single nameless part.
    pub name: &'static str,
    /// How many numbers.
    pub width: usize,
}

/// What is fixed about an environment.
#[derive(Debug, Clone, PartialEq)]
pub struct EnvironmentSpec {
    /// Canonical id, such as `AntMaze_Large-v4`.
    pub id: String,
    /// Parts of an observation, in the order in which they stand in the flat vector.
    pub observation: Vec<Part>,
    /// Lowest action, one value per actuator; actions outside are clamped by the simulator, not by the environment.
    pub action_low: Vec<f64>,
    /// Highest action.
    pub action_high: Vec<f64>,
    /// Parts of [`Environment::read_info`]: the simulator's state (`qpos`, `qvel`), and `goal` where there is one.
    pub info: Vec<Part>,
    /// Time limit in steps.
    pub max_episode_steps: usize,
    /// Control step, in seconds.
    pub dt_s: f64,
    /// Whether steps report success.
    pub reports_success: bool,
    /// Gymnasium's keyword arguments that differ from the defaults of the id, as JSON.
    pub kwargs: serde_json::Map<String, serde_json::Value>,
}

impl EnvironmentSpec {
    /// Numbers in a flat observation.
    pub fn observation_dim(&self) -> usize {
        width(&self.observation)
    }

    /// Numbers in an action.
    pub fn action_dim(&self) -> usize {
        self.action_low.len()
    }

    /// Numbers that [`Environment::read_info`] writes.
    pub fn info_dim(&self) -> usize {
        width(&self.info)
    }
}

fn width(parts: &[Part]) -> usize {
    parts.iter().map(|part| part.width).sum()
}

/// What may be asked of a reset.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ResetOptions {
    /// Maze cell (row, column) of the goal; drawn if `None`.
    pub goal_cell: Option<(usize, usize)>,
    /// Maze cell (row, column) of the start; drawn if `None`.
    pub reset_cell: Option<(usize, usize)>,
}

impl ResetOptions {
    /// Refuses cells, for environments without a maze.
    ///
    /// # Errors
    /// If a cell is set.
    pub(crate) fn refuse_cells(&self, id: &str) -> Result<(), EnvironmentError> {
        let cells = [
            ("goal_cell", self.goal_cell),
            ("reset_cell", self.reset_cell),
        ];
        for (name, cell) in cells {
            if let Some((row, column)) = cell {
                return Err(EnvironmentError::Argument {
                    id: id.to_owned(),
                    name: name.to_owned(),
                    expected: "none, for there is no maze".to_owned(),
                    found: format!("({row}, {column})"),
                });
            }
        }
        Ok(())
    }
}

/// What a reset tells besides the observation.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ResetOutcome {
    /// Whether the start already is at the goal; `None` where success is not reported.
    pub success: Option<bool>,
}

/// The terms whose sum is the reward, where the environment has them.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RewardTerms {
    /// For moving forward.
    pub forward: f64,
    /// For staying healthy.
    pub survive: f64,
    /// For control, never positive.
    pub control: f64,
    /// For contact forces, never positive.
    pub contact: f64,
}

/// What a step tells besides the observation.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StepOutcome {
    /// Reward of this step.
    pub reward: f64,
    /// The task ended: no step may follow.
    pub terminated: bool,
    /// The time limit is reached: no step may follow. Both flags may be set.
    pub truncated: bool,
    /// Whether the task is solved at this moment; `None` where success is not reported.
    pub success: Option<bool>,
    /// Terms of the reward of the locomotion tasks; zero elsewhere.
    pub terms: RewardTerms,
}

impl StepOutcome {
    /// Whether the episode is over.
    pub fn is_last(&self) -> bool {
        self.terminated || self.truncated
    }
}

/// A control problem. All numbers are f64, as the simulators compute them. Writes into the caller's slices, so that
/// stepping allocates nothing.
pub trait Environment: Send {
    /// What is fixed.
    fn spec(&self) -> &EnvironmentSpec;

    /// Starts an episode and writes its first observation, of [`EnvironmentSpec::observation_dim`] numbers. With a
    /// seed the generator is made anew, as Gymnasium's `reset(seed=…)` does; without, its stream goes on (and starts
    /// from seed 0 if there never was one).
    ///
    /// # Errors
    /// Options that the environment does not have, a cell that is a wall or outside the maze, or a slice of another
    /// width.
    fn reset(
        &mut self,
        seed: Option<u64>,
        options: &ResetOptions,
        observation: &mut [f64],
    ) -> Result<ResetOutcome, EnvironmentError>;

    /// Applies an action for one control step and writes the observation after it.
    ///
    /// # Errors
    /// An action of another width or with a number that is not finite; a step before the first reset or after the
    /// end of an episode; a simulation that diverged.
    fn step(
        &mut self,
        action: &[f64],
        observation: &mut [f64],
    ) -> Result<StepOutcome, EnvironmentError>;

    /// Writes the simulator's state and goal as they are now, laid out as [`EnvironmentSpec::info`].
    ///
    /// # Panics
    /// If the slice has another width than [`EnvironmentSpec::info_dim`].
    fn read_info(&self, info: &mut [f64]);
}
