//! Adam and AdamW, and the moving average of the weights, in one pass over the parameters.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use crate::nets::Adam;

/// Parameters that a thread takes at a time.
const BLOCK: usize = 1 << 14;

/// Everything that an update changes; laid out alike.
pub(super) struct Updated<'a> {
    pub(super) parameters: &'a mut [f32],
    pub(super) ema: &'a mut [f32],
    pub(super) first_moment: &'a mut [f32],
    pub(super) second_moment: &'a mut [f32],
}

/// Factors of one update, as PyTorch has them.
#[derive(Clone, Copy)]
struct Factors {
    beta1: f32,
    one_minus_beta1: f32,
    beta2: f32,
    one_minus_beta2: f32,
    epsilon: f32,
    /// learning rate / (1 − β1ⁿ)
    step: f32,
    /// √(1 − β2ⁿ)
    root_correction: f32,
    /// Decay within the gradient.
    l2: f32,
    /// What is left of the weights after decoupled decay.
    left: f32,
    ema: f32,
    one_minus_ema: f32,
}

impl Factors {
    fn new(adam: &Adam, learning_rate: f64, n: u64) -> Self {
        let n = n as f64;
        let (l2, left) = if adam.decoupled {
            (0.0, 1.0 - learning_rate * adam.weight_decay)
        } else {
            (adam.weight_decay, 1.0)
        };
        Self {
            beta1: adam.beta1 as f32,
            one_minus_beta1: (1.0 - adam.beta1) as f32,
            beta2: adam.beta2 as f32,
            one_minus_beta2: (1.0 - adam.beta2) as f32,
            epsilon: adam.epsilon as f32,
            step: (learning_rate / (1.0 - adam.beta1.powf(n))) as f32,
            root_correction: (1.0 - adam.beta2.powf(n)).sqrt() as f32,
            l2: l2 as f32,
            left: left as f32,
            ema: adam.ema_rate as f32,
            one_minus_ema: (1.0 - adam.ema_rate) as f32,
        }
    }
}

/// Update number `n`, counted from 1.
pub(super) fn update(
    updated: Updated<'_>,
    gradient: &[f32],
    adam: &Adam,
    learning_rate: f64,
    n: u64,
) {
    let factors = Factors::new(adam, learning_rate, n);
    let parameters = updated.parameters.par_chunks_mut(BLOCK);
    let moments = (
        updated.first_moment.par_chunks_mut(BLOCK),
        updated.second_moment.par_chunks_mut(BLOCK),
    );
    let averages = updated.ema.par_chunks_mut(BLOCK);
    let all = (
        parameters,
        averages,
        moments.0,
        moments.1,
        gradient.par_chunks(BLOCK),
    );
    all.into_par_iter()
        .for_each(|(parameters, ema, first_moment, second_moment, gradient)| {
            let updated = Updated {
                parameters,
                ema,
                first_moment,
                second_moment,
            };
            Arch::new().dispatch(Step {
                factors,
                updated,
                gradient,
            });
        });
}

/// An update of some parameters.
struct Step<'a> {
    factors: Factors,
    updated: Updated<'a>,
    gradient: &'a [f32],
}

impl WithSimd for Step<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Updated {
            parameters,
            ema,
            first_moment,
            second_moment,
        } = self.updated;
        let moments = first_moment.iter_mut().zip(second_moment);
        let weights = parameters.iter_mut().zip(ema);
        for (((p, average), (m, v)), g) in weights.zip(moments).zip(self.gradient) {
            one(self.factors, *g, (p, average), (m, v));
        }
    }
}

#[inline(always)]
fn one(
    f: Factors,
    gradient: f32,
    (p, average): (&mut f32, &mut f32),
    (m, v): (&mut f32, &mut f32),
) {
    let g = p.mul_add(f.l2, gradient);
    *m = f.beta1.mul_add(*m, f.one_minus_beta1 * g);
    *v = f.beta2.mul_add(*v, f.one_minus_beta2 * g * g);
    let root = v.sqrt() / f.root_correction + f.epsilon;
    *p = (*p * f.left) - f.step * (*m / root);
    *average = f.ema.mul_add(*average, f.one_minus_ema * *p);
}

/// The L2 norm of a gradient, the same for any number of threads.
pub(super) fn norm(gradient: &[f32]) -> f64 {
    let squares: Vec<f64> = gradient.par_chunks(BLOCK).map(sum_of_squares).collect();
    squares.iter().sum::<f64>().sqrt()
}

/// In as many strands as can be added at a time.
fn sum_of_squares(block: &[f32]) -> f64 {
    let (chunks, rest) = block.as_chunks::<16>();
    let mut strands = [0.0f64; 16];
    for chunk in chunks {
        for (strand, g) in strands.iter_mut().zip(chunk) {
            *strand += f64::from(*g) * f64::from(*g);
        }
    }
    let rest = rest.iter().map(|g| f64::from(*g) * f64::from(*g));
    strands.into_iter().chain(rest).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Adam and AdamW in f64, as in the papers.
    fn reference(adam: &Adam, learning_rate: f64, gradients: &[f64]) -> (f64, f64) {
        let (mut p, mut average, mut m, mut v) = (0.7f64, 0.7f64, 0.0, 0.0);
        for (index, gradient) in gradients.iter().enumerate() {
            let n = index as i32 + 1;
            let g = if adam.decoupled {
                p -= learning_rate * adam.weight_decay * p;
                *gradient
            } else {
                gradient + adam.weight_decay * p
            };
            m = adam.beta1 * m + (1.0 - adam.beta1) * g;
            v = adam.beta2 * v + (1.0 - adam.beta2) * g * g;
            let (m_hat, v_hat) = (
                m / (1.0 - adam.beta1.powi(n)),
                v / (1.0 - adam.beta2.powi(n)),
            );
            p -= learning_rate * m_hat / (v_hat.sqrt() + adam.epsilon);
            average = adam.ema_rate * average + (1.0 - adam.ema_rate) * p;
        }
        (p, average)
    }

    #[test]
    fn both_kinds_of_decay_are_as_in_the_papers() {
        let gradients = [0.3, -0.1, 0.02, 0.5, -0.4];
        let mut ends = Vec::new();
        for decoupled in [false, true] {
            let adam = Adam {
                beta1: 0.9,
                beta2: 0.999,
                epsilon: 1e-8,
                weight_decay: 0.5,
                decoupled,
                ema_rate: 0.9,
            };
            let mut numbers = [[0.7f32; 3], [0.7; 3], [0.0; 3], [0.0; 3]];
            for (index, gradient) in gradients.iter().enumerate() {
                let [parameters, ema, first_moment, second_moment] = &mut numbers;
                let updated = Updated {
                    parameters,
                    ema,
                    first_moment,
                    second_moment,
                };
                update(
                    updated,
                    &[*gradient as f32; 3],
                    &adam,
                    0.01,
                    index as u64 + 1,
                );
            }
            let (p, average) = reference(&adam, 0.01, &gradients);
            assert!((f64::from(numbers[0][1]) - p).abs() < 1e-6);
            assert!((f64::from(numbers[1][2]) - average).abs() < 1e-6);
            ends.push(p);
        }
        assert!((ends[0] - ends[1]).abs() > 1e-4, "the kinds differ here");
    }

    #[test]
    fn the_norm_is_the_root_of_the_sum_of_squares() {
        let gradient = vec![0.5f32; 3 * BLOCK + 4];
        let expected = 0.5 * (gradient.len() as f64).sqrt();
        assert!((norm(&gradient) - expected).abs() < 1e-9 * expected);
    }
}
