//! Which families there are.

use std::collections::BTreeMap;

use crate::algorithms::{CuriosityDiffuser, Diffuser, ReDiffuser};
use crate::error::PlannerError;
use crate::family::PlannerFamily;

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
        let families: [Box<dyn PlannerFamily>; 3] = [
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

    /// All families, in the order of their ids.
    pub fn families(&self) -> impl Iterator<Item = &dyn PlannerFamily> {
        self.families.values().map(AsRef::as_ref)
    }
}
