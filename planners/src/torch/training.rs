//! Networks under training.

use tch::{TchError, Tensor};

use super::model::Model;
use super::network::{
    Kept, check_forward, check_length, forward, input_gradient, no_forward, of_weighted_sum,
};
use super::optimizer::Parameters;
use super::session::Session;
use crate::error::PlannerError;
use crate::nets::{Adam, Architecture, Network, TrainableNetwork, TrainingState, Weights};

/// A network whose weights are one flat tensor, so that an update is a handful of operations for all of them.
pub(super) struct TorchTrainable {
    session: Session,
    model: Model,
    parameters: Parameters,
    n_updates: u64,
    kept: Option<Kept>,
    gradient: Option<Tensor>,
}

impl TorchTrainable {
    pub(super) fn new(
        session: Session,
        architecture: &Architecture,
        state: TrainingState,
    ) -> Result<Self, PlannerError> {
        let model = Model::new(architecture)?;
        let flat = |weights: &Weights| {
            architecture.check_weights(weights)?;
            let mut all = Vec::with_capacity(weights.n_parameters());
            for spec in model.specs() {
                all.extend(weights.tensor(&spec.name, &spec.shape)?);
            }
            session.run(|| session.tensor(&all, &[all.len() as i64]))
        };
        let weights = flat(&state.weights)?;
        let parameters = Parameters {
            weights: session.run(|| weights.f_set_requires_grad(true))?,
            ema: flat(&state.ema)?,
            first_moment: flat(&state.first_moment)?,
            second_moment: flat(&state.second_moment)?,
        };
        Ok(Self {
            session,
            parameters,
            n_updates: state.n_updates,
            model,
            kept: None,
            gradient: None,
        })
    }

    /// The network's tensors as parts of the flat one: gradients by them come back as one flat tensor.
    fn split(&self) -> Result<Vec<Tensor>, TchError> {
        let specs = self.model.specs();
        let sizes: Vec<i64> = specs.iter().map(|spec| n_numbers(&spec.shape)).collect();
        let parts = self.parameters.weights.f_split_with_sizes(&sizes, 0)?;
        let shaped = parts.iter().zip(specs).map(|(part, spec)| {
            let shape: Vec<i64> = spec.shape.iter().map(|&size| size as i64).collect();
            part.f_view(shape.as_slice())
        });
        shaped.collect()
    }

    fn unflatten(&self, flat: &Tensor) -> Result<Weights, PlannerError> {
        let mut values = vec![0.0; flat.numel()];
        self.session
            .run(|| self.session.read(&flat.f_detach()?, &mut values))?;
        let mut weights = Weights::default();
        let mut rest = values.as_slice();
        for spec in self.model.specs() {
            let (own, others) = rest.split_at(spec.shape.iter().product());
            rest = others;
            let tensor = crate::nets::Tensor {
                shape: spec.shape.clone(),
                values: own.to_vec(),
            };
            weights.tensors.insert(spec.name.clone(), tensor);
        }
        Ok(weights)
    }
}

fn n_numbers(shape: &[usize]) -> i64 {
    shape.iter().map(|&size| size as i64).product()
}

impl Network for TorchTrainable {
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
        let session = self.session;
        self.kept = session.run(|| {
            let tensors = self.split()?;
            forward(&session, &self.model, &tensors, (x, t), keep, out)
        })?;
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

impl TrainableNetwork for TorchTrainable {
    fn backward(&mut self, cotangent: &[f32]) -> Result<f64, PlannerError> {
        self.gradient = None;
        // A refused cotangent leaves what was kept.
        if let Some(kept) = &self.kept {
            check_length("cotangent", kept.out.numel(), cotangent.len())?;
        }
        let kept = self.kept.take().ok_or(no_forward("backward"))?;
        let (session, weights) = (&self.session, &self.parameters.weights);
        let (gradient, norm) = session.run(|| {
            let gradient = of_weighted_sum(session, &kept.out, cotangent, weights)?;
            let norm = gradient.f_norm()?.f_double_value(&[])?;
            Ok((gradient, norm))
        })?;
        self.gradient = Some(gradient);
        Ok(norm)
    }

    fn update(&mut self, adam: &Adam, learning_rate: f64) -> Result<(), PlannerError> {
        let gradient = self.gradient.take().ok_or(PlannerError::Order {
            asked: "update",
            missing: "backward pass",
        })?;
        // What a forward pass kept belongs to the weights before.
        self.kept = None;
        let n_updates = self.n_updates + 1;
        let parameters = &mut self.parameters;
        self.session
            .run(|| parameters.update(&gradient, adam, learning_rate, n_updates))?;
        self.n_updates = n_updates;
        Ok(())
    }

    fn state(&self) -> Result<TrainingState, PlannerError> {
        Ok(TrainingState {
            weights: self.unflatten(&self.parameters.weights)?,
            ema: self.unflatten(&self.parameters.ema)?,
            first_moment: self.unflatten(&self.parameters.first_moment)?,
            second_moment: self.unflatten(&self.parameters.second_moment)?,
            n_updates: self.n_updates,
        })
    }
}
