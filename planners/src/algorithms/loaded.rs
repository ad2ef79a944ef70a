//! A planner's file, and the options it is to plan with.

use std::collections::BTreeMap;
use std::path::Path;

use crate::backend::{self, BackendOptions};
use crate::config::{ConfidenceConfig, PlanningConfig};
use crate::data::Normalizer;
use crate::diffusion::Guide;
use crate::error::PlannerError;
use crate::family::LoadOptions;
use crate::model::network::REWARD;
use crate::model::{PlannerFile, PlannerMeta};
use crate::nets::{Backend, Network, Weights};

/// A planner's file, and how it is to plan.
pub(crate) struct Loaded {
    pub(super) meta: PlannerMeta,
    pub(crate) normalizer: Normalizer,
    pub(crate) planning: PlanningConfig,
    networks: BTreeMap<String, Weights>,
    backend: Box<dyn Backend>,
}

impl Loaded {
    /// Reads the planner of a run.
    pub(crate) fn open(
        run: &Path,
        family: &str,
        options: &LoadOptions,
    ) -> Result<Self, PlannerError> {
        let file = PlannerFile::read(&PlannerFile::path(run), family)?;
        let mut planning = file.meta.config.planning.clone();
        replace(&mut planning.n_candidates, options.n_candidates);
        replace(&mut planning.sampling_steps, options.sampling_steps);
        replace(&mut planning.guidance_weight, options.guidance_weight);
        replace(&mut planning.curiosity_weight, options.curiosity_weight);
        replace(&mut planning.temperature, options.temperature);
        planning.check(file.meta.config.diffusion.n_timesteps)?;
        Ok(Self {
            meta: file.meta,
            normalizer: file.normalizer,
            planning,
            networks: file.networks,
            backend: backend::open(&BackendOptions::of_planning(options))?,
        })
    }

    /// A network of the file.
    pub(crate) fn network(&self, name: &'static str) -> Result<Box<dyn Network>, PlannerError> {
        let architectures = self.meta.architectures();
        match (architectures.get(name), self.networks.get(name)) {
            (Some(architecture), Some(weights)) => self.backend.network(architecture, weights),
            _ => Err(PlannerError::MissingTensor {
                name: format!("{name}.*"),
            }),
        }
    }

    /// The guide by value.
    pub(crate) fn value_guide(&self) -> Result<Guide, PlannerError> {
        Ok(Guide::new(
            self.network(REWARD)?,
            self.meta.value_mean,
            self.meta.value_std,
        ))
    }

    /// Settings of ReDiffuser's confidence.
    pub(crate) fn confidence(&self) -> Result<&ConfidenceConfig, PlannerError> {
        match &self.meta.config.confidence {
            Some(confidence) => Ok(confidence),
            None => Err(PlannerError::UnknownSetting {
                name: "confidence".to_owned(),
                known: self.meta.config.to_json().keys().cloned().collect(),
            }),
        }
    }

    /// A planner without curiosity has no weight for it.
    pub(crate) fn refuse_curiosity(&self, options: &LoadOptions) -> Result<(), PlannerError> {
        match options.curiosity_weight {
            Some(weight) if weight != 0.0 => Err(PlannerError::Request {
                what: "the weight of curiosity",
                expected: format!("0 for {}, which has no curiosity", self.meta.family),
                found: weight.to_string(),
            }),
            _ => Ok(()),
        }
    }
}

fn replace<T: Copy>(value: &mut T, other: Option<T>) {
    *value = other.unwrap_or(*value);
}
