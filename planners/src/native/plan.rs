//! A network as a list of steps over one buffer, and where its parameters lie.

use super::geometry::{self, Kind, Pass};
use super::norm::Sizes;
use super::panels::n_words;
use super::product::{PANEL, n_panels};
use super::winograd;
use crate::nets::{Architecture, TimestepEmbedding};

/// A convolution or a linear layer. Offsets are into the parameters, which a whole network has in one piece.
#[derive(Debug)]
pub(super) struct Layer {
    pub(super) kind: Kind,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    /// Positions of its input.
    pub(super) length: usize,
    /// Where its weights start: `[panel][tap][input][PANEL]`.
    pub(super) weights: usize,
    /// Where its bias starts, `n_panels·PANEL` numbers.
    pub(super) bias: usize,
    /// Where the weights for the way back start, in a piece of their own: `[panel of inputs][tap][output][PANEL]`.
    pub(super) transposed: usize,
    pub(super) forward: Vec<Pass>,
    pub(super) backward: Vec<Pass>,
    /// Where its weights in half the bytes start, in a piece of their own for either way.
    pub(super) halves: [usize; 2],
    /// If it can be computed by Winograd.
    pub(super) winograd: Option<Transformed>,
}

/// Where a layer's transformed weights lie, in a piece of their own for either way.
#[derive(Debug)]
pub(super) struct Transformed {
    pub(super) points: usize,
    pub(super) start: usize,
}

impl Layer {
    pub(super) fn output_length(&self) -> usize {
        self.kind.output_length(self.length)
    }

    pub(super) fn n_weights(&self) -> usize {
        n_panels(self.outputs) * self.kind.taps() * self.inputs * PANEL
    }

    pub(super) fn n_transposed(&self) -> usize {
        n_panels(self.inputs) * self.kind.taps() * self.outputs * PANEL
    }

    /// Words of its weights in half the bytes, forward and back.
    pub(super) fn n_halves(&self) -> [usize; 2] {
        [
            n_words(self.n_weights(), self.inputs),
            n_words(self.n_transposed(), self.outputs),
        ]
    }

    /// Where a weight lies.
    pub(super) fn weight(&self, tap: usize, input: usize, output: usize) -> usize {
        let row = output / PANEL * self.kind.taps() * self.inputs + tap * self.inputs + input;
        self.weights + row * PANEL + output % PANEL
    }
}

/// A group norm with the Mish after it.
#[derive(Debug)]
pub(super) struct Norm {
    pub(super) channels: usize,
    pub(super) groups: usize,
    pub(super) length: usize,
    pub(super) gain: usize,
    pub(super) shift: usize,
}

impl Norm {
    pub(super) fn sizes(&self, samples: usize) -> Sizes {
        Sizes {
            length: self.length,
            samples,
            channels: self.channels,
            groups: self.groups,
        }
    }

    /// Gain and shift.
    pub(super) fn affine<'a>(&self, parameters: &'a [f32]) -> (&'a [f32], &'a [f32]) {
        let from = |start: usize| &parameters[start..][..self.channels];
        (from(self.gain), from(self.shift))
    }
}

/// `Mish(norm(conv2(Mish(norm(conv1(x))) + time))) + residual(x)`; numbers of layers and norms.
#[derive(Debug)]
pub(super) struct Block {
    pub(super) conv1: usize,
    pub(super) norm1: usize,
    /// Where its columns start in the output of [`Time::columns`].
    pub(super) time_column: usize,
    pub(super) conv2: usize,
    pub(super) norm2: usize,
    /// None: the identity.
    pub(super) residual: Option<usize>,
}

#[derive(Debug)]
pub(super) enum Step {
    Block(Block),
    Layer(usize),
    Norm(usize),
    Mish,
    Relu,
    /// Remembers the activations.
    Push,
    /// Puts the remembered ones after the present ones, channel by channel.
    Concat {
        length: usize,
        /// Of the present ones.
        channels: usize,
        /// Of the remembered ones.
        skip: usize,
    },
    /// All numbers of a sample in one row, channel by channel, and the time after them.
    Flatten {
        length: usize,
        channels: usize,
    },
}

/// `Linear(Mish(Linear(embedding)))`, and what every block makes of it, all in one layer.
#[derive(Debug)]
pub(super) struct Time {
    pub(super) embedding: TimestepEmbedding,
    pub(super) first: usize,
    pub(super) second: usize,
    /// The `emb_mlp` of all blocks, one after the other.
    pub(super) columns: usize,
}

