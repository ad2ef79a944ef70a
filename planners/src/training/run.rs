//! The course of a training: from a dataset and a preset to a run folder.

use std::collections::BTreeMap;
use std::path::Path;

use ksim_datasets::DatasetSource;

use super::begin::check_folder;
use super::checkpoint::Checkpoint;
use super::manifest::{DatasetEntry, Manifest};
use super::session::{Session, kinds};
use super::setting::Setting;
use crate::backend::{self, BackendOptions};
use crate::config::{Config, Mode, RewardRule};
use crate::data::{Episodes, Windows, has_goal};
use crate::diffusion::Schedule;
use crate::error::PlannerError;
use crate::family::{TrainObserver, TrainRequest, TrainSummary};
use crate::model::PlannerMeta;
use crate::presets::{PRESETS, default_preset};

/// Which family is trained, and the settings of its presets.
pub(crate) struct TrainedFamily {
    pub(crate) id: &'static str,
    pub(crate) config: fn(&str) -> Option<Config>,
}

/// Trains a family. See [`crate::family::PlannerFamily::train`].
pub(crate) fn train(
    family: &TrainedFamily,
    request: &TrainRequest,
    data: &dyn DatasetSource,
    run: &Path,
    observer: &mut dyn TrainObserver,
) -> Result<TrainSummary, PlannerError> {
    // What needs no data comes first: a dataset takes minutes to read.
    let preset = request
        .preset
        .as_deref()
        .unwrap_or_else(|| default_preset(has_goal(data.info())));
    let Some(config) = (family.config)(preset) else {
        return Err(PlannerError::UnknownPreset {
            family: family.id,
            name: preset.to_owned(),
            known: PRESETS.iter().map(|preset| preset.name).collect(),
        });
    };
    let config = config.with_overrides(&request.overrides)?;
    let backend = backend::open(&BackendOptions::of_training(request))?;
    let asked = |dataset| Manifest::new(family.id, preset, &config, request.seed, dataset);
    let found = check_folder(request, run, asked)?;
    let episodes = Episodes::read(data)?;
    check_rewards(&episodes, &config)?;
    let windows = Windows::new(&episodes, &config.data, config.mode)?;
    if windows.n_short() > 0 {
        observer.notice(&format!(
            "{} episodes are shorter than the horizon of {} steps and are left out",
            windows.n_short(),
            config.data.horizon
        ));
    }
    let dataset = DatasetEntry::new(data.info(), &episodes, &windows);
    let mut manifest = asked(dataset);
    manifest.backend = backend.name().to_owned();
    let (value_mean, value_std) = value_unit(&windows, &config);
    let values = (value_mean, value_std);
    let meta = meta(family.id, &config, &episodes, &manifest, values);
    // Windows hold what training takes of them.
    drop(episodes);
    let mut session = Session {
        meta,
        setting: Setting {
            config: &config,
            windows: &windows,
            seed: request.seed,
            schedule: Schedule::cosine(config.diffusion.n_timesteps),
            value_mean,
            value_std,
            backend: backend.as_ref(),
            checkpoint: Checkpoint::default(),
        },
        kinds: kinds(&config),
        interval: request
            .checkpoint_interval
            .unwrap_or(config.checkpoint_interval)
            .max(1),
        run,
        manifest,
    };
    session.check()?;
    session.begin(found)?;
    session.train(observer)
}

/// Mean and unit of the values the reward network learns. Mode reference has it learn raw values.
fn value_unit(windows: &Windows, config: &Config) -> (f32, f32) {
    match config.mode {
        Mode::Reference => (0.0, 1.0),
        Mode::Corrected => {
            let (mean, std) = windows.value_statistics();
            (mean as f32, std as f32)
        }
    }
}

/// Mazes have rewards of 0 and 1 only; another reward means another preset.
fn check_rewards(episodes: &Episodes, config: &Config) -> Result<(), PlannerError> {
    let sparse = |reward: &f64| *reward == 0.0 || *reward == 1.0;
    match (
        config.data.rule,
        episodes.rewards.iter().find(|reward| !sparse(reward)),
    ) {
        (RewardRule::Goal, Some(reward)) => Err(PlannerError::DatasetFit {
            what: "a reward",
            expected: "0 or 1 (data.rule \"goal\")".to_owned(),
            found: reward.to_string(),
        }),
        (RewardRule::Locomotion, None) => Err(PlannerError::DatasetFit {
            what: "every reward",
            expected:
                "others than 0 and 1 somewhere (data.rule \"locomotion\"; for a maze choose a \
                       preset such as \"cpu-antmaze\", or data.rule \"goal\")"
                    .to_owned(),
            found: "0 or 1".to_owned(),
        }),
        _ => Ok(()),
    }
}

fn meta(
    family: &str,
    config: &Config,
    episodes: &Episodes,
    manifest: &Manifest,
    (value_mean, value_std): (f32, f32),
) -> PlannerMeta {
    let (action_low, action_high) = episodes.action_bounds();
    PlannerMeta {
        format: PlannerMeta::FORMAT,
        family: family.to_owned(),
        config: config.clone(),
        observation_dim: episodes.observation_dim,
        action_dim: episodes.action_dim,
        observation_order: episodes.observation_order.clone(),
        action_low,
        action_high,
        value_mean,
        value_std,
        n_updates: BTreeMap::new(),
        finished: false,
        dataset: Some(manifest.dataset.fingerprint.clone()),
    }
}
