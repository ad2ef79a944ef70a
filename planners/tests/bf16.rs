//! The native backend with weights rounded to bf16, against itself in f32.

#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that gets no network fails")]

use ksim_planners::Precision;
use ksim_planners::native::NativeBackend;
use ksim_planners::nets::{
    Architecture, Backend, HalfJannerConfig, JannerConfig, MlpConfig, Network, TimestepEmbedding,
    TrainingState, initial_weights,
};

/// Of the length of all numbers together. A weight is off by 2⁻⁹ of itself at most; gradients are off by about 2 %, with
/// ReLUs a little more, since some of them flip.
const OUTPUT: f64 = 1e-2;
const GRADIENT: f64 = 3e-2;

/// Length of the difference, over the length of `exact`.
fn error(halved: &[f32], exact: &[f32]) -> f64 {
    let length = |numbers: &mut dyn Iterator<Item = f64>| numbers.map(|x| x * x).sum::<f64>();
    let pairs = halved.iter().zip(exact);
    let difference = length(&mut pairs.map(|(a, b)| f64::from(*a) - f64::from(*b)));
    (difference / length(&mut exact.iter().map(|x| f64::from(*x)))).sqrt()
}

/// The paper's sizes for Hopper, so that all ways back are taken, and odd numbers of inputs and outputs.
fn architectures() -> [Architecture; 3] {
    let (model_dim, embedding_dim, dim_mult) = (32, 32, vec![1, 2, 2, 2]);
    let embedding = TimestepEmbedding::Sinusoidal;
    [
        Architecture::Janner(JannerConfig {
            horizon: 32,
            width: 13,
            model_dim,
            embedding_dim,
            dim_mult: dim_mult.clone(),
            kernel_size: 5,
            embedding,
        }),
        Architecture::HalfJanner(HalfJannerConfig {
            horizon: 32,
            width: 13,
            out_dim: 7,
            model_dim,
            embedding_dim,
            dim_mult,
            kernel_size: 3,
            embedding,
        }),
        Architecture::Mlp(MlpConfig {
            in_dim: 21,
            hidden: vec![301, 255],
            out_dim: 9,
        }),
    ]
}

fn numbers(n: usize, seed: f32) -> Vec<f32> {
    (0..n).map(|i| (i as f32 * 0.7 + seed).sin()).collect()
}

/// Outputs, and gradients by the input, of so many windows.
fn run(precision: Precision, architecture: &Architecture, n: usize) -> [Vec<f32>; 2] {
    let backend = NativeBackend::with_precision(precision);
    let weights = initial_weights(architecture, 3).unwrap();
    let mut network = backend.network(architecture, &weights).unwrap();
    let x = numbers(n * architecture.input_len(), 0.0);
    let mut out = vec![f32::NAN; n * architecture.output_len()];
    network.forward(&x, &vec![3.0; n], true, &mut out).unwrap();
    let mut gradient = vec![f32::NAN; x.len()];
    let cotangent = numbers(out.len(), 1.0);
    network.input_gradient(&cotangent, &mut gradient).unwrap();
    [out, gradient]
}

#[test]
fn few_windows_are_near_those_in_f32() {
    for architecture in architectures() {
        for n in 1..4 {
            let [exact, halved] =
                [Precision::F32, Precision::Bf16].map(|p| run(p, &architecture, n));
            let bounds = [("outputs", OUTPUT), ("gradients", GRADIENT)];
            for ((halved, exact), (what, bound)) in halved.iter().zip(&exact).zip(bounds) {
                let error = error(halved, exact);
                assert!(
                    error <= bound,
                    "{what} of {architecture:?} are off by {error}"
                );
                // Rounded indeed.
                assert!(
                    error > 1e-5,
                    "{what} of {architecture:?} are off by {error}"
                );
            }
        }
    }
}

#[test]
fn groups_do_not_see_each_other() {
    /// Outputs and gradients of `x` in groups of `group` windows, on `n_threads` threads.
    fn of(
        network: &mut dyn Network,
        (x, group, n_threads): (&[f32], usize, usize),
    ) -> [Vec<f32>; 2] {
        let (n, output_len) = (
            x.len() / network.architecture().input_len(),
            network.architecture().output_len(),
        );
        network.in_groups_of(group);
        let mut out = vec![f32::NAN; n * output_len];
        let mut gradient = vec![f32::NAN; x.len()];
        let cotangent: Vec<f32> = numbers(output_len, 1.0).repeat(n);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads);
        pool.build().unwrap().install(|| {
            network.forward(x, &vec![3.0; n], true, &mut out).unwrap();
            network.input_gradient(&cotangent, &mut gradient).unwrap();
        });
        [out, gradient]
    }
    for architecture in architectures() {
        for precision in [Precision::F32, Precision::Bf16] {
            let backend = NativeBackend::with_precision(precision);
            let weights = initial_weights(&architecture, 3).unwrap();
            let mut network = backend.network(&architecture, &weights).unwrap();
            for group in [1, 2, 3, 5] {
                let group_len = group * architecture.input_len();
                let x = numbers(7 * group_len, 0.0);
                let [out, gradient] = of(network.as_mut(), (&x, group, 2));
                let out_len = out.len() / 7;
                for (at, x) in x.chunks_exact(group_len).enumerate() {
                    let alone = of(network.as_mut(), (x, group, 1));
                    assert!(alone[0] == out[at * out_len..][..out_len]);
                    assert!(alone[1] == gradient[at * group_len..][..group_len]);
                }
            }
        }
    }
}

#[test]
fn more_windows_and_trainings_stay_in_f32() {
    for architecture in architectures() {
        let [exact, halved] = [Precision::F32, Precision::Bf16].map(|p| run(p, &architecture, 4));
        assert!(halved == exact);
        let [exact, halved] = [Precision::F32, Precision::Bf16].map(|precision| {
            let state = TrainingState::new(initial_weights(&architecture, 3).unwrap());
            let backend = NativeBackend::with_precision(precision);
            let mut network = backend.trainable(&architecture, state).unwrap();
            let mut out = vec![f32::NAN; architecture.output_len()];
            let x = numbers(architecture.input_len(), 0.0);
            network.forward(&x, &[3.0], true, &mut out).unwrap();
            out
        });
        assert!(halved == exact);
    }
}
