//! How weights start: PyTorch's defaults for linear layers, convolutions and group norms.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use super::architecture::Architecture;
use super::tensors::TensorRole;
use super::weights::{Tensor, Weights};
use crate::error::PlannerError;

/// Weights and biases uniform in ±1/√fan_in (He et al. 2015 with a = √5, as PyTorch has it), norms 1 and 0. The
/// draws are those of ChaCha8 from `seed`, tensor by tensor in the order of [`Architecture::tensors`].
///
/// # Errors
/// As [`Architecture::validate`].
pub fn initial_weights(architecture: &Architecture, seed: u64) -> Result<Weights, PlannerError> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut weights = Weights::default();
    for spec in architecture.tensors()? {
        let n = spec.shape.iter().product();
        let values = match spec.role {
            TensorRole::NormScale => vec![1.0; n],
            TensorRole::NormShift => vec![0.0; n],
            TensorRole::Layer { fan_in } => {
                let bound = 1.0 / (fan_in as f64).sqrt();
                (0..n).map(|_| uniform(&mut rng, bound)).collect()
            }
        };
        let tensor = Tensor {
            shape: spec.shape,
            values,
        };
        weights.tensors.insert(spec.name, tensor);
    }
    Ok(weights)
}

/// Uniform in [−bound, bound).
fn uniform(rng: &mut ChaCha8Rng, bound: f64) -> f32 {
    let unit = f64::from(rng.next_u32() >> 8) / f64::from(1u32 << 24);
    ((2.0 * unit - 1.0) * bound) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nets::{HalfJannerConfig, TimestepEmbedding};

    fn architecture() -> Architecture {
        Architecture::HalfJanner(HalfJannerConfig {
            horizon: 8,
            width: 5,
            out_dim: 3,
            model_dim: 16,
            embedding_dim: 16,
            dim_mult: vec![1, 2],
            kernel_size: 3,
            embedding: TimestepEmbedding::Integer,
        })
    }

    #[test]
    fn a_seed_gives_the_same_weights_and_another_seed_others() {
        let a = initial_weights(&architecture(), 7).unwrap();
        assert_eq!(a, initial_weights(&architecture(), 7).unwrap());
        assert_ne!(a, initial_weights(&architecture(), 8).unwrap());
        architecture().check_weights(&a).unwrap();
    }

    #[test]
    fn weights_fill_their_interval_and_norms_start_as_identity() {
        let weights = initial_weights(&architecture(), 1).unwrap();
        let weight = &weights.tensors["downs.0.1.conv1.0.weight"];
        let bound = 1.0 / (16.0f32 * 3.0).sqrt();
        let largest = weight.values.iter().fold(0.0f32, |a, b| a.max(b.abs()));
        assert!(
            largest <= bound && largest > 0.99 * bound,
            "{largest} {bound}"
        );
        let n = weight.values.len() as f32;
        let variance = weight.values.iter().map(|w| w * w).sum::<f32>() / n;
        assert!((variance / (bound * bound / 3.0) - 1.0).abs() < 0.1);
        let norm = &weights.tensors["downs.0.1.conv1.1.weight"];
        assert!(norm.values.iter().all(|&w| w == 1.0));
        let shift = &weights.tensors["downs.0.1.conv1.1.bias"];
        assert!(shift.values.iter().all(|&b| b == 0.0));
    }
}
