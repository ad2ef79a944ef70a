//! Compiled models.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use mujoco_rs::wrappers::mj_model::MjModel;

use super::log::collect_warnings;
use crate::error::EnvironmentError;

/// Texts whose models are in use.
static IN_USE: Mutex<Vec<InUse>> = Mutex::new(Vec::new());

struct InUse {
    xml: String,
    compiled: Weak<MjModel>,
    warnings: Vec<String>,
}

/// A compiled model, shared by the simulations that step it.
#[derive(Debug, Clone)]
pub struct MujocoModel {
    name: String,
    compiled: Arc<MjModel>,
    warnings: Vec<String>,
}

impl MujocoModel {
    /// Compiles MJCF text; `name` is what errors call it. While a model of the same text is in use, it is that one:
    /// simulations that are stepped in turn then find it in the processor's cache, and many are made as fast as one.
    ///
    /// # Errors
    /// What MuJoCo says of a model that does not compile.
    pub fn from_xml(name: &str, xml: &str) -> Result<Self, EnvironmentError> {
        let mut in_use = IN_USE.lock().unwrap_or_else(PoisonError::into_inner);
        in_use.retain(|known| known.compiled.strong_count() > 0);
        let known = in_use.iter().find(|known| known.xml == xml);
        if let Some((known, compiled)) = known.and_then(|k| Some((k, k.compiled.upgrade()?))) {
            return Ok(Self {
                name: name.to_owned(),
                compiled,
                warnings: known.warnings.clone(),
            });
        }
        let model = Self::load(name.to_owned(), || {
            MjModel::from_xml_string(xml).map_err(|error| error.to_string())
        })?;
        in_use.push(InUse {
            xml: xml.to_owned(),
            compiled: Arc::downgrade(&model.compiled),
            warnings: model.warnings.clone(),
        });
        Ok(model)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_texts_share_their_model_while_it_is_in_use() {
        let xml = |size: u32| {
            format!(
                "<mujoco><compiler settotalmass='2'/><worldbody><body><freejoint/><geom size='{size}'/></body></worldbody></mujoco>"
            )
        };
        let make = |name, size| MujocoModel::from_xml(name, &xml(size)).unwrap();
        let first = make("first", 41);
        let second = make("second", 41);
        assert!(Arc::ptr_eq(first.compiled(), second.compiled()));
        assert_eq!((first.name(), second.name()), ("first", "second"));
        assert_eq!(first.warnings(), second.warnings());
        assert!(!second.warnings().is_empty());
        assert!(!Arc::ptr_eq(first.compiled(), make("other", 42).compiled()));
        drop((first, second));
        let is_known = |size| {
            let in_use = IN_USE.lock().unwrap();
            in_use
                .iter()
                .any(|known| known.xml == xml(size) && known.compiled.strong_count() > 0)
        };
        assert!(!is_known(41));
    }
}
