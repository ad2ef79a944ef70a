//! The layers of the networks, which find their tensors among those of a network by number.

use std::collections::BTreeMap;

use tch::{TchError, Tensor};

use crate::error::PlannerError;
use crate::nets::n_groups;

/// Added to the variance by a group norm.
const EPSILON: f64 = 1e-5;

/// Numbers of a network's tensors by name.
pub(super) struct Names {
    by_name: BTreeMap<String, usize>,
}

impl Names {
    pub(super) fn new<'a>(names: impl Iterator<Item = &'a str>) -> Self {
        let by_name = names.enumerate().map(|(i, name)| (name.to_owned(), i));
        Self {
            by_name: by_name.collect(),
        }
    }

    fn number(&self, name: String) -> Result<usize, PlannerError> {
        let found = self.by_name.get(&name).copied();
        found.ok_or(PlannerError::MissingTensor { name })
    }

    /// The layer of a name, which has a `weight` and a `bias`.
    pub(super) fn layer(&self, name: &str) -> Result<Layer, PlannerError> {
        Ok(Layer {
            weight: self.number(format!("{name}.weight"))?,
            bias: self.number(format!("{name}.bias"))?,
        })
    }

    /// The residual block of a name.
    pub(super) fn block(&self, name: &str) -> Result<Block, PlannerError> {
        let layer = |part: &str| self.layer(&format!("{name}.{part}"));
        let residual = format!("{name}.residual_conv");
        let has_residual = self.by_name.contains_key(&format!("{residual}.weight"));
        Ok(Block {
            first: (layer("conv1.0")?, layer("conv1.1")?),
            time: layer("emb_mlp.1")?,
            second: (layer("conv2.0")?, layer("conv2.1")?),
            residual: has_residual.then(|| self.layer(&residual)).transpose()?,
        })
    }
}

/// A layer with a weight and a bias.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layer {
    weight: usize,
    bias: usize,
}

impl Layer {
    pub(super) fn linear(self, tensors: &[Tensor], x: &Tensor) -> Result<Tensor, TchError> {
        x.f_linear(&tensors[self.weight], Some(&tensors[self.bias]))
    }

    /// A convolution that keeps the length, or halves it with a stride of 2.
    pub(super) fn conv(
        self,
        tensors: &[Tensor],
        x: &Tensor,
        stride: i64,
    ) -> Result<Tensor, TchError> {
        let weight = &tensors[self.weight];
        let (_, _, taps) = weight.size3()?;
        x.f_conv1d(weight, Some(&tensors[self.bias]), stride, taps / 2, 1, 1)
    }

    /// The transposed convolution that doubles the length.
    pub(super) fn upsample(self, tensors: &[Tensor], x: &Tensor) -> Result<Tensor, TchError> {
        let bias = Some(&tensors[self.bias]);
        x.f_conv_transpose1d(&tensors[self.weight], bias, 2, 1, 0, 1, 1)
    }

    /// A group norm, then Mish.
    pub(super) fn norm_and_mish(self, tensors: &[Tensor], x: &Tensor) -> Result<Tensor, TchError> {
        let scale = &tensors[self.weight];
        let channels = usize::try_from(scale.size1()?).unwrap_or(0);
        let groups = n_groups(channels) as i64;
        let shift = Some(&tensors[self.bias]);
        x.f_group_norm(groups, Some(scale), shift, EPSILON, false)?
            .f_mish()
    }
}

/// A residual block.
#[derive(Debug)]
pub(super) struct Block {
    first: (Layer, Layer),
    time: Layer,
    second: (Layer, Layer),
    residual: Option<Layer>,
}

impl Block {
    /// `x` is (n, channels, length), `time` the timestep's vector after Mish, one for all or one each.
    pub(super) fn forward(
        &self,
        tensors: &[Tensor],
        x: &Tensor,
        time: &Tensor,
    ) -> Result<Tensor, TchError> {
        let (conv, norm) = self.first;
        let out = norm.norm_and_mish(tensors, &conv.conv(tensors, x, 1)?)?;
        let time = self.time.linear(tensors, time)?.f_unsqueeze(-1)?;
        let out = out.f_add(&time)?;
        let (conv, norm) = self.second;
        let out = norm.norm_and_mish(tensors, &conv.conv(tensors, &out, 1)?)?;
        match self.residual {
            Some(residual) => out.f_add(&residual.conv(tensors, x, 1)?),
            None => out.f_add(x),
        }
    }
}
