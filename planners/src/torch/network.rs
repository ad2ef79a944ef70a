//! Networks for inference.

use tch::{TchError, Tensor};

use super::model::Model;
use super::session::Session;
use crate::error::PlannerError;
use crate::nets::{Architecture, Network, Weights};

/// A network whose weights stay.
pub(super) struct TorchNetwork {
    session: Session,
    model: Model,
    tensors: Vec<Tensor>,
    kept: Option<Kept>,
}

/// What a gradient is taken of.
pub(super) struct Kept {
    pub(super) x: Tensor,
    pub(super) out: Tensor,
}

impl TorchNetwork {
    pub(super) fn new(
        session: Session,
        architecture: &Architecture,
        weights: &Weights,
    ) -> Result<Self, PlannerError> {
        architecture.check_weights(weights)?;
        let model = Model::new(architecture)?;
        let mut tensors = Vec::with_capacity(model.specs().len());
        for spec in model.specs() {
            let values = weights.tensor(&spec.name, &spec.shape)?;
            let shape: Vec<i64> = spec.shape.iter().map(|&size| size as i64).collect();
            tensors.push(session.run(|| session.tensor(values, &shape))?);
        }
        Ok(Self {
            session,
            model,
            tensors,
            kept: None,
        })
    }
}

impl Network for TorchNetwork {
    fn architecture(&self) -> &Architecture {
        self.model.architecture()
    }

    fn forward(
        &mut self,
        x: &[f32],
        t: &[f32],
        keep: bool,
        out: &mut [f32],
    ) -> Result<(), PlannerError> {
        self.kept = None;
        check_forward(self.model.architecture(), x, t, out)?;
        if t.is_empty() {
            return Ok(());
        }
        let (session, model, tensors) = (&self.session, &self.model, &self.tensors);
        self.kept = session.run(|| forward(session, model, tensors, (x, t), keep, out))?;
        Ok(())
    }

    fn input_gradient(
        &mut self,
        cotangent: &[f32],
        gradient: &mut [f32],
    ) -> Result<(), PlannerError> {
        input_gradient(&self.session, self.kept.take(), cotangent, gradient)
    }
}

/// Lengths that go together.
pub(super) fn check_forward(
    architecture: &Architecture,
    x: &[f32],
    t: &[f32],
    out: &[f32],
) -> Result<(), PlannerError> {
    check_length("x", t.len() * architecture.input_len(), x.len())?;
    check_length("out", t.len() * architecture.output_len(), out.len())
}

pub(super) fn check_length(
    what: &'static str,
    expected: usize,
    found: usize,
) -> Result<(), PlannerError> {
    if expected == found {
        return Ok(());
    }
    Err(PlannerError::Length {
        what,
        expected,
        found,
    })
}

/// Computes the output, and keeps what a gradient needs if it is to `keep`.
pub(super) fn forward(
    session: &Session,
    model: &Model,
    tensors: &[Tensor],
    (x, t): (&[f32], &[f32]),
    keep: bool,
    out: &mut [f32],
) -> Result<Option<Kept>, TchError> {
    let shape = [t.len() as i64, model.architecture().input_len() as i64];
    let x = session.tensor(x, &shape)?;
    if !keep {
        let result = tch::no_grad(|| model.forward(session, tensors, &x, t))?;
        session.read(&result, out)?;
        return Ok(None);
    }
    let x = x.f_set_requires_grad(true)?;
    let result = model.forward(session, tensors, &x, t)?;
    session.read(&result.f_detach()?, out)?;
    Ok(Some(Kept { x, out: result }))
}

/// Writes the gradient by `x` of Σ cotangent·out.
pub(super) fn input_gradient(
    session: &Session,
    kept: Option<Kept>,
    cotangent: &[f32],
    gradient: &mut [f32],
) -> Result<(), PlannerError> {
    let Kept { x, out } = kept.ok_or(no_forward("input_gradient"))?;
    check_length("cotangent", out.numel(), cotangent.len())?;
    check_length("gradient", x.numel(), gradient.len())?;
    session.run(|| {
        let by_x = of_weighted_sum(session, &out, cotangent, &x)?;
        session.read(&by_x, gradient)
    })
}

/// The gradient by `input` of Σ cotangent·out.
pub(super) fn of_weighted_sum(
    session: &Session,
    out: &Tensor,
    cotangent: &[f32],
    input: &Tensor,
) -> Result<Tensor, TchError> {
    let cotangent = session.tensor(cotangent, &out.size())?;
    let sum = out.f_mul(&cotangent)?.f_sum(tch::Kind::Float)?;
    let mut gradients = Tensor::f_run_backward(&[sum], &[input], false, false)?;
    let nothing = || TchError::Torch("no gradient came back".to_owned());
    gradients.pop().ok_or_else(nothing)
}

pub(super) fn no_forward(asked: &'static str) -> PlannerError {
    PlannerError::Order {
        asked,
        missing: "forward pass with `keep`",
    }
}
