//! What a run is: everything its numbers follow from, and what it was made with.

use std::fs;
use std::path::Path;

use ksim_datasets::DatasetInfo;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::config::Config;
use crate::data::{Episodes, Subset, Windows};
use crate::error::PlannerError;
use crate::tensor_file::write_atomically;

/// Name of the file in a run folder.
pub(crate) const MANIFEST_FILE: &str = "manifest.json";
/// Name of the list of imported files in the manifest of a run that was not trained here.
const IMPORTED: &str = "imported";
/// Version of the format; a file of another one is refused.
pub(crate) const MANIFEST_FORMAT: u32 = 1;

/// The manifest of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Manifest {
    pub(crate) format: u32,
    /// Hash of family, settings, seed, dataset and base: checkpoints name it.
    pub(crate) run: String,
    pub(crate) family: String,
    pub(crate) preset: String,
    pub(crate) seed: u64,
    pub(crate) config: Map<String, Value>,
    pub(crate) dataset: DatasetEntry,
    /// Hash of the planner whose networks were taken over.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) base: Option<String>,
    pub(crate) program: Program,
    /// Backend that began the run; another one may go on with it.
    pub(crate) backend: String,
}

/// What it was trained on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct DatasetEntry {
    pub(crate) id: String,
    pub(crate) format: String,
    pub(crate) fingerprint: String,
    pub(crate) observation_dim: usize,
    pub(crate) action_dim: usize,
    pub(crate) n_episodes: usize,
    pub(crate) n_steps: usize,
    /// Episodes that are shorter than a window and were left out.
    pub(crate) n_short_episodes: usize,
    pub(crate) n_windows: usize,
    pub(crate) n_successful_windows: usize,
}

/// What it was made with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Program {
    pub(crate) name: String,
    pub(crate) version: String,
    pub(crate) features: Vec<String>,
}

impl Program {
    /// This build.
    pub(crate) fn this() -> Self {
        let features = [
            ("native", cfg!(feature = "native")),
            ("torch", cfg!(feature = "torch")),
        ];
        let features = features.iter().filter(|(_, on)| *on);
        Self {
            name: env!("CARGO_PKG_NAME").to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            features: features.map(|(name, _)| (*name).to_owned()).collect(),
        }
    }
}

impl DatasetEntry {
    pub(crate) fn new(info: &DatasetInfo, episodes: &Episodes, windows: &Windows) -> Self {
        Self {
            id: info.id.clone(),
            format: info.format.to_string(),
            fingerprint: episodes.fingerprint(),
            observation_dim: episodes.observation_dim,
            action_dim: episodes.action_dim,
            n_episodes: episodes.spans.len(),
            n_steps: episodes.n_rows(),
            n_short_episodes: windows.n_short(),
            n_windows: windows.n_windows(Subset::All),
            n_successful_windows: windows.n_windows(Subset::Successful),
        }
    }
}

impl Manifest {
    pub(crate) fn new(
        family: &str,
        preset: &str,
        config: &Config,
        seed: u64,
        dataset: DatasetEntry,
    ) -> Self {
        Self {
            format: MANIFEST_FORMAT,
            run: String::new(),
            family: family.to_owned(),
            preset: preset.to_owned(),
            seed,
            config: config.to_json(),
            dataset,
            base: None,
            program: Program::this(),
            backend: String::new(),
        }
    }

    /// Computes [`Manifest::run`] of everything else.
    pub(crate) fn identify(&mut self) {
        let mut config = self.config.clone();
        // How often it is saved does not change what is learned.
        config.remove("checkpoint_interval");
        let parts = serde_json::json!({
            "format": MANIFEST_FORMAT,
            "family": self.family,
            "seed": self.seed,
            "config": config,
            "dataset": self.dataset.fingerprint,
            "base": self.base,
        });
        self.run = blake3::hash(parts.to_string().as_bytes()).to_hex()[..32].to_owned();
    }

    /// Writes the file.
    ///
    /// # Errors
    /// It cannot be written.
    pub(crate) fn write(&self, path: &Path) -> Result<(), PlannerError> {
        let json = serde_json::to_string_pretty(self).map_err(|source| PlannerError::Json {
            path: path.to_owned(),
            source,
        })?;
        write_atomically(path, |file| fs::write(file, json + "\n"))
    }

    /// Reads the file.
    ///
    /// # Errors
    /// It cannot be read, or is of another version.
    pub(crate) fn read(path: &Path) -> Result<Self, PlannerError> {
        let text = fs::read_to_string(path).map_err(|source| PlannerError::File {
            path: path.to_owned(),
            action: "read",
            source,
        })?;
        let manifest: Self = serde_json::from_str(&text).map_err(|source| {
            // An imported run lacks what only a training has.
            let table: Option<Map<String, Value>> = serde_json::from_str(&text).ok();
            if table.is_some_and(|table| table.contains_key(IMPORTED)) {
                return PlannerError::Mismatch {
                    path: path.to_owned(),
                    what: "the run".to_owned(),
                    expected: "a training to go on with".to_owned(),
                    found: "imported from files that hold no state of a training".to_owned(),
                };
            }
            PlannerError::Json {
                path: path.to_owned(),
                source,
            }
        })?;
        if manifest.format != MANIFEST_FORMAT {
            return Err(PlannerError::Mismatch {
                path: path.to_owned(),
                what: "the format".to_owned(),
                expected: MANIFEST_FORMAT.to_string(),
                found: manifest.format.to_string(),
            });
        }
        Ok(manifest)
    }

    /// Whether a run goes on with what was asked for now.
    ///
    /// # Errors
    /// Names the first difference.
    pub(crate) fn check_same(&self, asked: &Self, path: &Path) -> Result<(), PlannerError> {
        let mut pairs = vec![
            (
                "the planner".to_owned(),
                self.family.clone(),
                asked.family.clone(),
            ),
            (
                "the seed".to_owned(),
                self.seed.to_string(),
                asked.seed.to_string(),
            ),
            (
                "the dataset".to_owned(),
                format!("{} ({})", self.dataset.id, &self.dataset.fingerprint),
                format!("{} ({})", asked.dataset.id, &asked.dataset.fingerprint),
            ),
        ];
        differences(&self.config, &asked.config, "setting ", &mut pairs);
        // The same data may stand in a file of another name.
        if self.dataset.fingerprint == asked.dataset.fingerprint {
            pairs.remove(2);
        }
        match pairs
            .into_iter()
            .find(|(_, found, expected)| found != expected)
        {
            None => Ok(()),
            Some((what, found, expected)) => Err(PlannerError::Mismatch {
                path: path.to_owned(),
                what: format!("{what} of the run"),
                expected: format!("{expected} as asked for"),
                found,
            }),
        }
    }
}

/// Adds every setting in which two configurations differ.
fn differences(
    found: &Map<String, Value>,
    asked: &Map<String, Value>,
    prefix: &str,
    pairs: &mut Vec<(String, String, String)>,
) {
    let missing = Value::Null;
    let names = found
        .keys()
        .chain(asked.keys().filter(|name| !found.contains_key(*name)));
    for name in names.filter(|name| *name != "checkpoint_interval") {
        let values = (
            found.get(name).unwrap_or(&missing),
            asked.get(name).unwrap_or(&missing),
        );
        match values {
            (Value::Object(found), Value::Object(asked)) => {
                differences(found, asked, &format!("{prefix}{name}."), pairs);
            }
            (found, asked) => {
                pairs.push((
                    format!("{prefix}{name}"),
                    found.to_string(),
                    asked.to_string(),
                ));
            }
        }
    }
}
