//! A control problem as physics and task, after dm_control.

use crate::environment::{ResetOptions, RewardTerms};
use crate::error::EnvironmentError;
use crate::numpy_rng::Generator;

/// What moves: holds a state, takes controls, advances by a fixed time. Knows nothing of goals or rewards.
pub trait Physics: Send {
    /// Applies a control for one control step. `control` has the width of the actuators and is finite.
    ///
    /// # Errors
    /// The simulation diverged.
    fn step(&mut self, control: &[f64]) -> Result<(), String>;
}

/// What a task says of a step.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Judgement {
    /// Reward of this step.
    pub reward: f64,
    /// Whether the task ended.
    pub terminated: bool,
    /// Whether the task is solved at this moment; `None` where success is not reported.
    pub success: Option<bool>,
    /// Terms of the reward.
    pub terms: RewardTerms,
}

/// What is asked: initial states, observations, rewards and ends.
pub trait Task<P: Physics>: Send {
    /// Puts the physics into the first state of an episode, drawing from `generator` in the published order.
    ///
    /// # Errors
    /// Options that the task does not have.
    fn initialize(
        &mut self,
        physics: &mut P,
        generator: &mut Generator,
        options: &ResetOptions,
    ) -> Result<Option<bool>, EnvironmentError>;

    /// Called before the physics takes a control: keeps what the reward compares with.
    fn before_step(&mut self, physics: &P);

    /// Writes the observation of the state as it is now.
    fn observe(&self, physics: &P, observation: &mut [f64]);

    /// Judges the state after a step, called once for every step and after [`Task::observe`]. May draw a new goal,
    /// which only the next observation shows.
    fn judge(&mut self, physics: &P, action: &[f64], generator: &mut Generator) -> Judgement;

    /// Writes the state and goal.
    fn read_info(&self, physics: &P, info: &mut [f64]);
}
