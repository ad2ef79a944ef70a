//! The tensors of every network: names as in a PyTorch state dict, shapes, and how many numbers go into one output.

use super::architecture::{Architecture, HalfJannerConfig, JannerConfig, MlpConfig};
use super::weights::Weights;
use crate::error::PlannerError;

/// What a tensor is for, which says how it starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TensorRole {
    /// Weight or bias of a linear layer or a convolution, with the number of inputs that PyTorch counts per output.
    Layer {
        /// PyTorch's `fan_in`.
        fan_in: usize,
    },
    /// Scale of a group norm.
    NormScale,
    /// Shift of a group norm.
    NormShift,
}

/// Name, shape and role of a tensor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorSpec {
    /// Its name, such as `downs.0.0.conv1.0.weight`.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// What it is for.
    pub role: TensorRole,
}

/// Tensors in order of execution.
#[derive(Default)]
struct List {
    tensors: Vec<TensorSpec>,
}

impl List {
    fn push(&mut self, name: String, shape: Vec<usize>, role: TensorRole) {
        self.tensors.push(TensorSpec { name, shape, role });
    }

    fn layer(&mut self, name: &str, weight: Vec<usize>, outputs: usize) {
        // PyTorch counts the second axis also for a transposed convolution, whose first one is the input.
        let fan_in = weight[1..].iter().product();
        let role = TensorRole::Layer { fan_in };
        self.push(format!("{name}.weight"), weight, role);
        self.push(format!("{name}.bias"), vec![outputs], role);
    }

    fn linear(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.layer(name, vec![outputs, inputs], outputs);
    }

    fn conv(&mut self, name: &str, inputs: usize, outputs: usize, taps: usize) {
        self.layer(name, vec![outputs, inputs, taps], outputs);
    }

    fn norm(&mut self, name: &str, channels: usize) {
        let scale = format!("{name}.weight");
        self.push(scale, vec![channels], TensorRole::NormScale);
        let shift = format!("{name}.bias");
        self.push(shift, vec![channels], TensorRole::NormShift);
    }

    fn time(&mut self, embedding_dim: usize, model_dim: usize) {
        self.linear("map_emb.0", embedding_dim, 4 * model_dim);
        self.linear("map_emb.2", 4 * model_dim, model_dim);
    }

    /// A residual block from `inputs` to `outputs` channels.
    fn block(&mut self, name: &str, inputs: usize, outputs: usize, time: usize, taps: usize) {
        self.conv(&format!("{name}.conv1.0"), inputs, outputs, taps);
        self.norm(&format!("{name}.conv1.1"), outputs);
        self.linear(&format!("{name}.emb_mlp.1"), time, outputs);
        self.conv(&format!("{name}.conv2.0"), outputs, outputs, taps);
        self.norm(&format!("{name}.conv2.1"), outputs);
        if inputs != outputs {
            self.conv(&format!("{name}.residual_conv"), inputs, outputs, 1);
        }
    }

    /// The levels of the way down; `down` is the index of the downsampling within a level.
    fn levels(&mut self, channels: &[usize], width: usize, taps: usize, down: usize) {
        let time = channels_of_time(&self.tensors);
        let mut inputs = width;
        for (level, &outputs) in channels.iter().enumerate() {
            self.block(&format!("downs.{level}.0"), inputs, outputs, time, taps);
            self.block(&format!("downs.{level}.1"), outputs, outputs, time, taps);
            if level + 1 < channels.len() {
                self.conv(&format!("downs.{level}.{down}.conv"), outputs, outputs, 3);
            }
            inputs = outputs;
        }
    }
}

/// Outputs of the layer that was pushed last: the time network's.
fn channels_of_time(tensors: &[TensorSpec]) -> usize {
    tensors.last().map_or(0, |bias| bias.shape[0])
}

