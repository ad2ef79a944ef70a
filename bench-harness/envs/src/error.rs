//! What can go wrong with an environment.

/// Why an environment could not be made, reset or stepped.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EnvironmentError {
    /// No environment has this id.
    #[error("unknown environment `{id}`{}", hint(suggestions))]
    UnknownId {
        /// What was asked for.
        id: String,
        /// Ids that look like it, best first.
        suggestions: Vec<String>,
    },
    /// A published environment that is not offered, since its rules are faulty.
    #[error("environment `{id}` is not offered: {reason}; use `{instead}`")]
    Retired {
        /// What was asked for.
        id: String,
        /// What is wrong with it.
        reason: &'static str,
        /// The environment without the fault.
        instead: String,
    },
    /// A maze map that is none.
    #[error("environment `{id}`: argument `maze_map`")]
    Maze {
        /// The environment.
        id: String,
        /// What is wrong with the map.
        source: crate::maze::MazeError,
    },
    /// The environment exists, but this build was made without it.
    #[error(
        "environment `{id}` needs MuJoCo, which this build lacks: build ksim with `--features mujoco` \
         (scripts/native.py fetches the library)"
    )]
    MissingFeature {
        /// What was asked for.
        id: String,
    },
    /// An argument the environment does not take, or with a value it cannot use.
    #[error("environment `{id}`: argument `{name}`: expected {expected}, found {found}")]
    Argument {
        /// The environment.
        id: String,
        /// Gymnasium's name of the argument.
        name: String,
        /// What would have been accepted.
        expected: String,
        /// What was given.
        found: String,
    },
    /// A dataset whose environment is not among ours.
    #[error("{dataset}: {reason}")]
    NoEnvironment {
        /// The dataset, or its environment specification.
        dataset: String,
        /// Why there is none, and what to use instead.
        reason: String,
    },
    /// A slice of another width than the specification says.
    #[error("{what} has {found} numbers, expected {expected}")]
    Width {
        /// Which slice: `action`, `observation`.
        what: &'static str,
        /// Numbers that were expected.
        expected: usize,
        /// Numbers that were given.
        found: usize,
    },
    /// An action with a number that is not finite.
    #[error("action {index} is {value}, expected a finite number")]
    ActionNotFinite {
        /// Position in the action.
        index: usize,
        /// The number.
        value: f64,
    },
    /// A step before the first reset.
    #[error("step before the first reset")]
    NotReset,
    /// A step after the end of an episode.
    #[error("step after the end of the episode, at step {step}; reset first")]
    EpisodeOver {
        /// Steps the episode had.
        step: usize,
    },
    /// A reset cell that cannot be used.
    #[error("cell ({row}, {column}): expected {expected}, found {found}")]
    Cell {
        /// Row, from 0 at the top.
        row: usize,
        /// Column, from 0 at the left.
        column: usize,
        /// What would have been accepted.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A model that the simulator refuses.
    #[error("model {model}: {message}")]
    Model {
        /// Which model.
        model: String,
        /// The simulator's message, with its place in the model.
        message: String,
    },
    /// The simulator met numbers it cannot go on with, and started over from its initial state.
    #[error("the simulation diverged at step {step}: {message}")]
    Diverged {
        /// Steps since the reset.
        step: usize,
        /// What the simulator says.
        message: String,
    },
}

fn hint(suggestions: &[String]) -> String {
    match suggestions {
        [] => "; `ksim env list` shows them all".to_owned(),
        _ => format!("; did you mean {}?", suggestions.join(", ")),
    }
}
