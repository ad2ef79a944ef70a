//! The files of a planner that the reference implementation trained.

use std::collections::BTreeMap;
use std::path::Path;

use super::error::ImportError;
use super::shapes::{Shapes, mlp};
use super::state_dict::{StateDicts, read_state_dicts};
use crate::nets::{Architecture, Weights};

/// Which files.
#[derive(Debug, Clone, Copy)]
pub struct ReferenceFiles<'a> {
    /// `diffusion_ckpt_*.pt`.
    pub diffusion: &'a Path,
    /// `classifier_ckpt_*.pt` of the reward network.
    pub reward: Option<&'a Path>,
    /// `classifier_ckpt_*.pt` of the RND predictor, and `rnd_classifier_target.pt`.
    pub rnd: Option<(&'a Path, &'a Path)>,
    /// Steps in a window. A U-Net fits windows of any length, so the files tell it only now and then.
    pub horizon: Option<usize>,
}

/// A network, its weights, and their moving average, with which the reference plans.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportedNetwork {
    /// Which network.
    pub architecture: Architecture,
    /// Its weights after the last update.
    pub weights: Weights,
    /// The moving average of its weights.
    pub ema: Weights,
}

/// Random network distillation: a network that was trained to predict a random one.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportedRnd {
    /// The network that was trained.
    pub predictor: ImportedNetwork,
    /// Which network it predicts.
    pub target: Architecture,
    /// Weights of the network that it predicts.
    pub target_weights: Weights,
}

/// The networks of a planner.
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceNetworks {
    /// Of a window with noise the window without.
    pub diffusion: ImportedNetwork,
    /// The return to expect.
    pub reward: Option<ImportedNetwork>,
    /// The novelty of a window.
    pub rnd: Option<ImportedRnd>,
}

/// Reads the files of a planner and makes sure that they belong together. They hold neither the statistics that
/// normalize observations, which a dataset gives, nor the state of an optimizer, so that nothing can train on.
///
/// # Errors
/// Those of [`read_state_dicts`]; networks that the reference does not have; files that do not go together; a
/// horizon that the files do not fit, or that none was given where they leave it open.
pub fn reference_networks(files: &ReferenceFiles) -> Result<ReferenceNetworks, ImportError> {
    let diffusion = Part::trained(files.diffusion, Kind::Diffusion)?;
    let reward = files.reward.map(|path| Part::trained(path, Kind::Reward));
    let reward = reward.transpose()?;
    let rnd = files.rnd.map(|(predictor, target)| {
        let predictor = Part::trained(predictor, Kind::Predictor)?;
        Ok((predictor, Part::bare(target)?))
    });
    let rnd = rnd.transpose()?;
    if let Some((predictor, target)) = &rnd {
        let (expected, found) = (predictor.shapes.out_dim(), target.shapes.out_dim());
        if expected != found {
            return Err(target.error(format!(
                "{} outputs, expected {} as in {}",
                found.unwrap_or(0),
                expected.unwrap_or(0),
                predictor.path.display()
            )));
        }
    }
    let mut parts = vec![&diffusion];
    parts.extend(&reward);
    parts.extend(
        rnd.iter()
            .flat_map(|(predictor, target)| [predictor, target]),
    );
    let horizon = horizon(&parts, files.horizon)?;
    Ok(ReferenceNetworks {
        diffusion: diffusion.network(horizon)?,
        reward: reward.map(|part| part.network(horizon)).transpose()?,
        rnd: match rnd {
            None => None,
            Some((predictor, target)) => {
                let predictor = predictor.network(horizon)?;
                let target = target.network(horizon)?;
                Some(ImportedRnd {
                    predictor,
                    target: target.architecture,
                    target_weights: target.weights,
                })
            }
        },
    })
}

/// Reads ReDiffuser's `rnd_ckpt_*.pt`: predictor and target, each of linear layers over a whole window.
///
/// # Errors
/// As [`reference_networks`].
pub fn reference_confidence(path: &Path) -> Result<ImportedRnd, ImportError> {
    let StateDicts { model, model_ema } = read_state_dicts(path)?;
    if model_ema.is_some() {
        return Err(ImportError::network(
            path,
            "holds \"model_ema\", expected none",
        ));
    }
    let mut halves: BTreeMap<&str, Weights> = BTreeMap::new();
    for (name, tensor) in model.tensors {
        let half = ["predictor", "target"].into_iter().find_map(|half| {
            let rest = name.strip_prefix(half)?.strip_prefix('.')?;
            Some((half, rest.to_owned()))
        });
        let Some((half, rest)) = half else {
            let problem = format!("tensor \"{name}\", expected \"predictor.\" or \"target.\"");
            return Err(ImportError::network(path, problem));
        };
        halves.entry(half).or_default().tensors.insert(rest, tensor);
    }
    let mut half = |half: &str| {
        let weights = halves.remove(half).unwrap_or_default();
        let problem = |problem| ImportError::network(path, format!("{half}: {problem}"));
        let architecture = mlp(&weights).map_err(problem)?;
        check(path, "network of linear layers", &architecture, &weights)?;
        Ok((architecture, weights))
    };
    let (architecture, weights) = half("predictor")?;
    let (target, target_weights) = half("target")?;
    let sides = |a: &Architecture| (a.input_len(), a.output_len());
    if sides(&architecture) != sides(&target) {
        let problem = "predictor and target differ in inputs or outputs";
        return Err(ImportError::network(path, problem));
    }
    Ok(ImportedRnd {
        predictor: ImportedNetwork {
            architecture,
            ema: weights.clone(),
            weights,
        },
        target,
        target_weights,
    })
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Diffusion,
    Reward,
    Predictor,
    Target,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Diffusion => "diffusion U-Net",
            Self::Reward => "reward network",
            Self::Predictor => "RND predictor",
            Self::Target => "RND target",
        }
    }
}

