//! Adam, AdamW and the moving average, as PyTorch computes them.

use tch::{TchError, Tensor};

use crate::nets::Adam;

/// Numbers that go through all operations while they are in a core's cache.
const BLOCK: i64 = 1 << 15;

/// All numbers that an update changes, each a flat tensor in the order of the network's tensors.
pub(super) struct Parameters {
    pub(super) weights: Tensor,
    pub(super) ema: Tensor,
    pub(super) first_moment: Tensor,
    pub(super) second_moment: Tensor,
}

impl Parameters {
    /// Update number `n_updates`, counted from 1 (Kingma and Ba 2015, algorithm 1; Loshchilov and Hutter 2019,
    /// algorithm 2).
    pub(super) fn update(
        &mut self,
        gradient: &Tensor,
        adam: &Adam,
        learning_rate: f64,
        n_updates: u64,
    ) -> Result<(), TchError> {
        let n_updates = n_updates as f64;
        let step = Step {
            adam,
            learning_rate,
            size: learning_rate / (1.0 - adam.beta1.powf(n_updates)),
            root: (1.0 - adam.beta2.powf(n_updates)).sqrt(),
        };
        let length = if self.weights.device().is_cuda() {
            i64::MAX
        } else {
            BLOCK
        };
        let n = self.weights.size1()?;
        tch::no_grad(|| {
            let mut start = 0;
            while start < n {
                let length = length.min(n - start);
                let part = |tensor: &Tensor| tensor.f_narrow(0, start, length);
                let mut block = Parameters {
                    weights: part(&self.weights)?,
                    ema: part(&self.ema)?,
                    first_moment: part(&self.first_moment)?,
                    second_moment: part(&self.second_moment)?,
                };
                step.apply(&mut block, part(gradient)?)?;
                start += length;
            }
            Ok(())
        })
    }
}

struct Step<'a> {
    adam: &'a Adam,
    learning_rate: f64,
    /// The learning rate over the first moment's bias.
    size: f64,
    /// Root of the second moment's bias.
    root: f64,
}

impl Step<'_> {
    /// `block` shares its numbers with the whole, so it is changed in place.
    fn apply(&self, block: &mut Parameters, gradient: Tensor) -> Result<(), TchError> {
        let adam = self.adam;
        let mut gradient = gradient;
        if adam.weight_decay != 0.0 {
            if adam.decoupled {
                let keep = 1.0 - self.learning_rate * adam.weight_decay;
                let _ = block.weights.f_mul_scalar_(keep)?;
            } else {
                let decay = block.weights.f_mul_scalar(adam.weight_decay)?;
                gradient = gradient.f_add(&decay)?;
            }
        }
        let _ = block.first_moment.f_lerp_(&gradient, 1.0 - adam.beta1)?;
        let mut square = gradient.f_square()?;
        let _ = square.f_mul_scalar_(1.0 - adam.beta2)?;
        let _ = block
            .second_moment
            .f_mul_scalar_(adam.beta2)?
            .f_add_(&square)?;
        let mut scale = block.second_moment.f_sqrt()?;
        let _ = scale
            .f_div_scalar_(self.root)?
            .f_add_scalar_(adam.epsilon)?;
        let mut change = block.first_moment.f_div(&scale)?;
        let _ = block.weights.f_sub_(&change.f_mul_scalar_(self.size)?)?;
        let _ = block.ema.f_lerp_(&block.weights, 1.0 - adam.ema_rate)?;
        Ok(())
    }
}
