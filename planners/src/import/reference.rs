//! The files of a planner that the reference implementation trained.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::error::ImportError;
use super::shapes::{Shapes, mlp};
use super::state_dict::{StateDicts, read_state_dicts};
use crate::model::network;
use crate::nets::{Architecture, Weights};

/// A network of one of the files.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportedNetwork {
    /// The file.
    pub path: PathBuf,
    /// Which network.
    pub architecture: Architecture,
    /// Its weights after the last update.
    pub weights: Weights,
    /// The moving average of its weights, with which the reference plans; the weights themselves where it keeps none.
    pub ema: Weights,
}

/// Reads the files of a planner, in any order, and makes sure that they belong together. Which file is which is told
/// by its tensors:
///
/// | file | network, by its name in [`crate::model::network`] |
/// |---|---|
/// | `diffusion_ckpt_*.pt` | diffusion model |
/// | `classifier_ckpt_*.pt` of one output | reward network |
/// | `classifier_ckpt_*.pt` of more | predictor of the curiosity |
/// | `rnd_classifier_target.pt` | target of the curiosity |
/// | ReDiffuser's `rnd_ckpt_*.pt` | predictor and target of the confidence |
///
/// The files hold neither the statistics that normalize observations, which a dataset gives, nor the state of an
/// optimizer, so that nothing can train on. `horizon` is the steps in a window: a U-Net fits windows of any length,
/// so the files tell it only now and then.
///
/// # Errors
/// Those of [`read_state_dicts`]; networks that the reference does not have; two of a kind, or none of the diffusion
/// model; files that do not go together; a horizon that the files do not fit, or that none was given where they leave
/// it open.
pub fn reference_networks(
    paths: &[PathBuf],
    horizon: Option<usize>,
) -> Result<BTreeMap<&'static str, ImportedNetwork>, ImportError> {
    let mut parts: BTreeMap<&'static str, Part> = BTreeMap::new();
    for path in paths {
        for part in Part::of_file(path)? {
            if let Some(first) = parts.get(part.name) {
                let first = first.path.display();
                return Err(part.error(format!(
                    "a second network \"{}\", beside {first}",
                    part.name
                )));
            }
            parts.insert(part.name, part);
        }
    }
    let Some(diffusion) = parts.get(network::DIFFUSION) else {
        return Err(ImportError::Missing {
            network: network::DIFFUSION,
        });
    };
    let horizon = common_horizon(diffusion, parts.values(), horizon)?;
    for (predictor, target) in [
        (network::CURIOSITY_PREDICTOR, network::CURIOSITY_TARGET),
        (network::CONFIDENCE_PREDICTOR, network::CONFIDENCE_TARGET),
    ] {
        match (parts.get(predictor), parts.get(target)) {
            (None, None) => {}
            (Some(_), None) => return Err(ImportError::Missing { network: target }),
            (None, Some(_)) => return Err(ImportError::Missing { network: predictor }),
            (Some(predictor), Some(target)) => {
                let [expected, found] =
                    [predictor, target].map(|part| part.architecture(horizon).output_len());
                if found != expected {
                    let file = predictor.path.display();
                    return Err(
                        target.error(format!("{found} outputs, expected {expected} as in {file}"))
                    );
                }
            }
        }
    }
    parts
        .into_iter()
        .map(|(name, part)| Ok((name, part.network(horizon)?)))
        .collect()
}

/// What the tensors of a network tell of it.
enum Form {
    /// A U-Net or half of one, its horizon still open.
    Unet(Shapes),
    /// Linear layers.
    Mlp(Architecture),
}

/// A network of a file, its horizon still open.
struct Part<'a> {
    path: &'a Path,
    /// Its name in a planner's file.
    name: &'static str,
    form: Form,
    weights: Weights,
    ema: Weights,
}

impl<'a> Part<'a> {
    /// The networks of a file: one, or predictor and target of ReDiffuser's confidence.
    fn of_file(path: &'a Path) -> Result<Vec<Self>, ImportError> {
        let StateDicts { model, model_ema } = read_state_dicts(path)?;
        let has = |prefix: &str| model.tensors.keys().any(|name| name.starts_with(prefix));
        let Some(ema) = model_ema else {
            if has("predictor.") || has("target.") {
                return Self::confidence(path, model);
            }
            let ema = model.clone();
            return Ok(vec![Self::half(
                path,
                Some(network::CURIOSITY_TARGET),
                model,
                ema,
            )?]);
        };
        if !has("diffusion.") {
            return Ok(vec![Self::half(path, None, model, ema)?]);
        }
        let name = network::DIFFUSION;
        // The diffusion model holds its network as `diffusion`.
        let [model, ema] = [model, ema].map(|weights| -> Result<_, ImportError> {
            let mut halves = split(path, weights, &["diffusion"])?;
            Ok(halves.remove("diffusion").unwrap_or_default())
        });
        let (weights, ema) = (model?, ema?);
        let shapes = Shapes::of_unet(&weights);
        Ok(vec![Self {
            path,
            name,
            form: Form::Unet(shapes.map_err(|problem| not(path, name, &problem))?),
            weights,
            ema,
        }])
    }

