//! The networks of [`Architecture`] as operations on tensors.

use tch::{TchError, Tensor};

use super::layers::{Block, Layer, Names};
use super::session::Session;
use crate::error::PlannerError;
use crate::nets::{Architecture, TensorSpec, TimestepEmbedding};

/// A network without its tensors.
#[derive(Debug)]
pub(super) struct Model {
    architecture: Architecture,
    /// Name and shape of every tensor, in the order in which they are handed in.
    specs: Vec<TensorSpec>,
    body: Body,
}

#[derive(Debug)]
enum Body {
    Janner(Time, Janner),
    HalfJanner(Time, HalfJanner),
    Mlp(Vec<Layer>),
}

/// Of a timestep the vector that every block takes.
#[derive(Debug)]
struct Time {
    embedding: TimestepEmbedding,
    embedding_dim: usize,
    layers: [Layer; 2],
}

/// Two blocks, then the layer that halves or doubles the length; the last level has none.
#[derive(Debug)]
struct Level {
    blocks: [Block; 2],
    resample: Option<Layer>,
}

#[derive(Debug)]
struct Janner {
    downs: Vec<Level>,
    middle: [Block; 2],
    ups: Vec<Level>,
    head: [Layer; 3],
    horizon: i64,
    width: i64,
}

#[derive(Debug)]
struct HalfJanner {
    downs: Vec<Level>,
    middle: [(Block, Layer); 2],
    head: [Layer; 2],
    horizon: i64,
    width: i64,
}

impl Model {
    pub(super) fn new(architecture: &Architecture) -> Result<Self, PlannerError> {
        let specs = architecture.tensors()?;
        let names = Names::new(specs.iter().map(|spec| spec.name.as_str()));
        let names = &names;
        let body = match architecture {
            Architecture::Janner(config) => {
                let time = time(names, config.embedding, config.embedding_dim)?;
                let n_levels = config.dim_mult.len();
                let network = Janner {
                    downs: levels(names, "downs", n_levels, n_levels - 1, 3)?,
                    middle: [names.block("mid_block1")?, names.block("mid_block2")?],
                    ups: levels(names, "ups", n_levels - 1, n_levels - 1, 3)?,
                    head: [
                        names.layer("final_conv.0")?,
                        names.layer("final_conv.1")?,
                        names.layer("final_conv.3")?,
                    ],
                    horizon: config.horizon as i64,
                    width: config.width as i64,
                };
                Body::Janner(time, network)
            }
            Architecture::HalfJanner(config) => {
                let time = time(names, config.embedding, config.embedding_dim)?;
                let n_levels = config.dim_mult.len();
                let middle = |name: &str| {
                    let block = names.block(&format!("{name}.0"))?;
                    Ok::<_, PlannerError>((block, names.layer(&format!("{name}.1.conv"))?))
                };
                let network = HalfJanner {
                    downs: levels(names, "downs", n_levels, n_levels - 1, 2)?,
                    middle: [middle("mid_block1")?, middle("mid_block2")?],
                    head: [names.layer("final_block.0")?, names.layer("final_block.2")?],
                    horizon: config.horizon as i64,
                    width: config.width as i64,
                };
                Body::HalfJanner(time, network)
            }
            Architecture::Mlp(config) => {
                let layers = 0..=config.hidden.len();
                let layers = layers.map(|layer| names.layer(&(2 * layer).to_string()));
                Body::Mlp(layers.collect::<Result<_, _>>()?)
            }
        };
        Ok(Self {
            architecture: architecture.clone(),
            specs,
            body,
        })
    }

    pub(super) fn architecture(&self) -> &Architecture {
        &self.architecture
    }

    pub(super) fn specs(&self) -> &[TensorSpec] {
        &self.specs
    }

    /// Of `x`, `(n, input_len)`, and timesteps the output `(n, output_len)`, with `tensors` in the order of
    /// [`Model::specs`].
    pub(super) fn forward(
        &self,
        session: &Session,
        tensors: &[Tensor],
        x: &Tensor,
        t: &[f32],
    ) -> Result<Tensor, TchError> {
        match &self.body {
            Body::Janner(time, network) => {
                let time = time.forward(session, tensors, t)?;
                network.forward(tensors, x, &time)
            }
            Body::HalfJanner(time, network) => {
                let time = time.forward(session, tensors, t)?;
                network.forward(tensors, x, &time)
            }
            Body::Mlp(layers) => {
                let (first, others) = layers.split_first().ok_or_else(no_layers)?;
                let mut out = first.linear(tensors, x)?;
                for layer in others {
                    out = layer.linear(tensors, &out.f_relu()?)?;
                }
                Ok(out)
            }
        }
    }
}