impl JannerConfig {
    fn tensors(&self) -> Vec<TensorSpec> {
        let channels = self.channels();
        let (time, taps) = (self.model_dim, self.kernel_size);
        let mut list = List::default();
        list.time(self.embedding_dim, time);
        list.levels(&channels, self.width, taps, 3);
        let last = channels[channels.len() - 1];
        list.block("mid_block1", last, last, time, taps);
        list.block("mid_block2", last, last, time, taps);
        for (level, pair) in channels.windows(2).rev().enumerate() {
            let (outputs, inputs) = (pair[0], pair[1]);
            let first = format!("ups.{level}.0");
            list.block(&first, 2 * inputs, outputs, time, taps);
            let second = format!("ups.{level}.1");
            list.block(&second, outputs, outputs, time, taps);
            let up = format!("ups.{level}.3.conv");
            list.layer(&up, vec![outputs, outputs, 4], outputs);
        }
        let first = channels[0];
        list.conv("final_conv.0", first, self.model_dim, 5);
        list.norm("final_conv.1", self.model_dim);
        list.conv("final_conv.3", self.model_dim, self.width, 1);
        list.tensors
    }
}

impl HalfJannerConfig {
    fn tensors(&self) -> Vec<TensorSpec> {
        let channels = self.channels();
        let time = self.model_dim;
        let mut list = List::default();
        list.time(self.embedding_dim, time);
        list.levels(&channels, self.width, self.kernel_size, 2);
        let last = channels[channels.len() - 1];
        let [half, quarter] = self.middle_channels();
        list.block("mid_block1.0", last, half, time, 5);
        list.conv("mid_block1.1.conv", half, half, 3);
        list.block("mid_block2.0", half, quarter, time, 5);
        list.conv("mid_block2.1.conv", quarter, quarter, 3);
        let flat = self.flat_len();
        list.linear("final_block.0", flat + time, flat / 2);
        list.linear("final_block.2", flat / 2, self.out_dim);
        list.tensors
    }
}

impl MlpConfig {
    fn tensors(&self) -> Vec<TensorSpec> {
        let mut list = List::default();
        for (index, (inputs, outputs)) in self.layers().into_iter().enumerate() {
            list.linear(&(2 * index).to_string(), inputs, outputs);
        }
        list.tensors
    }
}

impl Architecture {
    /// Its tensors in order of execution.
    ///
    /// # Errors
    /// As [`Architecture::validate`].
    pub fn tensors(&self) -> Result<Vec<TensorSpec>, PlannerError> {
        self.validate()?;
        Ok(self.specs())
    }

    /// Its tensors, if its sizes are possible.
    pub(super) fn specs(&self) -> Vec<TensorSpec> {
        match self {
            Self::Janner(config) => config.tensors(),
            Self::HalfJanner(config) => config.tensors(),
            Self::Mlp(config) => config.tensors(),
        }
    }

