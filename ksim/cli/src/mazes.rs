//! The maze of an environment.

use anyhow::{Context as _, Result};
use ksim_envs::maze::Maze;
use ksim_envs::registry::{self, EnvironmentRequest};

/// Finds it.
///
/// # Errors
/// An unknown environment, or one without a maze.
pub(crate) fn maze_of(request: &EnvironmentRequest) -> Result<Maze> {
    let known = registry::find(&request.id)?;
    let map = request
        .kwargs
        .get("maze_map")
        .or_else(|| known.kwargs.get("maze_map"));
    let map = map.with_context(|| format!("environment `{}` has no maze", known.id))?;
    Ok(Maze::from_json(map)?)
}
