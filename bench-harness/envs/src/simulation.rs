//! A control problem as physics and task, after dm_control.

use crate::environment::{
    Environment, EnvironmentSpec, ResetOptions, ResetOutcome, RewardTerms, StepOutcome,
};
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
    /// Puts the physics into the first state of an episode, drawing from `generator` in the published order. Returns
    /// whether the start already is at the goal.
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

    /// Writes the state and goal, laid out as [`EnvironmentSpec::info`].
    fn read_info(&self, physics: &P, info: &mut [f64]);

    /// Puts the physics into the state, and the goal to the place, that [`Task::read_info`] once wrote.
    fn restore(&mut self, physics: &mut P, info: &[f64]);
}

/// A physics and a task as an [`Environment`]: counts steps, keeps the generator, refuses bad actions and steps
/// outside an episode.
#[derive(Debug)]
pub struct SimEnvironment<P, T> {
    spec: EnvironmentSpec,
    physics: P,
    task: T,
    generator: Option<Generator>,
    phase: Phase,
    step: usize,
}

/// Where in its life an environment is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Fresh,
    Running,
    Over,
}

impl<P: Physics, T: Task<P>> SimEnvironment<P, T> {
    /// An environment that waits for its first reset. `spec` must fit what `physics` and `task` read and write.
    pub fn new(spec: EnvironmentSpec, physics: P, task: T) -> Self {
        Self {
            spec,
            physics,
            task,
            generator: None,
            phase: Phase::Fresh,
            step: 0,
        }
    }

    /// Starts an episode in a state (and goal) that [`Environment::read_info`] once wrote, without drawing anything.
    ///
    /// # Errors
    /// A slice of another width than [`EnvironmentSpec::info_dim`].
    pub fn restore(&mut self, info: &[f64]) -> Result<(), EnvironmentError> {
        check_width("info", self.spec.info_dim(), info.len())?;
        self.task.restore(&mut self.physics, info);
        self.phase = Phase::Running;
        self.step = 0;
        Ok(())
    }

    /// Writes the observation of the state as it is now, of [`EnvironmentSpec::observation_dim`] numbers.
    ///
    /// # Errors
    /// A slice of another width.
    pub fn observe(&self, observation: &mut [f64]) -> Result<(), EnvironmentError> {
        check_width(
            "observation",
            self.spec.observation_dim(),
            observation.len(),
        )?;
        self.task.observe(&self.physics, observation);
        Ok(())
    }

    /// What moves.
    pub fn physics(&self) -> &P {
        &self.physics
    }

    /// What moves, to be changed between steps.
    pub fn physics_mut(&mut self) -> &mut P {
        &mut self.physics
    }

    fn check_action(&self, action: &[f64]) -> Result<(), EnvironmentError> {
        check_width("action", self.spec.action_dim(), action.len())?;
        match action.iter().position(|value| !value.is_finite()) {
            Some(index) => Err(EnvironmentError::ActionNotFinite {
                index,
                value: action[index],
            }),
            None => Ok(()),
        }
    }
}

fn check_width(what: &'static str, expected: usize, found: usize) -> Result<(), EnvironmentError> {
    if expected == found {
        Ok(())
    } else {
        Err(EnvironmentError::Width {
            what,
            expected,
            found,
        })
    }
}

impl<P: Physics, T: Task<P>> Environment for SimEnvironment<P, T> {
    fn spec(&self) -> &EnvironmentSpec {
        &self.spec
    }

    fn reset(
        &mut self,
        seed: Option<u64>,
        options: &ResetOptions,
        observation: &mut [f64],
    ) -> Result<ResetOutcome, EnvironmentError> {
        check_width(
            "observation",
            self.spec.observation_dim(),
            observation.len(),
        )?;
        // A reset that fails half way leaves no episode to step in.
        self.phase = Phase::Fresh;
        self.step = 0;
        if let Some(seed) = seed {
            self.generator = Some(Generator::new(seed));
        }
        let generator = self.generator.get_or_insert_with(|| Generator::new(0));
        let success = self
            .task
            .initialize(&mut self.physics, generator, options)?;
        self.task.observe(&self.physics, observation);
        self.phase = Phase::Running;
        Ok(ResetOutcome { success })
    }

    fn step(
        &mut self,
        action: &[f64],
        observation: &mut [f64],
    ) -> Result<StepOutcome, EnvironmentError> {
        match self.phase {
            Phase::Fresh => return Err(EnvironmentError::NotReset),
            Phase::Over => return Err(EnvironmentError::EpisodeOver { step: self.step }),
            Phase::Running => {}
        }
        self.check_action(action)?;
        check_width(
            "observation",
            self.spec.observation_dim(),
            observation.len(),
        )?;
        self.step += 1;
        self.task.before_step(&self.physics);
        if let Err(message) = self.physics.step(action) {
            self.phase = Phase::Over;
            return Err(EnvironmentError::Diverged {
                step: self.step,
                message,
            });
        }
        self.task.observe(&self.physics, observation);
        let generator = self.generator.get_or_insert_with(|| Generator::new(0));
        let judgement = self.task.judge(&self.physics, action, generator);
        let outcome = StepOutcome {
            reward: judgement.reward,
            terminated: judgement.terminated,
            truncated: self.step >= self.spec.max_episode_steps,
            success: judgement.success,
            terms: judgement.terms,
        };
        if outcome.is_last() {
            self.phase = Phase::Over;
        }
        Ok(outcome)
    }

    fn read_info(&self, info: &mut [f64]) {
        assert_eq!(info.len(), self.spec.info_dim(), "width of the info slice");
        self.task.read_info(&self.physics, info);
    }
}
