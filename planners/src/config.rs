//! Everything that can be set about a diffusion planner, in one typed table.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::data::Subset;
use crate::error::PlannerError;
use crate::nets::{Architecture, HalfJannerConfig, JannerConfig, MlpConfig, TimestepEmbedding};

/// Whether the reference's defects are kept or mended; `docs/planners.md` lists them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// As the reference computes.
    Reference,
    /// As it ought to.
    Corrected,
}

/// What rewards become before they are discounted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RewardRule {
    /// D4RL's running robots: the last reward of a terminated episode is replaced by `terminal_penalty`.
    Locomotion,
    /// Mazes: `reward_offset` is added to every reward, and the last one is replaced by `goal_bonus` where the episode
    /// ends at its goal, else by `terminal_penalty`.
    Goal,
}

/// Windows and values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Steps in a window and in a plan, a power of two.
    pub horizon: usize,
    /// Steps of the longest episode.
    pub max_path_length: usize,
    /// Discount γ of the values.
    pub discount: f64,
    /// What rewards become.
    pub rule: RewardRule,
    /// See [`RewardRule`].
    pub terminal_penalty: f64,
    /// See [`RewardRule`].
    pub goal_bonus: f64,
    /// See [`RewardRule`].
    pub reward_offset: f64,
}

/// Sizes of the networks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Channels of the first level, at least 16 and a multiple of 16.
    pub model_dim: usize,
    /// Numbers in the embedding of a timestep, even.
    pub embedding_dim: usize,
    /// Factors of the channels from level to level.
    pub dim_mult: Vec<usize>,
    /// Width of the convolutions of the diffusion model, odd.
    pub kernel_size: usize,
    /// Width of the convolutions of the classifiers, odd.
    pub classifier_kernel_size: usize,
}

/// Training of the diffusion model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiffusionConfig {
    /// Timesteps of the diffusion process.
    pub n_timesteps: usize,
    /// Updates.
    pub n_updates: u64,
    /// Windows in an update.
    pub batch_size: usize,
    /// Learning rate of the first update; it falls to 0 on a cosine.
    pub learning_rate: f64,
    /// AdamW's weight decay.
    pub weight_decay: f64,
    /// Rate of the moving average of the weights.
    pub ema_rate: f64,
    /// Weight of the action of the first row in the loss.
    pub action_loss_weight: f64,
}

/// Training of the reward network, on the windows of the diffusion model's updates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RewardConfig {
    /// Updates of the diffusion model for one of the reward network.
    pub interval: u64,
    /// Learning rate of the first update; it falls to 0 on a cosine.
    pub learning_rate: f64,
    /// L2 term of Adam's gradient.
    pub weight_decay: f64,
    /// Rate of the moving average of the weights.
    pub ema_rate: f64,
}

/// Training of Curiosity-Diffuser's random network distillation on noised windows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CuriosityConfig {
    /// Updates.
    pub n_updates: u64,
    /// Windows in an update.
    pub batch_size: usize,
    /// Learning rate of the first update; it falls to 0 on a cosine.
    pub learning_rate: f64,
    /// Rate of the moving average of the weights.
    pub ema_rate: f64,
    /// Numbers in the networks' output.
    pub out_dim: usize,
    /// Which episodes it is trained on.
    pub subset: Subset,
}

/// What ReDiffuser's confidence is trained on, and how it measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ConfidenceRule {
    /// As compared in Curiosity-Diffuser's paper: windows of the dataset, mean of the squared differences.
    Windows,
    /// The original's: states of plans that Diffuser generated, L2 norm of the difference.
    Plans,
}

/// ReDiffuser's random network distillation on clean plans, and the choice by it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConfidenceConfig {
    /// What it is trained on and how it measures.
    pub rule: ConfidenceRule,
    /// Updates.
    pub n_updates: u64,
    /// Plans in an update.
    pub batch_size: usize,
    /// Learning rate, constant.
    pub learning_rate: f64,
    /// Numbers of each hidden layer of the predictor.
    pub hidden: Vec<usize>,
    /// Numbers of each hidden layer of the target.
    pub target_hidden: Vec<usize>,
    /// Numbers in the networks' output.
    pub out_dim: usize,
    /// Plans to generate, with [`ConfidenceRule::Plans`].
    pub n_plans: usize,
    /// Best candidates by value among which the choice is made.
    pub top_candidates: usize,
    /// Scale s of the choice: probabilities are softmax(−s·u).
    pub scaling: f64,
}

/// How noise is taken away.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    /// Ancestral sampling (Ho et al. 2020).
    Ddpm,
    /// Deterministic (Song et al. 2021).
    Ddim,
}

/// Planning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanningConfig {
    /// How noise is taken away.
    pub solver: Solver,
    /// Denoising steps.
    pub sampling_steps: usize,
    /// Candidates per plan.
    pub n_candidates: usize,
    /// Factor of the initial noise.
    pub temperature: f64,
    /// Weight of guidance w_cg.
    pub guidance_weight: f64,
    /// Weight of curiosity λ inside the guidance.
    pub curiosity_weight: f64,
}

/// Everything about a diffusion planner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Whether the reference's defects are kept.
    pub mode: Mode,
    /// Windows and values.
    pub data: DataConfig,
    /// Sizes of the networks.
    pub networks: NetworkConfig,
    /// Training of the diffusion model.
    pub diffusion: DiffusionConfig,
    /// Training of the reward network.
    pub reward: RewardConfig,
    /// Curiosity-Diffuser only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub curiosity: Option<CuriosityConfig>,
    /// ReDiffuser only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub confidence: Option<ConfidenceConfig>,
    /// Planning.
    pub planning: PlanningConfig,
    /// Updates between two checkpoints.
    pub checkpoint_interval: u64,
}

