//! Which environments there are, and which one a dataset was made in.
//!
//! [`all`] lists them and [`make`] makes them. Ids are Gymnasium's. Names that are close enough lead to an id: case
//! does not matter, `-` and `_` are the same, and without a version locomotion is version 5 and a maze version 4, the
//! version of Minari's `D4RL/antmaze` datasets: `hopper` is `Hopper-v5`, `antmaze-large` is `AntMaze_Large-v4`.

mod dataset;
mod gymnasium;
mod ids;
mod suggest;

use serde_json::{Map, Value};

use crate::environment::Environment;
use crate::environment::EnvironmentSpec;
use crate::error::EnvironmentError;
use crate::maze::Maze;
use crate::toy;

pub use dataset::{DatasetEnvironment, for_d4rl, for_dataset, for_minari_spec};
pub use gymnasium::{action_space, env_spec, observation_space};
pub use ids::{EnvironmentInfo, Family, all, find};

/// An environment to be made: an id (or alias), and Gymnasium's keyword arguments.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EnvironmentRequest {
    /// Id or alias.
    pub id: String,
    /// Keyword arguments as Gymnasium's `make` takes them, such as `{"continuing_task": false}`.
    pub kwargs: Map<String, Value>,
    /// Time limit in steps; `None` takes the id's.
    pub max_episode_steps: Option<usize>,
}

impl EnvironmentRequest {
    /// An environment as it is registered.
    pub fn of_id(id: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            ..Self::default()
        }
    }
}

/// The maze of an environment: its own, or that of its id. `None` for environments without one.
pub fn maze_of(spec: &EnvironmentSpec) -> Option<Maze> {
    let registered = find(&spec.id).ok()?.kwargs;
    let map = spec.kwargs.get("maze_map").or(registered.get("maze_map"))?;
    Maze::from_json(map).ok()
}

/// Makes an environment.
///
/// # Errors
/// An unknown id, an argument it does not take, a time limit of no steps, or a build without MuJoCo.
pub fn make(request: &EnvironmentRequest) -> Result<Box<dyn Environment>, EnvironmentError> {
    let info = find(&request.id)?;
    let refuse = |name: &str, expected: &str, found: String| EnvironmentError::Argument {
        id: info.id.clone(),
        name: name.to_owned(),
        expected: expected.to_owned(),
        found,
    };
    let limit = request.max_episode_steps.unwrap_or(info.max_episode_steps);
    if limit == 0 {
        return Err(refuse("max_episode_steps", "at least 1", limit.to_string()));
    }
    match (info.family, request.kwargs.iter().next()) {
        (Family::PointMass, None) => Ok(Box::new(toy::point_mass(Some(limit)))),
        (Family::PointMass, Some((name, value))) => {
            Err(refuse(name, "no arguments", value.to_string()))
        }
        _ => make_mujoco(&info, &request.kwargs, limit),
    }
}

#[cfg(feature = "mujoco")]
fn make_mujoco(
    info: &EnvironmentInfo,
    kwargs: &Map<String, Value>,
    max_episode_steps: usize,
) -> Result<Box<dyn Environment>, EnvironmentError> {
    Ok(crate::mujoco::make(
        &info.id,
        kwargs,
        Some(max_episode_steps),
    )?)
}

#[cfg(not(feature = "mujoco"))]
fn make_mujoco(
    info: &EnvironmentInfo,
    _: &Map<String, Value>,
    _: usize,
) -> Result<Box<dyn Environment>, EnvironmentError> {
    Err(EnvironmentError::MissingFeature {
        id: info.id.clone(),
    })
}
