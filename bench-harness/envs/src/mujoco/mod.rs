//! The environments that MuJoCo steps: HalfCheetah, Hopper, Walker2d, Ant, and the mazes that Ant walks.
//!
//! [`MujocoModel`] compiles, [`MujocoPhysics`] steps, `tasks` judge by the published rules. This is the only place
//! that knows MuJoCo.

mod arguments;
mod environment;
mod log;
mod model;
mod models;
mod physics;
mod tasks;

pub use environment::MujocoEnvironment;
pub use model::MujocoModel;
pub use physics::MujocoPhysics;
pub use tasks::make;