/// Where a tensor of the state dict lies.
#[derive(Debug)]
pub(super) struct Place {
    pub(super) name: String,
    pub(super) shape: Vec<usize>,
    pub(super) what: What,
}

#[derive(Debug)]
pub(super) enum What {
    /// Weights of a layer, its columns from `column`. The tensor's axes are output, input, tap; those of a transposed
    /// convolution input, output, tap.
    Weight { layer: usize, column: usize },
    /// So many numbers from here.
    Run { start: usize, len: usize },
}

/// A network.
#[derive(Debug)]
pub(super) struct Plan {
    pub(super) layers: Vec<Layer>,
    pub(super) norms: Vec<Norm>,
    pub(super) time: Option<Time>,
    pub(super) steps: Vec<Step>,
    pub(super) places: Vec<Place>,
    /// Numbers in all parameters, with what fills up panels.
    pub(super) n_parameters: usize,
    /// Where the parameters of the norms start; they end with the others.
    pub(super) norms_start: usize,
    /// Numbers in all weights for the way back.
    pub(super) n_transposed: usize,
    /// Numbers in all weights for Winograd, one way.
    pub(super) n_winograd: usize,
    /// Words in all weights in half the bytes, forward and back.
    pub(super) n_halves: [usize; 2],
    /// Positions and channels of the input and of the output.
    pub(super) input: (usize, usize),
    pub(super) output: (usize, usize),
}

/// Builds a plan layer by layer.
#[derive(Default)]
pub(super) struct Builder {
    layers: Vec<Layer>,
    norms: Vec<Norm>,
    steps: Vec<Step>,
    places: Vec<Place>,
    n_weights: usize,
    n_transposed: usize,
    n_winograd: usize,
    n_halves: [usize; 2],
    /// Names of norms, whose parameters come after the weights of all layers.
    norm_names: Vec<String>,
    /// Names of the blocks' time layers, and their outputs.
    time_columns: Vec<(String, usize)>,
}

impl Builder {
    /// A layer that has a tensor of its own.
    pub(super) fn layer(
        &mut self,
        name: &str,
        kind: Kind,
        length: usize,
        sizes: (usize, usize),
    ) -> usize {
        let layer = self.bare_layer(kind, length, sizes);
        let (inputs, outputs) = sizes;
        let shape = match kind {
            Kind::Doubling => vec![inputs, outputs, kind.taps()],
            _ => vec![outputs, inputs, kind.taps()],
        };
        self.place(name, shape, layer, 0, outputs);
        layer
    }

    /// A linear layer.
    pub(super) fn linear(&mut self, name: &str, sizes: (usize, usize)) -> usize {
        let layer = self.bare_layer(Kind::Same { taps: 1 }, 1, sizes);
        self.place(name, vec![sizes.1, sizes.0], layer, 0, sizes.1);
        layer
    }

    fn bare_layer(
        &mut self,
        kind: Kind,
        length: usize,
        (inputs, outputs): (usize, usize),
    ) -> usize {
        let mut layer = Layer {
            kind,
            inputs,
            outputs,
            length,
            weights: self.n_weights,
            bias: 0,
            transposed: self.n_transposed,
            forward: geometry::forward(kind, length),
            backward: geometry::backward(kind, length),
            halves: self.n_halves,
            winograd: None,
        };
        for (sum, n) in self.n_halves.iter_mut().zip(layer.n_halves()) {
            *sum += n;
        }
        layer.winograd = winograd::n_points(&layer).map(|points| Transformed {
            points,
            start: self.n_winograd,
        });
        if let Some(winograd) = &layer.winograd {
            self.n_winograd += winograd.points * inputs * outputs;
        }
        layer.bias = layer.weights + layer.n_weights();
        self.n_weights = layer.bias + n_panels(outputs) * PANEL;
        self.n_transposed += layer.n_transposed();
        self.layers.push(layer);
        self.layers.len() - 1
    }

    fn place(
        &mut self,
        name: &str,
        shape: Vec<usize>,
        layer: usize,
        column: usize,
        outputs: usize,
    ) {
        let start = self.layers[layer].bias + column;
        self.places.push(Place {
            name: format!("{name}.weight"),
            shape,
            what: What::Weight { layer, column },
        });
        self.places.push(Place {
            name: format!("{name}.bias"),
            shape: vec![outputs],
            what: What::Run {
                start,
                len: outputs,
            },
        });
    }