    /// Refuses weights that are not this network's: a tensor that is missing, has another shape, is not known, or
    /// has other than finite numbers.
    ///
    /// # Errors
    /// Names the tensor.
    pub fn check_weights(&self, weights: &Weights) -> Result<(), PlannerError> {
        let specs = self.tensors()?;
        for spec in &specs {
            let values = weights.tensor(&spec.name, &spec.shape)?;
            let expected: usize = spec.shape.iter().product();
            if values.len() != expected {
                return Err(PlannerError::Length {
                    what: "a tensor",
                    expected,
                    found: values.len(),
                });
            }
            if let Some(index) = values.iter().position(|value| !value.is_finite()) {
                return Err(PlannerError::WeightNotFinite {
                    name: spec.name.clone(),
                    index,
                    found: values[index],
                });
            }
        }
        if weights.tensors.len() == specs.len() {
            return Ok(());
        }
        let known: std::collections::BTreeSet<&str> =
            specs.iter().map(|spec| spec.name.as_str()).collect();
        match weights
            .tensors
            .keys()
            .find(|name| !known.contains(name.as_str()))
        {
            None => Ok(()),
            Some(name) => Err(PlannerError::UnknownTensor { name: name.clone() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::nets::{Architecture, HalfJannerConfig, JannerConfig, MlpConfig, TimestepEmbedding};

    fn janner(width: usize, model_dim: usize, horizon: usize, dim_mult: &[usize]) -> Architecture {
        Architecture::Janner(JannerConfig {
            horizon,
            width,
            model_dim,
            embedding_dim: model_dim,
            dim_mult: dim_mult.to_vec(),
            kernel_size: 5,
            embedding: TimestepEmbedding::Integer,
        })
    }

    fn half(
        width: usize,
        (model_dim, embedding_dim): (usize, usize),
        horizon: usize,
        dim_mult: &[usize],
        out_dim: usize,
    ) -> Architecture {
        Architecture::HalfJanner(HalfJannerConfig {
            horizon,
            width,
            out_dim,
            model_dim,
            embedding_dim,
            dim_mult: dim_mult.to_vec(),
            kernel_size: 3,
            embedding: TimestepEmbedding::Integer,
        })
    }

    fn count(architecture: &Architecture) -> usize {
        let tensors = architecture.tensors().unwrap();
        let numbers = tensors
            .iter()
            .map(|spec| spec.shape.iter().product::<usize>());
        numbers.sum()
    }

    #[test]
    fn parameter_counts_are_the_published_ones() {
        let m4 = [1, 2, 2, 2];
        let m3 = [1, 4, 2];
        assert_eq!(count(&janner(14, 32, 32, &m4)), 3_956_302);
        assert_eq!(count(&janner(23, 32, 32, &m4)), 3_958_327);
        assert_eq!(count(&janner(23, 32, 4, &m3)), 3_685_943);
        assert_eq!(count(&janner(39, 64, 64, &m4)), 15_800_423);
        assert_eq!(count(&half(14, (32, 32), 32, &m4, 1)), 1_488_801);
        assert_eq!(count(&half(23, (32, 32), 4, &m3, 64)), 1_413_184);
        assert_eq!(count(&half(39, (64, 64), 64, &m4, 1)), 5_968_065);
        assert_eq!(count(&half(14, (16, 32), 32, &[1, 2], 64)), 29_528);
        assert_eq!(count(&half(23, (16, 32), 4, &[1, 2], 64)), 28_652);
        assert_eq!(count(&half(39, (32, 64), 64, &[1, 2], 64)), 124_432);
        assert_eq!(janner(14, 32, 32, &m4).tensors().unwrap().len(), 196);
        assert_eq!(half(39, (64, 64), 64, &m4, 1).tensors().unwrap().len(), 130);
    }

    #[test]
    fn impossible_settings_are_named() {
        let cases = [
            (janner(14, 32, 24, &[1, 2]), "horizon"),
            (janner(14, 32, 2, &[1, 2, 2]), "horizon"),
            (janner(14, 33, 32, &[1]), "embedding_dim"),
            (janner(0, 32, 32, &[1]), "width of a step"),
            (janner(14, 32, 32, &[]), "dim_mult"),
            (janner(14, 2, 32, &[1]), "channels of a level"),
            (janner(14, 34, 32, &[1]), "channels of a level"),
            (janner(14, 32, 32, &[1, usize::MAX]), "channels of a level"),
            // A target half as wide as the smallest possible: its middle would have no group.
            (half(14, (4, 32), 32, &[1, 2], 64), "channels of the middle"),
        ];
        for (architecture, what) in cases {
            let error = architecture.tensors().unwrap_err().to_string();
            assert!(error.starts_with(what), "{error}");
        }
        let empty = Architecture::Mlp(MlpConfig {
            in_dim: 3,
            hidden: vec![0],
            out_dim: 1,
        });
        assert!(empty.tensors().is_err());
    }
}