fn no_layers() -> TchError {
    TchError::Shape("a network without layers".to_owned())
}

fn time(
    names: &Names,
    embedding: TimestepEmbedding,
    embedding_dim: usize,
) -> Result<Time, PlannerError> {
    Ok(Time {
        embedding,
        embedding_dim,
        layers: [names.layer("map_emb.0")?, names.layer("map_emb.2")?],
    })
}

/// Levels `{way}.{level}`; the first `n_resampled` change the length by their part `{resample}.conv`.
fn levels(
    names: &Names,
    way: &str,
    n: usize,
    n_resampled: usize,
    resample: usize,
) -> Result<Vec<Level>, PlannerError> {
    let level = |level: usize| {
        let block = |part: usize| names.block(&format!("{way}.{level}.{part}"));
        let layer = format!("{way}.{level}.{resample}.conv");
        let resample = (level < n_resampled).then(|| names.layer(&layer));
        Ok(Level {
            blocks: [block(0)?, block(1)?],
            resample: resample.transpose()?,
        })
    };
    (0..n).map(level).collect()
}

impl Time {
    /// The vectors `(n, model_dim)`, or one for all if all timesteps are the same.
    fn forward(
        &self,
        session: &Session,
        tensors: &[Tensor],
        t: &[f32],
    ) -> Result<Tensor, TchError> {
        let is_same = t.windows(2).all(|pair| pair[0] == pair[1]);
        let t = if is_same { &t[..t.len().min(1)] } else { t };
        let mut embedded = vec![0.0; t.len() * self.embedding_dim];
        let rows = embedded.chunks_exact_mut(self.embedding_dim);
        for (row, &t) in rows.zip(t) {
            self.embedding.embed(t, row);
        }
        let shape = [t.len() as i64, self.embedding_dim as i64];
        let embedded = session.tensor(&embedded, &shape)?;
        let [first, second] = self.layers;
        second.linear(tensors, &first.linear(tensors, &embedded)?.f_mish()?)
    }
}

impl Level {
    fn blocks(&self, tensors: &[Tensor], x: &Tensor, time: &Tensor) -> Result<Tensor, TchError> {
        let [first, second] = &self.blocks;
        second.forward(tensors, &first.forward(tensors, x, time)?, time)
    }
}

/// Windows step by step to windows channel by channel.
fn by_channel(x: &Tensor, horizon: i64, width: i64) -> Result<Tensor, TchError> {
    x.f_view([-1, horizon, width])?
        .f_transpose(1, 2)?
        .f_contiguous()
}

impl Janner {
    fn forward(&self, tensors: &[Tensor], x: &Tensor, time: &Tensor) -> Result<Tensor, TchError> {
        let time = &time.f_mish()?;
        let mut out = by_channel(x, self.horizon, self.width)?;
        let mut skipped = Vec::with_capacity(self.downs.len());
        for level in &self.downs {
            out = level.blocks(tensors, &out, time)?;
            skipped.push(out.shallow_clone());
            if let Some(resample) = level.resample {
                out = resample.conv(tensors, &out, 2)?;
            }
        }
        for block in &self.middle {
            out = block.forward(tensors, &out, time)?;
        }
        // One level less than on the way down: what the first one kept is never used.
        for (level, skipped) in self.ups.iter().zip(skipped.iter().rev()) {
            out = Tensor::f_cat(&[&out, skipped], 1)?;
            out = level.blocks(tensors, &out, time)?;
            if let Some(resample) = level.resample {
                out = resample.upsample(tensors, &out)?;
            }
        }
        let [conv, norm, last] = self.head;
        out = norm.norm_and_mish(tensors, &conv.conv(tensors, &out, 1)?)?;
        out = last.conv(tensors, &out, 1)?;
        out.f_transpose(1, 2)?.f_flatten(1, -1)
    }
}

impl HalfJanner {
    fn forward(&self, tensors: &[Tensor], x: &Tensor, time: &Tensor) -> Result<Tensor, TchError> {
        let activated = &time.f_mish()?;
        let mut out = by_channel(x, self.horizon, self.width)?;
        for level in &self.downs {
            out = level.blocks(tensors, &out, activated)?;
            if let Some(resample) = level.resample {
                out = resample.conv(tensors, &out, 2)?;
            }
        }
        for (block, resample) in &self.middle {
            out = block.forward(tensors, &out, activated)?;
            out = resample.conv(tensors, &out, 2)?;
        }
        let flat = out.f_flatten(1, -1)?;
        let (n, _) = flat.size2()?;
        let time = time.f_expand([n, -1], false)?;
        let [first, second] = self.head;
        let out = first.linear(tensors, &Tensor::f_cat(&[&flat, &time], 1)?)?;
        second.linear(tensors, &out.f_mish()?)
    }
}
