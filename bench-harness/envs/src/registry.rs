//! Which environments there are, and which one a dataset was made in.

use crate::environment::Environment;
use crate::error::EnvironmentError;

/// An environment to be made: an id (or alias), and Gymnasium's keyword arguments.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EnvironmentRequest {
    /// Id or alias.
    pub id: String,
    /// Keyword arguments as Gymnasium's `make` takes them, such as `{"continuing_task": false}`.
    pub kwargs: serde_json::Map<String, serde_json::Value>,
    /// Time limit in steps; `None` takes the id's.
    pub max_episode_steps: Option<usize>,
}

/// Makes an environment.
///
/// # Errors
/// An unknown id, an argument it does not take, or a build without MuJoCo.
pub fn make(request: &EnvironmentRequest) -> Result<Box<dyn Environment>, EnvironmentError> {
    if request.id == crate::toy::POINT_MASS_ID {
        return Ok(Box::new(crate::toy::point_mass(request.max_episode_steps)));
    }
    #[cfg(feature = "mujoco")]
    return Ok(crate::mujoco::make(
        &request.id,
        &request.kwargs,
        request.max_episode_steps,
    )?);
    #[cfg(not(feature = "mujoco"))]
    Err(EnvironmentError::UnknownId {
        id: request.id.clone(),
        suggestions: Vec::new(),
    })
}
