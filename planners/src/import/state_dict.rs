//! Files of named tensors.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::archive::Archive;
use super::error::ImportError;
use super::pickle::{self, Handle, Object, Pickled};
use super::storage::View;
use crate::nets::{Tensor, Weights};

/// Numbers that are set aside before any was read.
const RESERVE: usize = 1 << 16;

/// The tensors of one file.
#[derive(Debug, Clone, PartialEq)]
pub struct StateDicts {
    /// Those under `model`, or all of a file that holds nothing else.
    pub model: Weights,
    /// Those under `model_ema`: the moving average of the weights.
    pub model_ema: Option<Weights>,
}

/// Reads a file that `torch.save` wrote: a state dict, or a dict of one as `model` and one as `model_ema`. Numbers
/// are rounded to f32.
///
/// # Errors
/// The file is damaged, does anything else than hold tensors, holds anything beside them, or holds numbers that are
/// not finite.
pub fn read_state_dicts(path: &Path) -> Result<StateDicts, ImportError> {
    let mut archive = Archive::open(path)?;
    let bytes = archive.pickle()?;
    let pickled = pickle::read(&bytes).map_err(|refusal| ImportError::Pickle {
        path: path.to_owned(),
        offset: refusal.offset,
        problem: refusal.problem,
    })?;
    let mut reader = Reader {
        path,
        archive,
        pickled: &pickled,
        used: BTreeSet::new(),
    };
    reader.state_dicts()
}

struct Reader<'a> {
    path: &'a Path,
    archive: Archive,
    pickled: &'a Pickled,
    /// Storages that tensors were made of.
    used: BTreeSet<&'a str>,
}

impl<'a> Reader<'a> {
    fn state_dicts(&mut self) -> Result<StateDicts, ImportError> {
        let Object::Dict(root) = self.pickled.root() else {
            let found = self.pickled.root().kind();
            let problem = format!("holds {found}, expected a dict of tensors");
            return Err(ImportError::network(self.path, problem));
        };
        let root = self.by_name(root)?;
        let is_dict = |&handle: &Handle| matches!(self.pickled.get(handle), Object::Dict(_));
        if !root.get("model").is_some_and(is_dict) {
            return Ok(StateDicts {
                model: self.weights(&root, "")?,
                model_ema: None,
            });
        }
        let others = root
            .keys()
            .filter(|&&name| name != "model" && name != "model_ema");
        if let Some(other) = others.into_iter().next() {
            let problem = format!("holds \"{other}\" beside \"model\" and \"model_ema\"");
            return Err(ImportError::network(self.path, problem));
        }
        let model = self.nested(root["model"], "model")?;
        let ema = root.get("model_ema");
        let model_ema = ema.map(|&ema| self.nested(ema, "model_ema")).transpose()?;
        Ok(StateDicts { model, model_ema })
    }

    fn nested(&mut self, handle: Handle, name: &str) -> Result<Weights, ImportError> {
        let object = self.pickled.get(handle);
        let Object::Dict(dict) = object else {
            let problem = format!(
                "\"{name}\" is {}, expected a dict of tensors",
                object.kind()
            );
            return Err(ImportError::network(self.path, problem));
        };
        let dict = self.by_name(dict)?;
        self.weights(&dict, name)
    }

    fn by_name(&self, dict: &[(Handle, Handle)]) -> Result<BTreeMap<&'a str, Handle>, ImportError> {
        let mut by_name = BTreeMap::new();
        for &(name, handle) in dict {
            let name = self.pickled.text(name);
            if by_name.insert(name, handle).is_some() {
                let problem = format!("\"{name}\" is in it twice");
                return Err(ImportError::network(self.path, problem));
            }
        }
        Ok(by_name)
    }

    fn weights(
        &mut self,
        dict: &BTreeMap<&'a str, Handle>,
        under: &str,
    ) -> Result<Weights, ImportError> {
        let mut weights = Weights::default();
        for (&name, &handle) in dict {
            let full = [under, name].join(if under.is_empty() { "" } else { "." });
            let Object::Tensor(view) = self.pickled.get(handle) else {
                let found = self.pickled.get(handle).kind();
                let problem = format!("\"{full}\" is {found}, expected a tensor");
                return Err(ImportError::network(self.path, problem));
            };
            let tensor = self.tensor(&full, view)?;
            weights.tensors.insert(name.to_owned(), tensor);
        }
        Ok(weights)
    }

    fn tensor(&mut self, name: &str, view: &'a View) -> Result<Tensor, ImportError> {
        let storage = &view.storage;
        // Otherwise a small file could name its largest storage over and over.
        if !self.used.insert(&storage.key) {
            let problem = format!("shares the storage \"{}\" with another", storage.key);
            return Err(ImportError::tensor(self.path, name, problem));
        }
        let numbers = storage.numbers;
        let n_bytes = storage.n_numbers as u64 * numbers.n_bytes() as u64;
        let mut stored = Vec::with_capacity(storage.n_numbers.min(RESERVE));
        let take = |bytes: &[u8]| numbers.decode(bytes, &mut stored);
        self.archive.storage(&storage.key, n_bytes, take)?;
        let values = view.gather(stored);
        if let Some(place) = values.iter().position(|value| !value.is_finite()) {
            let problem = format!("its number {place} is {} as f32", values[place]);
            return Err(ImportError::tensor(self.path, name, problem));
        }
        Ok(Tensor {
            shape: view.shape.clone(),
            values,
        })
    }
}