    pub(super) fn norm(&mut self, name: &str, length: usize, channels: usize) -> usize {
        self.norm_names.push(name.to_owned());
        self.norms.push(Norm {
            channels,
            groups: crate::nets::n_groups(channels),
            length,
            gain: 0,
            shift: 0,
        });
        self.norms.len() - 1
    }

    /// A residual block.
    pub(super) fn block(&mut self, name: &str, taps: usize, length: usize, sizes: (usize, usize)) {
        let (inputs, outputs) = sizes;
        let kind = Kind::Same { taps };
        let conv1 = self.layer(&format!("{name}.conv1.0"), kind, length, sizes);
        let norm1 = self.norm(&format!("{name}.conv1.1"), length, outputs);
        let time_column = self.time_columns.iter().map(|(_, n)| n).sum();
        self.time_columns
            .push((format!("{name}.emb_mlp.1"), outputs));
        let conv2 = self.layer(&format!("{name}.conv2.0"), kind, length, (outputs, outputs));
        let norm2 = self.norm(&format!("{name}.conv2.1"), length, outputs);
        let residual = (inputs != outputs).then(|| {
            let name = format!("{name}.residual_conv");
            self.layer(&name, Kind::Same { taps: 1 }, length, sizes)
        });
        self.steps.push(Step::Block(Block {
            conv1,
            norm1,
            time_column,
            conv2,
            norm2,
            residual,
        }));
    }

    pub(super) fn step(&mut self, step: Step) {
        self.steps.push(step);
    }

    /// The time network, and the blocks' layers after it; comes after all blocks.
    pub(super) fn time(
        &mut self,
        embedding: TimestepEmbedding,
        embedding_dim: usize,
        dim: usize,
    ) -> Time {
        let first = self.linear("map_emb.0", (embedding_dim, 4 * dim));
        let second = self.linear("map_emb.2", (4 * dim, dim));
        let time_columns = std::mem::take(&mut self.time_columns);
        let total = time_columns.iter().map(|(_, outputs)| outputs).sum();
        let columns = self.bare_layer(Kind::Same { taps: 1 }, 1, (dim, total));
        let mut column = 0;
        for (name, outputs) in time_columns {
            self.place(&name, vec![outputs, dim], columns, column, outputs);
            column += outputs;
        }
        Time {
            embedding,
            first,
            second,
            columns,
        }
    }

    pub(super) fn finish(
        mut self,
        time: Option<Time>,
        input: (usize, usize),
        output: (usize, usize),
    ) -> Plan {
        let norms_start = self.n_weights;
        let mut end = norms_start;
        for (norm, name) in self.norms.iter_mut().zip(self.norm_names) {
            for (of, offset) in [("weight", &mut norm.gain), ("bias", &mut norm.shift)] {
                *offset = end;
                self.places.push(Place {
                    name: format!("{name}.{of}"),
                    shape: vec![norm.channels],
                    what: What::Run {
                        start: end,
                        len: norm.channels,
                    },
                });
                end += norm.channels.next_multiple_of(PANEL);
            }
        }
        Plan {
            layers: self.layers,
            norms: self.norms,
            time,
            steps: self.steps,
            places: self.places,
            n_parameters: end,
            norms_start,
            n_transposed: self.n_transposed,
            n_winograd: self.n_winograd,
            n_halves: self.n_halves,
            input,
            output,
        }
    }
}

impl Plan {
    /// The plan of a network that was validated.
    pub(super) fn new(architecture: &Architecture) -> Self {
        match architecture {
            Architecture::Janner(config) => super::unet::janner(config),
            Architecture::HalfJanner(config) => super::unet::half_janner(config),
            Architecture::Mlp(config) => mlp(config),
        }
    }
}

fn mlp(config: &crate::nets::MlpConfig) -> Plan {
    let mut builder = Builder::default();
    for (index, sizes) in config.layers().into_iter().enumerate() {
        if index > 0 {
            builder.step(Step::Relu);
        }
        let layer = builder.linear(&(2 * index).to_string(), sizes);
        builder.step(Step::Layer(layer));
    }
    builder.finish(None, (1, config.in_dim), (1, config.out_dim))
}
