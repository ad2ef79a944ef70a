//! Which networks there are.

use serde::{Deserialize, Serialize};

/// How a timestep becomes numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TimestepEmbedding {
    /// The reference's: the frequencies are cast to integers, so that only the first is not zero and the embedding is
    /// `[cos t, 1, …, 1, sin t, 0, …, 0]`.
    Integer,
    /// `[cos(t·f_k), sin(t·f_k)]` with f_k = 10000^(−2k/E) (Vaswani et al. 2017, section 3.5).
    Sinusoidal,
}

/// `JannerUNet1d`: a U-Net over the time axis, which maps a window to a window (Janner et al. 2022).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JannerConfig {
    /// Steps in a window, a power of two.
    pub horizon: usize,
    /// Numbers in a step: observation and action.
    pub width: usize,
    /// Channels of the first level.
    pub model_dim: usize,
    /// Numbers in the embedding of a timestep, even.
    pub embedding_dim: usize,
    /// Factors of the channels from level to level (cumulative product).
    pub dim_mult: Vec<usize>,
    /// Width of the convolutions, odd.
    pub kernel_size: usize,
    /// How a timestep becomes numbers.
    pub embedding: TimestepEmbedding,
}

/// `HalfJannerUNet1d`: the way down of such a U-Net, which maps a window to a few numbers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HalfJannerConfig {
    /// Steps in a window, a power of two.
    pub horizon: usize,
    /// Numbers in a step: observation and action.
    pub width: usize,
    /// Numbers in the output.
    pub out_dim: usize,
    /// Channels of the first level.
    pub model_dim: usize,
    /// Numbers in the embedding of a timestep, even.
    pub embedding_dim: usize,
    /// Factors of the channels from level to level (cumulative product).
    pub dim_mult: Vec<usize>,
    /// Width of the convolutions of the levels, odd; those of the middle are 5 wide.
    pub kernel_size: usize,
    /// How a timestep becomes numbers.
    pub embedding: TimestepEmbedding,
}

/// Linear layers with ReLU between them, over a whole window without a timestep (ReDiffuser's confidence).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MlpConfig {
    /// Numbers in the input.
    pub in_dim: usize,
    /// Numbers of each hidden layer.
    pub hidden: Vec<usize>,
    /// Numbers in the output.
    pub out_dim: usize,
}

/// A network and its sizes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Architecture {
    /// A window to a window.
    Janner(JannerConfig),
    /// A window to a few numbers.
    HalfJanner(HalfJannerConfig),
    /// A window, flat, to a few numbers.
    Mlp(MlpConfig),
}

impl Architecture {
    /// Numbers in an input window.
    pub fn input_len(&self) -> usize {
        match self {
            Self::Janner(config) => config.horizon * config.width,
            Self::HalfJanner(config) => config.horizon * config.width,
            Self::Mlp(config) => config.in_dim,
        }
    }

    /// Numbers in the output for one window.
    pub fn output_len(&self) -> usize {
        match self {
            Self::Janner(config) => config.horizon * config.width,
            Self::HalfJanner(config) => config.out_dim,
            Self::Mlp(config) => config.out_dim,
        }
    }
}
