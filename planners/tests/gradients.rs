//! Gradients of every backend against finite differences, on small networks of all kinds, and that numbers depend
//! neither on the samples beside them nor on the number of threads.
#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that gets no network fails")]

mod support;

use ksim_planners::nets::{
    Adam, Architecture, Backend, HalfJannerConfig, JannerConfig, MlpConfig, TimestepEmbedding,
    TrainableNetwork, TrainingState, Weights, initial_weights,
};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use support::backends;

fn architectures() -> Vec<Architecture> {
    let embedding = TimestepEmbedding::Sinusoidal;
    vec![
        Architecture::Janner(JannerConfig {
            horizon: 8,
            width: 5,
            model_dim: 16,
            embedding_dim: 8,
            dim_mult: vec![1, 2, 1],
            kernel_size: 5,
            embedding,
        }),
        // A single level, a step that is never halved, channels that fill no panel.
        Architecture::Janner(JannerConfig {
            horizon: 1,
            width: 3,
            model_dim: 12,
            embedding_dim: 4,
            dim_mult: vec![1],
            kernel_size: 3,
            embedding,
        }),
        Architecture::HalfJanner(HalfJannerConfig {
            horizon: 16,
            width: 4,
            out_dim: 3,
            model_dim: 8,
            embedding_dim: 6,
            dim_mult: vec![1, 3],
            kernel_size: 3,
            embedding: TimestepEmbedding::Integer,
        }),
        // Halved to one step; many channels, since a norm over few numbers is too bent for finite differences.
        Architecture::HalfJanner(HalfJannerConfig {
            horizon: 2,
            width: 7,
            out_dim: 17,
            model_dim: 16,
            embedding_dim: 6,
            dim_mult: vec![1, 8],
            kernel_size: 3,
            embedding,
        }),
        // Channels and lengths that are computed by Winograd, widths 3 and 5, in some of its layers.
        Architecture::HalfJanner(HalfJannerConfig {
            horizon: 8,
            width: 6,
            out_dim: 2,
            model_dim: 64,
            embedding_dim: 8,
            dim_mult: vec![1, 2],
            kernel_size: 3,
            embedding,
        }),
        Architecture::Mlp(MlpConfig {
            in_dim: 9,
            hidden: vec![20, 7],
            out_dim: 4,
        }),
    ]
}

