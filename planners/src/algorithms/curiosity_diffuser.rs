//! Curiosity-Diffuser: curiosity guides diffusion models away from what the data does not support.
//!
//! Diffuser whose guidance also lowers novelty, the error of random network distillation on noised windows:
//! log p = R − λ·Σ (predictor − target)². The candidate of the highest log p at the end is executed.

use std::path::Path;

use ksim_datasets::DatasetSource;

use super::loaded::Loaded;
use super::plan::{Best, DiffusionPlanner};
use crate::config::Config;
use crate::error::PlannerError;
use crate::family::{
    LoadOptions, PlannerFamily, Preset, TrainObserver, TrainRequest, TrainSummary,
};
use crate::model::network::{CURIOSITY_PREDICTOR, CURIOSITY_TARGET};
use crate::planner::Planner;
use crate::presets::{self, PRESETS};
use crate::training::{TrainedFamily, train};

/// The family `curiosity-diffuser`.
#[derive(Debug, Clone, Copy, Default)]
pub struct CuriosityDiffuser;

impl CuriosityDiffuser {
    pub(crate) const ID: &'static str = "curiosity-diffuser";
}

/// Settings of a preset.
fn config(preset: &str) -> Option<Config> {
    let mut config = presets::base(preset)?;
    config.curiosity = Some(presets::curiosity(preset));
    Some(config)
}

impl PlannerFamily for CuriosityDiffuser {
    fn id(&self) -> &'static str {
        Self::ID
    }

    fn summary(&self) -> &'static str {
        "Diffuser whose guidance also lowers curiosity, so that plans stay in the data"
    }

    fn presets(&self) -> &[Preset] {
        PRESETS
    }

    fn train(
        &self,
        request: &TrainRequest,
        data: &dyn DatasetSource,
        run: &Path,
        observer: &mut dyn TrainObserver,
    ) -> Result<TrainSummary, PlannerError> {
        let family = TrainedFamily {
            id: Self::ID,
            config,
        };
        train(&family, request, data, run, observer)
    }

    fn load(&self, run: &Path, options: &LoadOptions) -> Result<Box<dyn Planner>, PlannerError> {
        let loaded = Loaded::open(run, Self::ID, options)?;
        let weight = loaded.planning.curiosity_weight;
        let mut guide = loaded.value_guide()?;
        if weight != 0.0 {
            let predictor = loaded.network(CURIOSITY_PREDICTOR)?;
            let target = loaded.network(CURIOSITY_TARGET)?;
            guide = guide.with_curiosity(predictor, target, weight);
        }
        Ok(Box::new(DiffusionPlanner::new(
            loaded,
            guide,
            Box::new(Best),
            options,
        )?))
    }
}
