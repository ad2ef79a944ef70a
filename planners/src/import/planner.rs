//! A planner of the reference's files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ksim_datasets::DatasetSource;

use super::reference::{ImportedNetwork, reference_networks};
use crate::algorithms::{CuriosityDiffuser, Diffuser, ReDiffuser};
use crate::config::{Config, Mode};
use crate::data::{Episodes, Normalizer};
use crate::error::PlannerError;
use crate::model::{PlannerFile, PlannerMeta, network};
use crate::nets::{Architecture, MlpConfig};
use crate::presets::{self, PRESETS};

/// What a planner is made of.
#[derive(Debug, Clone, Copy)]
pub struct ReferenceImport<'a> {
    /// The reference's files, in any order; see [`super::reference_networks`].
    pub files: &'a [PathBuf],
    /// Name of the preset that gives the settings that are not in the files: all but the sizes of the networks.
    pub preset: &'a str,
    /// Steps in a window; `None` takes the preset's.
    pub horizon: Option<usize>,
}

/// A planner, and the dataset and the file that each of its networks is from.
pub(super) struct Assembled {
    pub(super) planner: PlannerFile,
    pub(super) episodes: Episodes,
    pub(super) sources: Vec<(&'static str, PathBuf)>,
}

/// Makes a planner of the reference's files: `curiosity-diffuser` if its curiosity is among them, `rediffuser` if
/// ReDiffuser's confidence is, else `diffuser`. It plans as the reference does (mode `reference`), with the moving
/// averages of the weights. The dataset that the reference was trained on gives the statistics of observations and the
/// bounds of actions.
///
/// # Errors
/// Those of [`super::reference_networks`]; there is no reward network, no such preset, or files, preset and dataset do
/// not go together.
pub fn reference_planner(
    import: &ReferenceImport<'_>,
    data: &dyn DatasetSource,
) -> Result<PlannerFile, PlannerError> {
    Ok(assemble(import, data)?.planner)
}

pub(super) fn assemble(
    import: &ReferenceImport<'_>,
    data: &dyn DatasetSource,
) -> Result<Assembled, PlannerError> {
    let Some(mut config) = presets::base(import.preset) else {
        return Err(PlannerError::UnknownPreset {
            family: Diffuser::ID,
            name: import.preset.to_owned(),
            known: PRESETS.iter().map(|preset| preset.name).collect(),
        });
    };
    let horizon = import.horizon.unwrap_or(config.data.horizon);
    let networks = reference_networks(import.files, Some(horizon))?;
    let family = family(&networks)?;
    let width = adopt_sizes(&mut config, &networks, import.preset);
    config.check()?;
    let episodes = Episodes::read(data)?;
    let (observation, action) = (episodes.observation_dim, episodes.action_dim);
    if observation + action != width {
        let path = networks[network::DIFFUSION].path.display();
        return Err(PlannerError::DatasetFit {
            what: "the number of observations and actions",
            expected: format!("{width}, as in {path}"),
            found: format!("{} ({observation} and {action})", observation + action),
        });
    }
    let meta = meta(family, config, &episodes);
    let sources = networks.iter().map(|(name, one)| (*name, one.path.clone()));
    let sources = sources.collect();
    check_architectures(&networks, &meta)?;
    let averages = networks
        .into_iter()
        .map(|(name, one)| (name.to_owned(), one.ema));
    let planner = PlannerFile {
        networks: averages.collect(),
        normalizer: Normalizer::fit(&episodes.observations, observation),
        meta,
    };
    Ok(Assembled {
        planner,
        episodes,
        sources,
    })
}

/// Which planner the networks make.
fn family(
    networks: &BTreeMap<&'static str, ImportedNetwork>,
) -> Result<&'static str, PlannerError> {
    let curiosity = networks.get(network::CURIOSITY_PREDICTOR);
    match (curiosity, networks.get(network::CONFIDENCE_PREDICTOR)) {
        (None, None) => Ok(Diffuser::ID),
        (Some(_), None) => Ok(CuriosityDiffuser::ID),
        (None, Some(_)) => Ok(ReDiffuser::ID),
        (Some(curiosity), Some(confidence)) => Err(PlannerError::Request {
            what: "the set of files",
            expected: "those of one planner".to_owned(),
            found: format!(
                "{} of Curiosity-Diffuser and {} of ReDiffuser",
                curiosity.path.display(),
                confidence.path.display()
            ),
        }),
    }
}

/// Takes the sizes of the networks into the settings; returns the numbers in a step.
fn adopt_sizes(
    config: &mut Config,
    networks: &BTreeMap<&'static str, ImportedNetwork>,
    preset: &str,
) -> usize {
    config.mode = Mode::Reference;
    let mut width = 0;
    for (name, one) in networks {
        match (*name, &one.architecture) {
            (network::DIFFUSION, Architecture::Janner(sizes)) => {
                width = sizes.width;
                config.data.horizon = sizes.horizon;
                config.networks.model_dim = sizes.model_dim;
                config.networks.embedding_dim = sizes.embedding_dim;
                config.networks.dim_mult.clone_from(&sizes.dim_mult);
                config.networks.kernel_size = sizes.kernel_size;
            }
            (network::REWARD, Architecture::HalfJanner(sizes)) => {
                config.networks.classifier_kernel_size = sizes.kernel_size;
            }
            (network::CURIOSITY_TARGET, architecture) => {
                let curiosity = config.curiosity.insert(presets::curiosity(preset));
                curiosity.out_dim = architecture.output_len();
            }
            (network::CONFIDENCE_PREDICTOR, Architecture::Mlp(sizes)) => {
                confidence(config, preset).hidden.clone_from(&sizes.hidden);
            }
            (network::CONFIDENCE_TARGET, Architecture::Mlp(sizes)) => {
                let MlpConfig {
                    hidden, out_dim, ..
                } = sizes;
                let confidence = confidence(config, preset);
                confidence.target_hidden.clone_from(hidden);
                confidence.out_dim = *out_dim;
            }
            _ => {}
        }
    }
    width
}

fn confidence<'a>(config: &'a mut Config, preset: &str) -> &'a mut crate::config::ConfidenceConfig {
    let confidence = &mut config.confidence;
    confidence.get_or_insert_with(|| presets::confidence(preset))
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

/// That the networks are those that the settings ask for.
fn check_architectures(
    networks: &BTreeMap<&'static str, ImportedNetwork>,
    meta: &PlannerMeta,
) -> Result<(), PlannerError> {
    for (name, expected) in meta.architectures() {
        let Some(network) = networks.get(name) else {
            return Err(super::ImportError::Missing { network: name }.into());
        };
        if network.architecture != expected {
            return Err(PlannerError::Mismatch {
                path: network.path.clone(),
                what: format!("the network \"{name}\""),
                expected: format!("{expected:?}"),
                found: format!("{:?}", network.architecture),
            });
        }
    }
    Ok(())
}

/// The name of a file without its folders.
pub(super) fn file_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or(path.as_os_str());
    name.to_string_lossy().into_owned()
}
