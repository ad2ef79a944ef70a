//! Compiled models.

use std::path::Path;
use std::sync::Arc;

use mujoco_rs::wrappers::mj_model::MjModel;

use super::log::collect_warnings;
use crate::error::EnvironmentError;

/// A compiled model, shared by the simulations that step it.
#[derive(Debug, Clone)]
pub struct MujocoModel {
    name: String,
    compiled: Arc<MjModel>,
    warnings: Vec<String>,
}

impl MujocoModel {
    /// Compiles MJCF text; `name` is what errors call it.
    ///
    /// # Errors
    /// What MuJoCo says of a model that does not compile.
    pub fn from_xml(name: &str, xml: &str) -> Result<Self, EnvironmentError> {
        Self::load(name.to_owned(), || {
            MjModel::from_xml_string(xml).map_err(|error| error.to_string())
        })
    }

    /// Compiles an MJCF file, and what it includes from its folder.
    ///
    /// # Errors
    /// A file that cannot be read, or what MuJoCo says of a model that does not compile, with its place in it.
    pub fn from_file(path: &Path) -> Result<Self, EnvironmentError> {
        Self::load(path.display().to_string(), || {
            // MuJoCo says of a missing file only that it could not be opened, not why.
            std::fs::File::open(path).map_err(|error| error.to_string())?;
            MjModel::from_xml(path).map_err(|error| error.to_string())
        })
    }

    fn load(
        name: String,
        compile: impl FnOnce() -> Result<MjModel, String>,
    ) -> Result<Self, EnvironmentError> {
        let (compiled, warnings) = collect_warnings(compile);
        match compiled {
            Ok(model) => Ok(Self {
                name,
                compiled: Arc::new(model),
                warnings,
            }),
            Err(message) => Err(EnvironmentError::Model {
                model: name,
                message: message.trim().replace('\n', ", "),
            }),
        }
    }

    /// Its file, or the robot's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// What MuJoCo remarked while compiling, such as deprecated elements.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// The numbers that MuJoCo compiled.
    pub fn compiled(&self) -> &Arc<MjModel> {
        &self.compiled
    }
}
