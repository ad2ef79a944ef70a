//! Which families there are.

use std::collections::BTreeMap;
use std::path::Path;

use crate::algorithms::{CuriosityDiffuser, Diffuser, ReDiffuser};
use crate::baselines::{NearestFamily, RandomFamily, ReplayFamily};
use crate::error::PlannerError;
use crate::family::{LoadOptions, PlannerFamily};
use crate::model::PlannerFile;
use crate::planner::Planner;
use crate::run_folder::refuse_leftovers;
use crate::tensor_file::{TensorFile, write_atomically};

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

    /// Loads the planner of a run folder, or of the file of a planner alone, whatever its family.
    ///
    /// # Errors
    /// It is no run, its family is not of this build, or [`PlannerFamily::load`] fails.
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

/// What a run says of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunInfo {
    /// Id of its family.
    pub family: String,
    /// Whether its training is done. A planner plays before that, as well as it has learned so far.
    pub finished: bool,
}

/// What a run is: a folder, or the file of a planner alone.
///
/// # Errors
/// The folder has no manifest, or one that names no family; the file is no planner's.
pub fn run_info(run: &Path) -> Result<RunInfo, PlannerError> {
    /// The part of the file's table that is asked for here.
    #[derive(serde::Deserialize)]
    struct Meta {
        family: String,
        finished: bool,
    }
    let file = PlannerFile::path(run);
    let meta = |file: &Path| TensorFile::read_table::<Meta>(file);
    if !run.is_dir() && file.is_file() {
        let Meta { family, finished } = meta(&file)?;
        return Ok(RunInfo { family, finished });
    }
    let family = family_of(run)?;
    let finished = match file.is_file() {
        true => meta(&file)?.finished,
        // A planner of another kind, or a training that has not come as far as one.
        false => true,
    };
    Ok(RunInfo { family, finished })
}

/// Id of the family that a run is of: a folder, or the file of a planner alone.
///
/// # Errors
/// As [`run_info`].
pub fn family_of(run: &Path) -> Result<String, PlannerError> {
    /// The part that the manifests of all families have.
    #[derive(serde::Deserialize)]
    struct Manifest {
        family: String,
    }
    if run.is_file() {
        return Ok(run_info(run)?.family);
    }
    let path = run.join(MANIFEST);
    // Of what is not there at all, the folder is named, not the file that is looked for in it.
    let missing = if run.exists() { &path } else { run };
    let text = std::fs::read_to_string(&path).map_err(|source| PlannerError::File {
        path: missing.to_owned(),
        action: "read the planner",
        source,
    })?;
    let manifest: Result<Manifest, _> = serde_json::from_str(&text);
    let manifest = manifest.map_err(|source| PlannerError::Json { path, source })?;
    Ok(manifest.family)
}

/// Makes a run folder with the least that a manifest must hold, for families that keep no other.
///
/// # Errors
/// The folder holds a run of another family, or it or the file cannot be written.
pub fn write_manifest(run: &Path, family: &str) -> Result<(), PlannerError> {
    std::fs::create_dir_all(run).map_err(|source| PlannerError::File {
        path: run.to_owned(),
        action: "create",
        source,
    })?;
    let path = run.join(MANIFEST);
    if path.exists() {
        let found = family_of(run)?;
        if found != family {
            let expected = format!("empty, or a run of {family}");
            let found = format!("a run of {found}");
            return Err(PlannerError::occupied(run, &expected, found));
        }
    } else {
        refuse_leftovers(run)?;
    }
    let text = serde_json::json!({"family": family}).to_string() + "\n";
    write_atomically(&path, |file| std::fs::write(file, text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_manifest_of_another_family_stays() {
        let folder = tempfile::tempdir().unwrap();
        write_manifest(folder.path(), "push").unwrap();
        write_manifest(folder.path(), "push").unwrap();
        let error = write_manifest(folder.path(), "pull").unwrap_err();
        assert!(error.to_string().contains("a run of push"), "{error}");
        assert_eq!(family_of(folder.path()).unwrap(), "push");
    }
}