    /// Half a U-Net. Without a name it is the reward network or the curiosity's predictor, by its outputs.
    fn half(
        path: &'a Path,
        name: Option<&'static str>,
        weights: Weights,
        ema: Weights,
    ) -> Result<Self, ImportError> {
        let shapes = Shapes::of_half(&weights);
        let shapes =
            shapes.map_err(|problem| not(path, name.unwrap_or(network::REWARD), &problem))?;
        let by_outputs = match shapes.out_dim() {
            Some(1) => network::REWARD,
            _ => network::CURIOSITY_PREDICTOR,
        };
        Ok(Self {
            path,
            name: name.unwrap_or(by_outputs),
            form: Form::Unet(shapes),
            weights,
            ema,
        })
    }

    /// ReDiffuser's predictor and target, each of linear layers over a whole window.
    fn confidence(path: &'a Path, model: Weights) -> Result<Vec<Self>, ImportError> {
        let mut halves = split(path, model, &["predictor", "target"])?;
        let mut part = |prefix: &str, name| -> Result<_, ImportError> {
            let weights = halves.remove(prefix).unwrap_or_default();
            let architecture = mlp(&weights).map_err(|problem| not(path, name, &problem))?;
            Ok(Self {
                path,
                name,
                form: Form::Mlp(architecture),
                ema: weights.clone(),
                weights,
            })
        };
        Ok(vec![
            part("predictor", network::CONFIDENCE_PREDICTOR)?,
            part("target", network::CONFIDENCE_TARGET)?,
        ])
    }

    /// Numbers in a step, or in a window of linear layers.
    fn width(&self) -> usize {
        match &self.form {
            Form::Unet(shapes) => shapes.width,
            Form::Mlp(architecture) => architecture.input_len(),
        }
    }

    fn architecture(&self, horizon: usize) -> Architecture {
        match &self.form {
            Form::Unet(shapes) => shapes.architecture(horizon),
            Form::Mlp(architecture) => architecture.clone(),
        }
    }

    fn network(self, horizon: usize) -> Result<ImportedNetwork, ImportError> {
        let architecture = self.architecture(horizon);
        for weights in [&self.weights, &self.ema] {
            let checked = architecture.check_weights(weights);
            checked.map_err(|source| ImportError::Weights {
                path: self.path.to_owned(),
                network: self.name,
                source: Box::new(source),
            })?;
        }
        Ok(ImportedNetwork {
            path: self.path.to_owned(),
            architecture,
            weights: self.weights,
            ema: self.ema,
        })
    }

    fn error(&self, problem: String) -> ImportError {
        ImportError::network(self.path, problem)
    }
}

fn not(path: &Path, name: &str, problem: &str) -> ImportError {
    ImportError::network(path, format!("not a network \"{name}\": {problem}"))
}

/// The tensors under each of some prefixes, under which all of them must stand.
fn split<'a>(
    path: &Path,
    weights: Weights,
    prefixes: &[&'a str],
) -> Result<BTreeMap<&'a str, Weights>, ImportError> {
    let mut parts: BTreeMap<&str, Weights> = BTreeMap::new();
    for (name, tensor) in weights.tensors {
        let found = prefixes.iter().find_map(|prefix| {
            let rest = name.strip_prefix(prefix)?.strip_prefix('.')?;
            Some((*prefix, rest.to_owned()))
        });
        let Some((prefix, rest)) = found else {
            let expected: Vec<String> = prefixes.iter().map(|p| format!("\"{p}.\"")).collect();
            let problem = format!(
                "tensor \"{name}\", expected {} before its name",
                expected.join(" or ")
            );
            return Err(ImportError::network(path, problem));
        };
        let part = parts.entry(prefix).or_default();
        part.tensors.insert(rest, tensor);
    }
    Ok(parts)
}

/// The horizon that all files fit.
fn common_horizon<'a, 'p: 'a>(
    diffusion: &'a Part<'p>,
    parts: impl Iterator<Item = &'a Part<'p>>,
    given: Option<usize>,
) -> Result<usize, ImportError> {
    if let Some(horizon) = given.filter(|horizon| !horizon.is_power_of_two()) {
        let problem = format!("a network for a power of two steps, expected {horizon}");
        return Err(diffusion.error(problem));
    }
    let (mut shortest, mut longest) = (1, usize::MAX);
    let width = diffusion.width();
    // The diffusion model is the one that the others must fit.
    for part in std::iter::once(diffusion).chain(parts) {
        let found = part.width();
        let fits = match &part.form {
            Form::Unet(_) => found == width,
            Form::Mlp(_) => found.is_multiple_of(width),
        };
        if !fits {
            let file = diffusion.path.display();
            return Err(part.error(format!(
                "a network for steps of {found} numbers, expected {width} as in {file}"
            )));
        }
        let (least, most) = match &part.form {
            Form::Unet(shapes) => shapes.horizons(),
            Form::Mlp(_) => (found / width, found / width),
        };
        let asked = given.unwrap_or_else(|| shortest.max(least));
        if asked < least || asked > most || least > longest || most < shortest {
            return Err(part.error(format!(
                "a network for horizons of {}, expected {asked}",
                range(least, most)
            )));
        }
        (shortest, longest) = (shortest.max(least), longest.min(most));
    }
    match given {
        Some(horizon) => Ok(horizon),
        None if shortest == longest => Ok(shortest),
        None => Err(diffusion.error(format!(
            "the files leave the horizon open ({}): say which",
            range(shortest, longest)
        ))),
    }
}

fn range(least: usize, most: usize) -> String {
    match most {
        _ if least == most => least.to_string(),
        usize::MAX => format!("{least} and more"),
        _ => format!("{least} to {most}"),
    }
}
