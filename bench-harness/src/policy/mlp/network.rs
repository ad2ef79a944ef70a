//! The forward pass, in f32 with sums in one fixed order.

/// Outputs computed together. The lanes of a vector register hold different outputs, so that every sum runs in the
/// order of the inputs, however wide registers are.
const LANES: usize = 32;

/// A layer `y = W x + b`.
#[derive(Debug)]
pub(super) struct Dense {
    n_in: usize,
    n_out: usize,
    /// For every block of [`LANES`] outputs, one row per input; the last block is filled up with zeros.
    weights: Vec<[f32; LANES]>,
    biases: Vec<[f32; LANES]>,
}

impl Dense {
    /// Takes weights of shape `(n_out, n_in)`, row by row, and `n_out` biases; neither is 0.
    pub(super) fn new(weight: &[f32], bias: &[f32]) -> Self {
        let n_out = bias.len();
        let n_in = weight.len() / n_out;
        let n_blocks = n_out.div_ceil(LANES);
        let mut weights = vec![[0.0; LANES]; n_blocks * n_in];
        let mut biases = vec![[0.0; LANES]; n_blocks];
        for (output, (row, bias)) in weight.chunks_exact(n_in).zip(bias).enumerate() {
            let (block, lane) = (output / LANES, output % LANES);
            biases[block][lane] = *bias;
            for (input, value) in row.iter().enumerate() {
                weights[block * n_in + input][lane] = *value;
            }
        }
        Self {
            n_in,
            n_out,
            weights,
            biases,
        }
    }

    fn apply(&self, input: &[f32], output: &mut Vec<f32>) {
        output.clear();
        for (block, biases) in self.weights.chunks_exact(self.n_in).zip(&self.biases) {
            let mut sums = [0.0; LANES];
            for (x, column) in input.iter().zip(block) {
                for (sum, weight) in sums.iter_mut().zip(column) {
                    *sum += x * weight;
                }
            }
            output.extend(sums.iter().zip(biases).map(|(sum, bias)| sum + bias));
        }
        output.truncate(self.n_out);
    }
}

/// What follows every hidden layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Activation {
    Relu,
    Tanh,
}

impl Activation {
    fn apply(self, values: &mut [f32]) {
        match self {
            // Not `max`, which turns NaN into 0: a pass that overflowed is to be seen in the action.
            Self::Relu => values
                .iter_mut()
                .for_each(|x| *x = if *x < 0.0 { 0.0 } else { *x }),
            Self::Tanh => values.iter_mut().for_each(|x| *x = x.tanh()),
        }
    }
}

/// Where the logarithm of the standard deviation comes from.
#[derive(Debug)]
pub(super) enum LogStd {
    /// The policy has no distribution.
    None,
    /// The same for every observation.
    Fixed(Vec<f32>),
    /// A layer beside the one of the mean.
    Layer(Dense),
}

/// `clip((observation - mean) / scale, -clip, clip)`, in f64.
#[derive(Debug)]
pub(super) struct Normalization {
    pub(super) mean: Vec<f64>,
    /// √(variance + eps).
    pub(super) scale: Vec<f64>,
    pub(super) clip: f64,
}

/// How an action comes from the mean m and n ~ N(0, 1).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// tanh(m + exp(log_std) n), log_std held in [-20, 2] (soft actor-critic, Haarnoja et al. 2018).
    TanhGaussian,
    /// m + exp(log_std) n.
    Gaussian,
    /// m.
    Linear,
}

/// A policy's network.
#[derive(Debug)]
pub(in crate::policy) struct Network {
    pub(super) kind: Kind,
    pub(super) activation: Activation,
    pub(super) normalization: Option<Normalization>,
    pub(super) hidden: Vec<Dense>,
    pub(super) mean: Dense,
    pub(super) log_std: LogStd,
}

/// What a forward pass leaves, kept between passes so that none allocates.
#[derive(Debug, Default)]
pub(in crate::policy) struct Pass {
    input: Vec<f32>,
    output: Vec<f32>,
    mean: Vec<f32>,
    log_std: Vec<f32>,
}

impl Network {
    pub(in crate::policy) fn observation_dim(&self) -> usize {
        self.hidden.first().unwrap_or(&self.mean).n_in
    }

    pub(in crate::policy) fn action_dim(&self) -> usize {
        self.mean.n_out
    }

    pub(super) fn has_distribution(&self) -> bool {
        !matches!(self.log_std, LogStd::None)
    }

    /// Runs the network; an observation that is too short is filled up with zeros.
    pub(in crate::policy) fn forward(&self, observation: &[f64], pass: &mut Pass) {
        let padded = observation.iter().copied().chain(std::iter::repeat(0.0));
        let padded = padded.take(self.observation_dim());
        pass.input.clear();
        match &self.normalization {
            None => pass.input.extend(padded.map(|x| x as f32)),
            Some(norm) => {
                let scaled = padded.zip(norm.mean.iter().zip(&norm.scale));
                let scaled = scaled.map(|(x, (mean, scale))| (x - mean) / scale);
                let clipped = scaled.map(|x| x.clamp(-norm.clip, norm.clip) as f32);
                pass.input.extend(clipped);
            }
        }
        for layer in &self.hidden {
            layer.apply(&pass.input, &mut pass.output);
            self.activation.apply(&mut pass.output);
            std::mem::swap(&mut pass.input, &mut pass.output);
        }
        self.mean.apply(&pass.input, &mut pass.mean);
        match &self.log_std {
            LogStd::None => {}
            LogStd::Fixed(values) => pass.log_std.clone_from(values),
            LogStd::Layer(layer) => layer.apply(&pass.input, &mut pass.log_std),
        }
    }

    /// The action of the last pass without a draw, not clipped.
    pub(in crate::policy) fn mean_action(&self, pass: &Pass, action: &mut [f64]) {
        for (action, mean) in action.iter_mut().zip(&pass.mean) {
            *action = f64::from(self.squash(*mean));
        }
    }

    /// The action of the last pass with a draw of `normal` for each number, not clipped.
    pub(super) fn sampled_action(
        &self,
        pass: &Pass,
        mut normal: impl FnMut() -> f64,
        action: &mut [f64],
    ) {
        let outputs = pass.mean.iter().zip(&pass.log_std);
        for (action, (mean, log_std)) in action.iter_mut().zip(outputs) {
            let log_std = match self.kind {
                Kind::TanhGaussian => log_std.clamp(-20.0, 2.0),
                Kind::Gaussian | Kind::Linear => *log_std,
            };
            *action = f64::from(self.squash(mean + log_std.exp() * normal() as f32));
        }
    }

    fn squash(&self, value: f32) -> f32 {
        match self.kind {
            Kind::TanhGaussian => value.tanh(),
            Kind::Gaussian | Kind::Linear => value,
        }
    }
}