impl Config {
    /// The same with other values. Tables are nested as in the configuration itself.
    ///
    /// # Errors
    /// An unknown name, a value of another kind, or values that do not go together.
    pub fn with_overrides(&self, overrides: &Map<String, Value>) -> Result<Self, PlannerError> {
        let mut table = self.to_json();
        merge(&mut table, overrides, "")?;
        let config: Self = serde_json::from_value(Value::Object(table))
            .map_err(|source| self.wrong_kind(overrides, &source))?;
        config.check()?;
        Ok(config)
    }

    /// The error of the first override that is of another kind than the preset's value.
    fn wrong_kind(
        &self,
        overrides: &Map<String, Value>,
        source: &serde_json::Error,
    ) -> PlannerError {
        let mut leaves = Vec::new();
        flatten(overrides, &mut Vec::new(), &mut leaves);
        for (path, value) in leaves {
            let mut table = Value::Object(self.to_json());
            let mut slot = Some(&mut table);
            for key in &path {
                slot = slot.and_then(|slot| slot.get_mut(key));
            }
            let Some(slot) = slot else { continue };
            let preset = std::mem::replace(slot, value.clone());
            if let Err(error) = serde_json::from_value::<Self>(table) {
                return PlannerError::Setting {
                    name: path.join("."),
                    expected: format!("a value of the kind of {preset}"),
                    found: format!("{value} ({error})"),
                };
            }
        }
        PlannerError::Setting {
            name: "overrides".to_owned(),
            expected: "values of the kinds of the preset's".to_owned(),
            found: source.to_string(),
        }
    }

    /// Whether the reward network learns from every pair of a prediction and a value, as the reference's does on mazes:
    /// Minari's values come without the last axis, D4RL's with it, and only the former broadcast.
    pub fn broadcasts_values(&self) -> bool {
        self.mode == Mode::Reference && self.data.rule == RewardRule::Goal
    }

    /// The configuration as a table.
    pub fn to_json(&self) -> Map<String, Value> {
        match serde_json::to_value(self) {
            Ok(Value::Object(table)) => table,
            _ => unreachable!("a configuration is a table of numbers, strings and lists"),
        }
    }

    /// How a timestep becomes numbers.
    pub fn embedding(&self) -> TimestepEmbedding {
        match self.mode {
            Mode::Reference => TimestepEmbedding::Integer,
            Mode::Corrected => TimestepEmbedding::Sinusoidal,
        }
    }

    /// The diffusion model for rows of `width` numbers.
    pub fn diffusion_network(&self, width: usize) -> Architecture {
        Architecture::Janner(JannerConfig {
            horizon: self.data.horizon,
            width,
            model_dim: self.networks.model_dim,
            embedding_dim: self.networks.embedding_dim,
            dim_mult: self.networks.dim_mult.clone(),
            kernel_size: self.networks.kernel_size,
            embedding: self.embedding(),
        })
    }

    /// The reward network, or with more outputs the predictor of the curiosity.
    pub fn classifier_network(&self, width: usize, out_dim: usize) -> Architecture {
        Architecture::HalfJanner(HalfJannerConfig {
            horizon: self.data.horizon,
            width,
            out_dim,
            model_dim: self.networks.model_dim,
            embedding_dim: self.networks.embedding_dim,
            dim_mult: self.networks.dim_mult.clone(),
            kernel_size: self.networks.classifier_kernel_size,
            embedding: self.embedding(),
        })
    }

    /// The fixed random target of the curiosity: half as wide, two levels.
    pub fn target_network(&self, width: usize, out_dim: usize) -> Architecture {
        Architecture::HalfJanner(HalfJannerConfig {
            horizon: self.data.horizon,
            width,
            out_dim,
            model_dim: self.networks.model_dim / 2,
            embedding_dim: self.networks.embedding_dim,
            dim_mult: vec![1, 2],
            kernel_size: self.networks.classifier_kernel_size,
            embedding: self.embedding(),
        })
    }
}

impl ConfidenceConfig {
    /// Predictor and target for windows of `horizon` rows.
    pub fn networks(
        &self,
        horizon: usize,
        width: usize,
        observation_dim: usize,
    ) -> [Architecture; 2] {
        let in_dim = match self.rule {
            ConfidenceRule::Windows => horizon * width,
            ConfidenceRule::Plans => horizon * observation_dim,
        };
        [&self.hidden, &self.target_hidden].map(|hidden| {
            Architecture::Mlp(MlpConfig {
                in_dim,
                hidden: hidden.clone(),
                out_dim: self.out_dim,
            })
        })
    }
}

/// Puts `overrides` into `table`, whose names are all there are.
fn merge(
    table: &mut Map<String, Value>,
    overrides: &Map<String, Value>,
    prefix: &str,
) -> Result<(), PlannerError> {
    for (key, value) in overrides {
        let name = format!("{prefix}{key}");
        let known: Vec<String> = table.keys().cloned().collect();
        match (table.get_mut(key), value) {
            (None, _) => return Err(PlannerError::UnknownSetting { name, known }),
            (Some(Value::Object(inner)), Value::Object(overrides)) => {
                merge(inner, overrides, &format!("{name}."))?;
            }
            (Some(slot), value) => *slot = value.clone(),
        }
    }
    Ok(())
}

/// The values of nested tables with the names that lead to them.
fn flatten<'a>(
    table: &'a Map<String, Value>,
    path: &mut Vec<&'a str>,
    leaves: &mut Vec<(Vec<&'a str>, &'a Value)>,
) {
    for (key, value) in table {
        path.push(key);
        match value {
            Value::Object(inner) => flatten(inner, path, leaves),
            value => leaves.push((path.clone(), value)),
        }
        path.pop();
    }
}

mod check;

pub(crate) use check::MOST;
