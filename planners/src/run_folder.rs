//! Which files make a folder a run.

use std::path::Path;

use crate::error::PlannerError;
use crate::model::PLANNER_FILE;
use crate::training::{CHECKPOINT_FILE, HISTORY_FILE};

/// The demonstrations that a baseline keeps.
pub(crate) const DEMONSTRATIONS: &str = "demonstrations.safetensors";

/// Refuses a folder that holds what a run would overwrite, although it has no manifest.
///
/// # Errors
/// Names the first such file.
pub(crate) fn refuse_leftovers(run: &Path) -> Result<(), PlannerError> {
    let files = [PLANNER_FILE, CHECKPOINT_FILE, DEMONSTRATIONS, HISTORY_FILE];
    match files.into_iter().find(|name| run.join(name).exists()) {
        None => Ok(()),
        Some(name) => Err(PlannerError::occupied(
            run,
            "empty",
            format!("a folder with {name} and without a manifest"),
        )),
    }
}
