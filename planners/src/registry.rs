//! Which families there are.

use std::collections::BTreeMap;
use std::path::Path;

use crate::algorithms::{CuriosityDiffuser, Diffuser, ReDiffuser};
use crate::baselines::{NearestFamily, RandomFamily, ReplayFamily};
use crate::error::PlannerError;
use crate::family::{LoadOptions, PlannerFamily};
use crate::planner::Planner;
use crate::tensor_file::write_atomically;

/// Families by their ids. Anyone may add theirs to [`Registry::builtin`].
#[derive(Default)]
pub struct Registry {
    families: BTreeMap<&'static str, Box<dyn PlannerFamily>>,
}

impl Registry {
    /// No families.
    pub fn new() -> Self {
        Self::default()
    }

    /// All families of this build.
    pub fn builtin() -> Self {
        let families: [Box<dyn PlannerFamily>; 6] = [
            Box::new(RandomFamily),
            Box::new(ReplayFamily),
            Box::new(NearestFamily),
            Box::new(Diffuser),
            Box::new(ReDiffuser),
            Box::new(CuriosityDiffuser),
        ];
        Self {
            families: families
                .into_iter()
                .map(|family| (family.id(), family))
                .collect(),
        }
    }

    /// Adds a family.
    ///
    /// # Errors
    /// There is one with this id.
    pub fn register(&mut self, family: Box<dyn PlannerFamily>) -> Result<(), PlannerError> {
        let id = family.id();
        if self.families.contains_key(id) {
            return Err(PlannerError::DuplicateFamily { id });
        }
        self.families.insert(id, family);
        Ok(())
    }

    /// The family of an id.
    ///
    /// # Errors
    /// There is none; the error names those there are.
    pub fn family(&self, id: &str) -> Result<&dyn PlannerFamily, PlannerError> {
        match self.families.get(id) {
            Some(family) => Ok(family.as_ref()),
            None => Err(PlannerError::UnknownFamily {
                id: id.to_owned(),
                known: self.families.keys().map(ToString::to_string).collect(),
            }),
        }
    }

    /// Loads the planner of a run folder, whatever its family.
    ///
    /// # Errors
    /// The folder is no run, its family is not of this build, or [`PlannerFamily::load`] fails.
    pub fn load(
        &self,
        run: &Path,
        options: &LoadOptions,
    ) -> Result<Box<dyn Planner>, PlannerError> {
        self.family(&family_of(run)?)?.load(run, options)
    }

    /// All families, in the order of their ids.
    pub fn families(&self) -> impl Iterator<Item = &dyn PlannerFamily> {
        self.families.values().map(AsRef::as_ref)
    }
}

/// Name of the file in a run folder that tells what the run is.
const MANIFEST: &str = "manifest.json";

/// Id of the family that a run is of.
///
/// # Errors
/// The folder has no manifest, or one that names no family.
pub fn family_of(run: &Path) -> Result<String, PlannerError> {
    /// The part that the manifests of all families have.
    #[derive(serde::Deserialize)]
    struct Manifest {
        family: String,
    }
    let path = run.join(MANIFEST);
    let text = std::fs::read_to_string(&path).map_err(|source| PlannerError::File {
        path: path.clone(),
        action: "read",
        source,
    })?;
    let manifest: Result<Manifest, _> = serde_json::from_str(&text);
    let manifest = manifest.map_err(|source| PlannerError::Json { path, source })?;
    Ok(manifest.family)
}

/// Makes a run folder with the least that a manifest must hold, for families that keep no other.
///
/// # Errors
/// The folder or the file cannot be written.
pub fn write_manifest(run: &Path, family: &str) -> Result<(), PlannerError> {
    std::fs::create_dir_all(run).map_err(|source| PlannerError::File {
        path: run.to_owned(),
        action: "create",
        source,
    })?;
    let text = serde_json::json!({"family": family}).to_string() + "\n";
    write_atomically(&run.join(MANIFEST), |file| std::fs::write(file, text))
}
