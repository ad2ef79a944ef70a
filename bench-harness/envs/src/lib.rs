//! Robot-learning environments stepped in Rust: HalfCheetah, Hopper, Walker2d, Ant and AntMaze with the published
//! rules, and a point mass whose return is known in closed form.
//!
//! [`registry`] knows ids and aliases, makes environments, and finds the environment of a dataset. The MuJoCo
//! environments need feature `mujoco`; everything else, ids and mazes included, works without.
//!
//! Module map: [`environment`] is the trait and its vocabulary; [`simulation`] splits a control problem into
//! `Physics` (what moves) and `Task` (what is asked); [`vector`] steps many at once; [`numpy_rng`] repeats the draws
//! of NumPy's generator, so that seeded resets are those of the published environments; [`maze`] holds mazes;
//! [`toy`] the closed-form environment.

pub mod environment;
mod error;
pub mod maze;
#[cfg(feature = "mujoco")]
pub mod mujoco;
pub mod numpy_rng;
pub mod registry;
pub mod simulation;
pub mod toy;
pub mod vector;

#[cfg(feature = "test-util")]
pub mod conformance;

pub use environment::{
    Environment, EnvironmentSpec, Part, ResetOptions, ResetOutcome, RewardTerms, StepOutcome,
};
pub use error::EnvironmentError;
