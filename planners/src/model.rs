//! What a trained diffusion planner is, as one file: networks for inference and everything they need.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::data::Normalizer;
use crate::error::PlannerError;
use crate::nets::{Architecture, Tensor, Weights};
use crate::tensor_file::TensorFile;

/// Name of the file in a run folder.
pub const PLANNER_FILE: &str = "planner.safetensors";
/// Version of the format; a file of another one is refused.
const FORMAT: u32 = 1;

/// Network names in the file, and what they compute.
pub mod network {
    /// The diffusion model.
    pub const DIFFUSION: &str = "diffusion";
    /// The reward network.
    pub const REWARD: &str = "reward";
    /// Predictor of the curiosity.
    pub const CURIOSITY_PREDICTOR: &str = "curiosity-predictor";
    /// Fixed random target of the curiosity.
    pub const CURIOSITY_TARGET: &str = "curiosity-target";
    /// Predictor of ReDiffuser's confidence.
    pub const CONFIDENCE_PREDICTOR: &str = "confidence-predictor";
    /// Fixed random target of ReDiffuser's confidence.
    pub const CONFIDENCE_TARGET: &str = "confidence-target";
}

/// What stands beside the tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannerMeta {
    /// Version of the format.
    pub format: u32,
    /// Id of the family.
    pub family: String,
    /// All settings.
    pub config: Config,
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Numbers in an action.
    pub action_dim: usize,
    /// Column of the dataset's observation for each number of an observation as the networks see it.
    pub observation_order: Vec<usize>,
    /// Least number of each action; proposals are clipped to it.
    pub action_low: Vec<f32>,
    /// Greatest number of each action.
    pub action_high: Vec<f32>,
    /// Value of which the reward network's output is the distance, in units of `value_std`.
    pub value_mean: f32,
    /// See `value_mean`.
    pub value_std: f32,
    /// Updates of each network.
    pub n_updates: BTreeMap<String, u64>,
    /// Whether training is done.
    pub finished: bool,
    /// Fingerprint of the dataset that it was trained on, or that gave the statistics of an imported one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dataset: Option<String>,
}

impl PlannerMeta {
    /// The version of the format that this program writes.
    pub const FORMAT: u32 = FORMAT;

    /// The networks that a planner of these settings has.
    pub fn architectures(&self) -> BTreeMap<&'static str, Architecture> {
        let config = &self.config;
        let width = self.observation_dim + self.action_dim;
        let mut networks = BTreeMap::from([
            (network::DIFFUSION, config.diffusion_network(width)),
            (network::REWARD, config.classifier_network(width, 1)),
        ]);
        if let Some(curiosity) = &config.curiosity {
            let out_dim = curiosity.out_dim;
            networks.insert(
                network::CURIOSITY_PREDICTOR,
                config.classifier_network(width, out_dim),
            );
            networks.insert(
                network::CURIOSITY_TARGET,
                config.target_network(width, out_dim),
            );
        }
        if let Some(confidence) = &config.confidence {
            let [predictor, target] =
                confidence.networks(config.data.horizon, width, self.observation_dim);
            networks.insert(network::CONFIDENCE_PREDICTOR, predictor);
            networks.insert(network::CONFIDENCE_TARGET, target);
        }
        networks
    }
}

/// A trained planner.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannerFile {
    /// What stands beside the tensors.
    pub meta: PlannerMeta,
    /// Statistics of the observations.
    pub normalizer: Normalizer,
    /// Weights of every network: the moving averages where there are some.
    pub networks: BTreeMap<String, Weights>,
}

impl PlannerFile {
    /// The file of a run: itself, or in the folder of this name.
    pub fn path(run: &Path) -> PathBuf {
        if run.is_dir() {
            return run.join(PLANNER_FILE);
        }
        run.to_owned()
    }

    /// Writes the file. It appears whole or not at all.
    ///
    /// # Errors
    /// The file cannot be written; what was there stays.
    pub fn write(&self, path: &Path) -> Result<(), PlannerError> {
        let mut file = TensorFile::default();
        for (name, weights) in &self.networks {
            file.insert(name, weights);
        }
        let vector = |values: &[f32]| Tensor {
            shape: vec![values.len()],
            values: values.to_vec(),
        };
        let normalizer = Weights {
            tensors: BTreeMap::from([
                ("mean".to_owned(), vector(&self.normalizer.mean)),
                ("std".to_owned(), vector(&self.normalizer.std)),
            ]),
        };
        file.insert("normalizer", &normalizer);
        file.write(path, &self.meta)
    }

    /// Reads a file of a family.
    ///
    /// # Errors
    /// The file cannot be read, is damaged, of another family or version, or holds other networks than its settings
    /// ask for, or numbers that are not finite.
    pub fn read(path: &Path, family: &str) -> Result<Self, PlannerError> {
        let (mut file, meta): (TensorFile, PlannerMeta) = TensorFile::read(path)?;
        let mismatch = |what: &str, expected: String, found: String| PlannerError::Mismatch {
            path: path.to_owned(),
            what: what.to_owned(),
            expected,
            found,
        };
        if meta.format != FORMAT {
            return Err(mismatch(
                "the format",
                FORMAT.to_string(),
                meta.format.to_string(),
            ));
        }
        if meta.family != family {
            return Err(mismatch("the planner", family.to_owned(), meta.family));
        }
        let in_file = |network: Option<&'static str>| {
            move |source: PlannerError| source.in_file(path, network)
        };
        meta.config.check().map_err(in_file(None))?;
        let bounds = [&meta.action_low, &meta.action_high].map(Vec::len);
        if bounds != [meta.action_dim; 2] {
            return Err(mismatch(
                "the number of bounds of actions",
                meta.action_dim.to_string(),
                format!("{bounds:?}"),
            ));
        }
        let statistics = [meta.value_mean, meta.value_std];
        let bounds = meta.action_low.iter().chain(&meta.action_high);
        if !bounds.chain(&statistics).all(|value| value.is_finite()) {
            return Err(mismatch(
                "a bound of actions or a statistic of values",
                "a finite number".to_owned(),
                "infinite".to_owned(),
            ));
        }
        let mut order = meta.observation_order.clone();
        order.sort_unstable();
        if !order.iter().copied().eq(0..meta.observation_dim) {
            return Err(mismatch(
                "the order of observations",
                format!(
                    "all of 0 to {} once",
                    meta.observation_dim.saturating_sub(1)
                ),
                format!("{:?}", meta.observation_order),
            ));
        }
        let statistics = file.take("normalizer");
        let of_statistics = |name: &str| {
            let found = statistics.tensor(name, &[meta.observation_dim]);
            found
                .map(<[f32]>::to_vec)
                .map_err(in_file(Some("normalizer")))
        };
        let normalizer = Normalizer {
            mean: of_statistics("mean")?,
            std: of_statistics("std")?,
        };
        normalizer
            .check(meta.observation_dim)
            .map_err(in_file(None))?;
        let mut networks = BTreeMap::new();
        for (name, architecture) in meta.architectures() {
            let weights = file.take(name);
            architecture
                .check_weights(&weights)
                .map_err(in_file(Some(name)))?;
            networks.insert(name.to_owned(), weights);
        }
        if let Some(name) = file.tensors.keys().next() {
            return Err(mismatch(
                "a tensor",
                "none beside the planner's".to_owned(),
                name.clone(),
            ));
        }
        Ok(Self {
            meta,
            normalizer,
            networks,
        })
    }
}