fn uniform(rng: &mut ChaCha8Rng, n: usize) -> Vec<f32> {
    let unit = |rng: &mut ChaCha8Rng| (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0;
    (0..n).map(|_| unit(rng)).collect()
}

/// Windows, timesteps, and the weights of a sum over the outputs.
struct Batch {
    x: Vec<f32>,
    t: Vec<f32>,
    cotangent: Vec<f32>,
}

impl Batch {
    fn new(architecture: &Architecture, n: usize, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Self {
            x: uniform(&mut rng, n * architecture.input_len()),
            t: (0..n).map(|i| (i % 7) as f32).collect(),
            cotangent: uniform(&mut rng, n * architecture.output_len()),
        }
    }

    fn forward(
        &self,
        backend: &dyn Backend,
        architecture: &Architecture,
        weights: &Weights,
    ) -> Vec<f32> {
        let mut network = backend.network(architecture, weights).unwrap();
        let mut out = vec![f32::NAN; self.cotangent.len()];
        network.forward(&self.x, &self.t, false, &mut out).unwrap();
        out
    }

    fn sum(&self, backend: &dyn Backend, architecture: &Architecture, weights: &Weights) -> f64 {
        let out = self.forward(backend, architecture, weights);
        let pairs = out.iter().zip(&self.cotangent);
        pairs.map(|(out, c)| f64::from(*out) * f64::from(*c)).sum()
    }
}

/// Weights with norms that matter.
fn weights(architecture: &Architecture, seed: u64) -> Weights {
    let mut weights = initial_weights(architecture, seed).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(seed + 1);
    for tensor in weights.tensors.values_mut() {
        let noise = uniform(&mut rng, tensor.values.len());
        let pairs = tensor.values.iter_mut().zip(noise);
        pairs.for_each(|(value, noise)| *value += 0.1 * noise);
    }
    weights
}

/// Adam that keeps the gradient as its first moment and changes nothing.
const WATCH: Adam = Adam {
    beta1: 0.0,
    beta2: 0.999,
    epsilon: 1e-8,
    weight_decay: 0.0,
    decoupled: true,
    ema_rate: 0.5,
};

/// The gradient by all weights, and its norm.
fn gradient(network: &mut dyn TrainableNetwork, batch: &Batch) -> (Weights, f64) {
    let mut out = vec![f32::NAN; batch.cotangent.len()];
    network.forward(&batch.x, &batch.t, true, &mut out).unwrap();
    let norm = network.backward(&batch.cotangent).unwrap();
    network.update(&WATCH, 0.0).unwrap();
    (network.state().unwrap().first_moment, norm)
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    let pairs = a.iter().zip(b);
    pairs.map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

/// Along one direction per tensor: the gradient's step against the difference of two forward passes.
#[test]
fn weight_gradients_are_finite_differences() {
    for backend in backends() {
        for architecture in architectures() {
            let weights = weights(&architecture, 5);
            let batch = Batch::new(&architecture, 19, 6);
            let state = TrainingState::new(weights.clone());
            let mut network = backend.trainable(&architecture, state).unwrap();
            let (gradient, norm) = gradient(network.as_mut(), &batch);
            let squares: f64 = gradient
                .tensors
                .values()
                .map(|g| dot(&g.values, &g.values))
                .sum();
            assert!((norm - squares.sqrt()).abs() < 1e-5 * norm);
            for (name, tensor) in &gradient.tensors {
                let mut rng = ChaCha8Rng::seed_from_u64(9);
                let random = uniform(&mut rng, tensor.values.len());
                // Half along the gradient, so that the step is not lost in rounding, and half anywhere.
                let length = dot(&tensor.values, &tensor.values).sqrt();
                let toward = (1.0 / length.max(1e-12)) as f32;
                let direction: Vec<f32> = tensor
                    .values
                    .iter()
                    .zip(random)
                    .map(|(g, r)| g * toward + r / (tensor.values.len() as f32).sqrt())
                    .collect();
                let at = |step: f32| {
                    let mut moved = weights.clone();
                    let values = &mut moved.tensors.get_mut(name).unwrap().values;
                    let pairs = values.iter_mut().zip(&direction);
                    pairs.for_each(|(value, d)| *value += step * d);
                    batch.sum(backend.as_ref(), &architecture, &moved)
                };
                // Richardson's extrapolation: group norms over few numbers are bent.
                let slope = |h: f32| (at(h) - at(-h)) / f64::from(2.0 * h);
                let (fine, coarse) = (slope(1e-3), slope(2e-3));
                let difference = (4.0 * fine - coarse) / 3.0;
                let expected = dot(&tensor.values, &direction);
                let scale = expected.abs().max(0.02 * norm);
                let error = (difference - expected).abs() / scale;
                assert!(
                    error < 1e-2,
                    "{} {name} of {architecture:?}: {difference} instead of {expected}",
                    backend.name()
                );
            }
        }
    }
}

#[test]
fn input_gradients_are_finite_differences() {
    for backend in backends() {
        for architecture in architectures() {
            let weights = weights(&architecture, 15);
            let mut batch = Batch::new(&architecture, 3, 16);
            let mut network = backend.network(&architecture, &weights).unwrap();
            let mut out = vec![f32::NAN; batch.cotangent.len()];
            network.forward(&batch.x, &batch.t, true, &mut out).unwrap();
            let mut gradient = vec![f32::NAN; batch.x.len()];
            network
                .input_gradient(&batch.cotangent, &mut gradient)
                .unwrap();
            let norm = dot(&gradient, &gradient).sqrt();
            let h = 3e-3f32;
            for i in (0..batch.x.len()).step_by(7) {
                let x = batch.x[i];
                batch.x[i] = x + h;
                let above = batch.sum(backend.as_ref(), &architecture, &weights);
                batch.x[i] = x - h;
                let below = batch.sum(backend.as_ref(), &architecture, &weights);
                batch.x[i] = x;
                let difference = (above - below) / f64::from(2.0 * h);
                let error = (difference - f64::from(gradient[i])).abs();
                assert!(
                    error < 1e-2 * norm,
                    "{} {architecture:?} {i}",
                    backend.name()
                );
            }
        }
    }
}

#[test]
fn a_gradient_needs_a_forward_pass_that_kept() {
    for backend in backends() {
        let architecture = &architectures()[0];
        let state = TrainingState::new(weights(architecture, 1));
        let mut network = backend.trainable(architecture, state).unwrap();
        let batch = Batch::new(architecture, 2, 2);
        let mut out = vec![0.0; batch.cotangent.len()];
        assert!(network.backward(&batch.cotangent).is_err());
        assert!(network.update(&WATCH, 0.1).is_err());
        network
            .forward(&batch.x, &batch.t, false, &mut out)
            .unwrap();
        assert!(network.backward(&batch.cotangent).is_err());
        network.forward(&batch.x, &batch.t, true, &mut out).unwrap();
        assert!(network.backward(&batch.cotangent[1..]).is_err());
        network.backward(&batch.cotangent).unwrap();
        assert!(network.backward(&batch.cotangent).is_err());
        assert!(
            network
                .forward(&batch.x[1..], &batch.t, true, &mut out)
                .is_err()
        );
    }
}

fn in_pool<T: Send>(threads: usize, run: impl FnOnce() -> T + Send) -> T {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap();
    pool.install(run)
}

/// Ten updates, bit for bit, with one, two and three threads.
#[test]
fn training_does_not_depend_on_threads() {
    let backend = ksim_planners::native::NativeBackend::new();
    for architecture in architectures() {
        let train = || {
            let state = TrainingState::new(weights(&architecture, 3));
            let mut network = backend.trainable(&architecture, state).unwrap();
            for seed in 0..3 {
                let batch = Batch::new(&architecture, 50, seed);
                let mut out = vec![0.0; batch.cotangent.len()];
                network.forward(&batch.x, &batch.t, true, &mut out).unwrap();
                network.backward(&batch.cotangent).unwrap();
                let adam = Adam {
                    beta1: 0.9,
                    ..WATCH
                };
                network.update(&adam, 1e-3).unwrap();
            }
            network.state().unwrap()
        };
        let one = in_pool(1, train);
        assert!(
            one == in_pool(2, train) && one == in_pool(3, train),
            "{architecture:?}"
        );
    }
}

/// Samples of a batch, bit for bit, whatever the threads and whatever else is in it.
#[test]
fn a_sample_does_not_depend_on_its_batch() {
    let backend = ksim_planners::native::NativeBackend::new();
    for architecture in architectures() {
        let weights = weights(&architecture, 4);
        let batch = Batch::new(&architecture, 37, 8);
        let whole = in_pool(1, || batch.forward(&backend, &architecture, &weights));
        let split = in_pool(3, || batch.forward(&backend, &architecture, &weights));
        assert!(whole == split, "{architecture:?}");
        let (input, output) = (architecture.input_len(), architecture.output_len());
        for (first, n) in [(4, 33), (20, 9), (30, 7)] {
            let part = Batch {
                x: batch.x[first * input..][..n * input].to_vec(),
                t: batch.t[first..][..n].to_vec(),
                cotangent: vec![0.0; n * output],
            };
            let found = part.forward(&backend, &architecture, &weights);
            assert!(
                found == whole[first * output..][..n * output],
                "{architecture:?}"
            );
        }
    }
}

/// The same numbers whether one time is shared or every sample has its own.
#[test]
fn equal_timesteps_change_nothing() {
    let backend = ksim_planners::native::NativeBackend::new();
    for architecture in architectures() {
        let weights = weights(&architecture, 4);
        let mut batch = Batch::new(&architecture, 5, 8);
        let mixed = batch.forward(&backend, &architecture, &weights);
        batch.t.fill(3.0);
        let equal = batch.forward(&backend, &architecture, &weights);
        let output = architecture.output_len();
        assert!(mixed[3 * output..4 * output] == equal[3 * output..4 * output]);
    }
}
