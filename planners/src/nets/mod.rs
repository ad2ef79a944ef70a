//! The networks of the diffusion planners: what they are, and the interface behind which a backend computes them.
//!
//! A network maps windows `x` of the shape `(n, horizon, width)`, row by row with observation before action, and one
//! timestep per window to an output. [`Architecture`] says which network, [`Weights`] holds its tensors by the names
//! and in the shapes of a PyTorch state dict (`downs.0.0.conv1.0.weight`), a [`Backend`] makes something that
//! computes of both.

mod architecture;
mod embedding;
mod init;
mod levels;
mod tensors;
mod weights;

pub use architecture::{
    Architecture, HalfJannerConfig, JannerConfig, MlpConfig, TimestepEmbedding,
};
pub use init::initial_weights;
pub use levels::n_groups;
pub use tensors::{TensorRole, TensorSpec};
pub use weights::{Tensor, Weights};

use crate::error::PlannerError;

/// A network that computes outputs and gradients by its inputs.
pub trait Network: Send {
    /// Which network it is.
    fn architecture(&self) -> &Architecture;

    /// `out` of the shape `(n, `[`Architecture::output_len`]`)` for `x` of the shape
    /// `(n, `[`Architecture::input_len`]`)` and `t` of the shape `(n,)`. With `keep` the activations are kept for
    /// [`Network::input_gradient`].
    ///
    /// # Errors
    /// Lengths that do not go together.
    fn forward(
        &mut self,
        x: &[f32],
        t: &[f32],
        keep: bool,
        out: &mut [f32],
    ) -> Result<(), PlannerError>;

    /// Of the last forward pass with `keep`: writes to `gradient`, of the shape of its `x`, the gradient by `x` of
    /// Σ `cotangent`·`out`. May be called once per forward pass.
    ///
    /// # Errors
    /// Lengths that do not fit the last forward pass, or there was none.
    fn input_gradient(
        &mut self,
        cotangent: &[f32],
        gradient: &mut [f32],
    ) -> Result<(), PlannerError>;

    /// From now on a call's windows come in groups of `n`, such as the candidates of an environment. Backend native then
    /// computes each group as it would alone, to the last bit; without groups a call is one.
    fn in_groups_of(&mut self, _n: usize) {}

    /// Whether it computes on rayon's threads, so that it pays to ask several networks at a time.
    fn on_rayon(&self) -> bool {
        false
    }
}

/// A network under training, with its optimizer's moments and the moving average of its weights.
pub trait TrainableNetwork: Network {
    /// Of the last forward pass with `keep`: the gradient by all weights of Σ `cotangent`·`out`, in place of the one
    /// before. Returns its L2 norm.
    ///
    /// # Errors
    /// Lengths that do not fit the last forward pass, or there was none.
    fn backward(&mut self, cotangent: &[f32]) -> Result<f64, PlannerError>;

    /// One step of Adam with the gradient of the last [`TrainableNetwork::backward`], then of the moving average.
    ///
    /// # Errors
    /// There was no gradient.
    fn update(&mut self, adam: &Adam, learning_rate: f64) -> Result<(), PlannerError>;

    /// Weights, their moving average, and the optimizer's moments, to save and to go on from.
    ///
    /// # Errors
    /// The device does not give them.
    fn state(&self) -> Result<TrainingState, PlannerError>;
}

/// How a network is updated (Kingma and Ba 2015; decoupled decay: Loshchilov and Hutter 2019).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Adam {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// Weight decay per step.
    pub weight_decay: f64,
    /// AdamW's decay of the weights themselves; otherwise an L2 term in the gradient.
    pub decoupled: bool,
    /// Rate r of the moving average: p̄ ← r·p̄ + (1 − r)·p after every step.
    pub ema_rate: f64,
}

/// Everything a training goes on from.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingState {
    /// The weights.
    pub weights: Weights,
    /// Their moving average.
    pub ema: Weights,
    /// Adam's first moment; zero before the first step.
    pub first_moment: Weights,
    /// Adam's second moment.
    pub second_moment: Weights,
    /// Updates so far.
    pub n_updates: u64,
}

impl TrainingState {
    /// The first number that is not finite, with its place: a network that has diverged.
    pub fn not_finite(&self) -> Option<String> {
        let parts = [
            ("weights", &self.weights),
            ("average", &self.ema),
            ("first moment", &self.first_moment),
            ("second moment", &self.second_moment),
        ];
        parts.into_iter().find_map(|(part, weights)| {
            let is_finite = |tensor: &Tensor| tensor.values.iter().all(|value| value.is_finite());
            let wrong = weights.tensors.iter().find(|(_, one)| !is_finite(one));
            wrong.map(|(name, _)| format!("tensor \"{name}\" of the {part}"))
        })
    }

    /// The state before the first update.
    pub fn new(weights: Weights) -> Self {
        Self {
            ema: weights.clone(),
            first_moment: weights.zeros(),
            second_moment: weights.zeros(),
            weights,
            n_updates: 0,
        }
    }
}

/// Who computes networks.
pub trait Backend: Send + Sync {
    /// Its name: `native` or `torch`.
    fn name(&self) -> &'static str;

    /// A network for inference.
    ///
    /// # Errors
    /// Weights that are not the architecture's, or an architecture that the backend does not have.
    fn network(
        &self,
        architecture: &Architecture,
        weights: &Weights,
    ) -> Result<Box<dyn Network>, PlannerError>;

    /// A network for training.
    ///
    /// # Errors
    /// As [`Backend::network`].
    fn trainable(
        &self,
        architecture: &Architecture,
        state: TrainingState,
    ) -> Result<Box<dyn TrainableNetwork>, PlannerError>;
}