/// One file, whose horizon is still open.
struct Part<'a> {
    path: &'a Path,
    kind: Kind,
    shapes: Shapes,
    weights: Weights,
    ema: Weights,
}

impl<'a> Part<'a> {
    /// A file of weights and their moving average.
    fn trained(path: &'a Path, kind: Kind) -> Result<Self, ImportError> {
        let StateDicts { model, model_ema } = read_state_dicts(path)?;
        let Some(mut ema) = model_ema else {
            let problem = format!(
                "not a {}: it has no \"model\" and \"model_ema\"",
                kind.name()
            );
            return Err(ImportError::network(path, problem));
        };
        let mut weights = model;
        if kind == Kind::Diffusion {
            weights = without_prefix(path, weights)?;
            ema = without_prefix(path, ema)?;
        }
        Self::new(path, kind, weights, ema)
    }

    /// A file of weights alone.
    fn bare(path: &'a Path) -> Result<Self, ImportError> {
        let StateDicts { model, model_ema } = read_state_dicts(path)?;
        if model_ema.is_some() {
            let problem = "not an RND target: it has a \"model_ema\"; is it the predictor?";
            return Err(ImportError::network(path, problem));
        }
        Self::new(path, Kind::Target, model.clone(), model)
    }

    fn new(
        path: &'a Path,
        kind: Kind,
        weights: Weights,
        ema: Weights,
    ) -> Result<Self, ImportError> {
        let shapes = match kind {
            Kind::Diffusion => Shapes::of_unet(&weights),
            _ => Shapes::of_half(&weights),
        };
        let shapes = shapes.map_err(|problem| {
            ImportError::network(path, format!("not a {}: {problem}", kind.name()))
        })?;
        let part = Self {
            path,
            kind,
            shapes,
            weights,
            ema,
        };
        match (kind, part.shapes.out_dim()) {
            (Kind::Reward, Some(n)) if n != 1 => Err(part.error(format!(
                "{n} outputs, expected 1 of a reward network; is it an RND predictor?"
            ))),
            _ => Ok(part),
        }
    }

    fn network(self, horizon: usize) -> Result<ImportedNetwork, ImportError> {
        let architecture = self.shapes.architecture(horizon);
        check(self.path, self.kind.name(), &architecture, &self.weights)?;
        check(self.path, self.kind.name(), &architecture, &self.ema)?;
        Ok(ImportedNetwork {
            architecture,
            weights: self.weights,
            ema: self.ema,
        })
    }

    fn error(&self, problem: String) -> ImportError {
        ImportError::network(self.path, problem)
    }
}

fn check(
    path: &Path,
    network: &'static str,
    architecture: &Architecture,
    weights: &Weights,
) -> Result<(), ImportError> {
    architecture
        .check_weights(weights)
        .map_err(|source| ImportError::Weights {
            path: path.to_owned(),
            network,
            source: Box::new(source),
        })
}

/// The diffusion model holds its network as `diffusion`.
fn without_prefix(path: &Path, weights: Weights) -> Result<Weights, ImportError> {
    let mut bare = Weights::default();
    for (name, tensor) in weights.tensors {
        let Some(rest) = name.strip_prefix("diffusion.") else {
            let problem = format!("tensor \"{name}\", expected \"diffusion.\" before its name");
            return Err(ImportError::network(path, problem));
        };
        bare.tensors.insert(rest.to_owned(), tensor);
    }
    Ok(bare)
}

/// The horizon that all files fit.
fn horizon(parts: &[&Part], given: Option<usize>) -> Result<usize, ImportError> {
    let first = parts[0];
    let (mut shortest, mut longest) = first.shapes.horizons();
    for part in parts {
        if part.shapes.width != first.shapes.width {
            return Err(part.error(format!(
                "steps of {} numbers, expected {} as in {}",
                part.shapes.width,
                first.shapes.width,
                first.path.display()
            )));
        }
        let (least, most) = part.shapes.horizons();
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
        None => Err(first.error(format!(
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
