//! Diffuser: planning with diffusion for flexible behavior synthesis (Janner et al. 2022).
//!
//! A diffusion model of windows of observations and actions, guided by the gradient of a learned value; the candidate
//! of the highest value is executed. As in CleanDiffuser, which the comparison of Curiosity-Diffuser builds on, the
//! guidance acts on the prediction of the clean window; see [`crate::diffusion`].

use std::path::Path;

use ksim_datasets::DatasetSource;

use super::loaded::Loaded;
use super::plan::{Best, DiffusionPlanner};
use crate::error::PlannerError;
use crate::family::{
    LoadOptions, PlannerFamily, Preset, TrainObserver, TrainRequest, TrainSummary,
};
use crate::planner::Planner;
use crate::presets::{self, PRESETS};
use crate::training::{TrainedFamily, train};

/// The family `diffuser`.
#[derive(Debug, Clone, Copy, Default)]
pub struct Diffuser;

impl Diffuser {
    pub(crate) const ID: &'static str = "diffuser";
}

impl PlannerFamily for Diffuser {
    fn id(&self) -> &'static str {
        Self::ID
    }

    fn summary(&self) -> &'static str {
        "diffusion over windows, guided by a learned value (Janner et al. 2022)"
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
            config: presets::base,
        };
        train(&family, request, data, run, observer)
    }

    fn load(&self, run: &Path, options: &LoadOptions) -> Result<Box<dyn Planner>, PlannerError> {
        let loaded = Loaded::open(run, Self::ID, options)?;
        loaded.refuse_curiosity(options)?;
        let guide = loaded.value_guide()?;
        Ok(Box::new(DiffusionPlanner::new(
            loaded,
            guide,
            Box::new(Best),
            options,
        )?))
    }
}
