//! Which network a set of weights belongs to, by the shapes of its tensors.

use crate::nets::{
    Architecture, HalfJannerConfig, JannerConfig, MlpConfig, TimestepEmbedding, Weights,
};

/// A U-Net or half of one, its horizon still open.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Shapes {
    pub(super) width: usize,
    model_dim: usize,
    embedding_dim: usize,
    dim_mult: Vec<usize>,
    kernel_size: usize,
    head: Head,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Head {
    /// A window.
    Window,
    /// A few numbers, out of a window that was halved to so many steps.
    Numbers { out_dim: usize, final_length: usize },
}

/// The shape of a tensor that must have so many dimensions.
fn shape<const N: usize>(weights: &Weights, name: &str) -> Result<[usize; N], String> {
    let Some(tensor) = weights.tensors.get(name) else {
        return Err(format!("tensor \"{name}\" is missing"));
    };
    tensor.shape.as_slice().try_into().map_err(|_| {
        let found = &tensor.shape;
        format!("tensor \"{name}\" has the shape {found:?}, expected {N} sizes")
    })
}

/// Levels of the way down that are looked for.
const MAX_LEVELS: usize = 16;

impl Shapes {
    /// Those of a `JannerUNet1d`.
    pub(super) fn of_unet(weights: &Weights) -> Result<Self, String> {
        Self::of(weights, |_| Ok(Head::Window))
    }

    /// Those of a `HalfJannerUNet1d`.
    pub(super) fn of_half(weights: &Weights) -> Result<Self, String> {
        Self::of(weights, |model_dim| {
            let [flat, _] = shape::<2>(weights, "final_block.0.weight").map(|[_, n]| [n, 0])?;
            let [channels, ..] = shape::<3>(weights, "mid_block2.1.conv.weight")?;
            let [out_dim, _] = shape::<2>(weights, "final_block.2.weight")?;
            let flat = flat.checked_sub(model_dim);
            let final_length = flat.and_then(|flat| flat.checked_div(channels));
            let final_length = final_length.filter(|&n| n.is_power_of_two());
            let final_length = final_length.ok_or_else(|| {
                format!(
                    "tensor \"final_block.0.weight\" does not take {channels} channels of a window"
                )
            })?;
            Ok(Head::Numbers {
                out_dim,
                final_length,
            })
        })
    }

    fn of(
        weights: &Weights,
        head: impl FnOnce(usize) -> Result<Head, String>,
    ) -> Result<Self, String> {
        let [_, embedding_dim] = shape(weights, "map_emb.0.weight")?;
        let [model_dim, _] = shape(weights, "map_emb.2.weight")?;
        let [_, width, kernel_size] = shape(weights, "downs.0.0.conv1.0.weight")?;
        let mut dim_mult = Vec::new();
        let mut before = model_dim;
        for level in 0..MAX_LEVELS {
            let name = format!("downs.{level}.0.conv1.0.weight");
            if !weights.tensors.contains_key(&name) {
                break;
            }
            let [channels, ..] = shape::<3>(weights, &name)?;
            if before == 0 || !channels.is_multiple_of(before) {
                return Err(format!(
                    "tensor \"{name}\" has {channels} channels, expected a multiple of {before}"
                ));
            }
            dim_mult.push(channels / before);
            before = channels;
        }
        Ok(Self {
            width,
            model_dim,
            embedding_dim,
            dim_mult,
            kernel_size,
            head: head(model_dim)?,
        })
    }

    /// Numbers in the output, if it is not a window.
    pub(super) fn out_dim(&self) -> Option<usize> {
        match self.head {
            Head::Window => None,
            Head::Numbers { out_dim, .. } => Some(out_dim),
        }
    }

    /// The shortest and the longest horizon that these shapes are for.
    pub(super) fn horizons(&self) -> (usize, usize) {
        let levels = self.dim_mult.len();
        match self.head {
            // Halved between levels, and doubled as often.
            Head::Window => (1 << levels.saturating_sub(1), usize::MAX),
            // The middle halves twice more; one step stays one.
            Head::Numbers {
                final_length: 1, ..
            } => (1, 1 << (levels + 1)),
            Head::Numbers { final_length, .. } => {
                let horizon = final_length.saturating_mul(1 << (levels + 1));
                (horizon, horizon)
            }
        }
    }

    /// The network, as the reference computes it.
    pub(super) fn architecture(&self, horizon: usize) -> Architecture {
        let (width, model_dim) = (self.width, self.model_dim);
        let (embedding_dim, kernel_size) = (self.embedding_dim, self.kernel_size);
        let dim_mult = self.dim_mult.clone();
        let embedding = TimestepEmbedding::Integer;
        match self.head {
            Head::Window => Architecture::Janner(JannerConfig {
                horizon,
                width,
                model_dim,
                embedding_dim,
                dim_mult,
                kernel_size,
                embedding,
            }),
            Head::Numbers { out_dim, .. } => Architecture::HalfJanner(HalfJannerConfig {
                horizon,
                width,
                out_dim,
                model_dim,
                embedding_dim,
                dim_mult,
                kernel_size,
                embedding,
            }),
        }
    }
}

/// The linear layers `0`, `2`, `4` and so on with ReLU between them.
pub(super) fn mlp(weights: &Weights) -> Result<Architecture, String> {
    let [first, in_dim] = shape(weights, "0.weight")?;
    let mut outputs = vec![first];
    for layer in 1..MAX_LEVELS {
        let name = format!("{}.weight", 2 * layer);
        if !weights.tensors.contains_key(&name) {
            break;
        }
        let [n, _] = shape(weights, &name)?;
        outputs.push(n);
    }
    let out_dim = outputs.pop().unwrap_or(first);
    Ok(Architecture::Mlp(MlpConfig {
        in_dim,
        hidden: outputs,
        out_dim,
    }))
}
