//! A planner of the reference's files.

use std::collections::BTreeMap;
use std::path::Path;

use ksim_datasets::DatasetSource;

use super::reference::{ImportedNetwork, ReferenceFiles, ReferenceNetworks, reference_networks};
use crate::algorithms::{CuriosityDiffuser, Diffuser};
use crate::config::{Config, Mode};
use crate::data::{Episodes, Normalizer};
use crate::error::PlannerError;
use crate::model::{PlannerFile, PlannerMeta, network};
use crate::nets::{Architecture, JannerConfig, Weights};
use crate::presets::{self, PRESETS};

/// Makes a planner of the reference's files: Curiosity-Diffuser if there is random network distillation among them,
/// else Diffuser. It plans as the reference does (mode `reference`), with the moving averages of the weights.
/// The files hold no settings but the sizes of the networks; a preset gives the others, also the horizon if none is
/// given. The dataset that the reference was trained on gives the statistics of observations and the bounds of
/// actions.
///
/// # Errors
/// Those of [`reference_networks`]; there is no reward network, no such preset, or files, preset and dataset do not
/// go together.
pub fn reference_planner(
    files: &ReferenceFiles,
    preset: &str,
    data: &dyn DatasetSource,
) -> Result<PlannerFile, PlannerError> {
    let family = match files.rnd {
        Some(_) => CuriosityDiffuser::ID,
        None => Diffuser::ID,
    };
    let unknown = || PlannerError::UnknownPreset {
        family,
        name: preset.to_owned(),
        known: PRESETS.iter().map(|preset| preset.name).collect(),
    };
    let mut config = presets::base(preset).ok_or_else(unknown)?;
    let files = ReferenceFiles {
        horizon: Some(files.horizon.unwrap_or(config.data.horizon)),
        ..*files
    };
    let networks = reference_networks(&files)?;
    let diffusion = sizes(files.diffusion, &networks)?;
    config.mode = Mode::Reference;
    config.data.horizon = diffusion.horizon;
    config.networks.model_dim = diffusion.model_dim;
    config.networks.embedding_dim = diffusion.embedding_dim;
    config.networks.dim_mult.clone_from(&diffusion.dim_mult);
    config.networks.kernel_size = diffusion.kernel_size;
    if let Some(rnd) = &networks.rnd {
        let mut curiosity = presets::curiosity(preset);
        curiosity.out_dim = rnd.target.output_len();
        config.curiosity = Some(curiosity);
    }
    config.check()?;
    let episodes = Episodes::read(data)?;
    let width = episodes.observation_dim + episodes.action_dim;
    if width != diffusion.width {
        let (observation, action) = (episodes.observation_dim, episodes.action_dim);
        return Err(PlannerError::DatasetFit {
            what: "the number of observations and actions",
            expected: format!("{}, as in {}", diffusion.width, files.diffusion.display()),
            found: format!("{width} ({observation} and {action})"),
        });
    }
    let meta = meta(family, config, &episodes);
    Ok(PlannerFile {
        networks: weights(&files, networks, &meta)?,
        normalizer: Normalizer::fit(&episodes.observations, episodes.observation_dim),
        meta,
    })
}

fn sizes(path: &Path, networks: &ReferenceNetworks) -> Result<JannerConfig, PlannerError> {
    match &networks.diffusion.architecture {
        Architecture::Janner(config) => Ok(config.clone()),
        other => Err(mismatch(path, "a U-Net".to_owned(), other)),
    }
}

fn meta(family: &str, config: Config, episodes: &Episodes) -> PlannerMeta {
    let (action_low, action_high) = episodes.action_bounds();
    PlannerMeta {
        format: PlannerMeta::FORMAT,
        family: family.to_owned(),
        config,
        observation_dim: episodes.observation_dim,
        action_dim: episodes.action_dim,
        observation_order: episodes.observation_order.clone(),
        action_low,
        action_high,
        // The reference's reward network learns raw values.
        value_mean: 0.0,
        value_std: 1.0,
        n_updates: BTreeMap::new(),
        finished: true,
        dataset: Some(episodes.fingerprint()),
    }
}

/// The weights by name, of the networks that the settings ask for.
fn weights(
    files: &ReferenceFiles,
    networks: ReferenceNetworks,
    meta: &PlannerMeta,
) -> Result<BTreeMap<String, Weights>, PlannerError> {
    let mut found = vec![(network::DIFFUSION, files.diffusion, networks.diffusion)];
    if let (Some(path), Some(reward)) = (files.reward, networks.reward) {
        found.push((network::REWARD, path, reward));
    }
    if let (Some((predictor, target)), Some(rnd)) = (files.rnd, networks.rnd) {
        found.push((network::CURIOSITY_PREDICTOR, predictor, rnd.predictor));
        let random = ImportedNetwork {
            architecture: rnd.target,
            ema: rnd.target_weights.clone(),
            weights: rnd.target_weights,
        };
        found.push((network::CURIOSITY_TARGET, target, random));
    }
    let mut expected = meta.architectures();
    let mut weights = BTreeMap::new();
    for (name, path, network) in found {
        let wanted = expected.remove(name);
        if wanted.as_ref() != Some(&network.architecture) {
            return Err(mismatch(path, format!("{wanted:?}"), &network.architecture));
        }
        weights.insert(name.to_owned(), network.ema);
    }
    match expected.into_keys().next() {
        None => Ok(weights),
        Some(missing) => Err(PlannerError::Request {
            what: "the set of files",
            expected: format!("one of the network \"{missing}\" among them"),
            found: "without".to_owned(),
        }),
    }
}

fn mismatch(path: &Path, expected: String, found: &Architecture) -> PlannerError {
    PlannerError::Mismatch {
        path: path.to_owned(),
        what: "its network".to_owned(),
        expected,
        found: format!("{found:?}"),
    }
}
