//! Both backends compute the same, and go on from each other's training.
#![cfg(all(feature = "native", feature = "torch"))]
#![allow(clippy::unwrap_used, reason = "a test that gets no network fails")]

mod support;

use ksim_planners::native::NativeBackend;
use ksim_planners::nets::{
    Adam, Architecture, Backend, HalfJannerConfig, JannerConfig, MlpConfig, TimestepEmbedding,
    TrainingState, Weights, initial_weights,
};
use ksim_planners::torch::{Device, TorchBackend};
use support::tolerance::assert_close;

/// Relative to the largest number.
const PARITY: f64 = 1e-5;

fn architectures() -> [Architecture; 3] {
    [
        Architecture::Janner(JannerConfig {
            horizon: 16,
            width: 6,
            model_dim: 32,
            embedding_dim: 32,
            dim_mult: vec![1, 2, 2],
            kernel_size: 5,
            embedding: TimestepEmbedding::Sinusoidal,
        }),
        Architecture::HalfJanner(HalfJannerConfig {
            horizon: 16,
            width: 6,
            out_dim: 5,
            model_dim: 32,
            embedding_dim: 32,
            dim_mult: vec![1, 2],
            kernel_size: 3,
            embedding: TimestepEmbedding::Integer,
        }),
        Architecture::Mlp(MlpConfig {
            in_dim: 20,
            hidden: vec![64, 64],
            out_dim: 7,
        }),
    ]
}

fn backends() -> [Box<dyn Backend>; 2] {
    [
        Box::new(NativeBackend::new()),
        Box::new(TorchBackend::new(Device::Cpu, 1).unwrap()),
    ]
}

fn numbers(n: usize, seed: f32) -> Vec<f32> {
    (0..n).map(|i| (i as f32 * 0.7 + seed).sin()).collect()
}

const N: usize = 6;

#[test]
fn outputs_and_input_gradients_agree() {
    for architecture in architectures() {
        let weights = initial_weights(&architecture, 3).unwrap();
        let x = numbers(N * architecture.input_len(), 0.0);
        let cotangent = numbers(N * architecture.output_len(), 1.0);
        for t in [vec![3.0; N], (0..N).map(|t| t as f32).collect()] {
            let [native, torch] = backends().map(|backend| {
                let mut network = backend.network(&architecture, &weights).unwrap();
                let mut out = vec![f32::NAN; cotangent.len()];
                network.forward(&x, &t, true, &mut out).unwrap();
                let mut gradient = vec![f32::NAN; x.len()];
                network.input_gradient(&cotangent, &mut gradient).unwrap();
                (out, gradient)
            });
            assert_close(&torch.0, &native.0, PARITY, "outputs");
            assert_close(&torch.1, &native.1, PARITY, "gradients by the input");
        }
    }
}

/// Some updates, begun by one backend and ended by another.
fn train(
    order: &[&dyn Backend],
    architecture: &Architecture,
    adam: &Adam,
    learning_rate: f64,
) -> TrainingState {
    let mut state = TrainingState::new(initial_weights(architecture, 4).unwrap());
    for (update, backend) in order.iter().enumerate() {
        let mut network = backend.trainable(architecture, state).unwrap();
        let x = numbers(N * architecture.input_len(), update as f32);
        let t: Vec<f32> = (0..N).map(|t| t as f32).collect();
        let mut out = vec![f32::NAN; N * architecture.output_len()];
        network.forward(&x, &t, true, &mut out).unwrap();
        // The gradient of half the sum of squares.
        network.backward(&out.clone()).unwrap();
        network.update(adam, learning_rate).unwrap();
        state = network.state();
    }
    state
}

fn assert_weights_close(found: &Weights, expected: &Weights, what: &str) {
    for (name, tensor) in &expected.tensors {
        let found = &found.tensors[name];
        assert_eq!(found.shape, tensor.shape, "{name}");
        assert_close(
            &found.values,
            &tensor.values,
            20.0 * PARITY,
            &format!("{what} {name}"),
        );
    }
}

#[test]
fn trainings_agree_and_change_hands() {
    let [native, torch] = backends();
    let (native, torch) = (native.as_ref(), torch.as_ref());
    for architecture in architectures() {
        for decoupled in [false, true] {
            let adam = Adam {
                beta1: 0.9,
                beta2: 0.999,
                // Large, so that a gradient near zero does not choose a direction by its last bit.
                epsilon: 1e-2,
                weight_decay: 0.1,
                decoupled,
                ema_rate: 0.9,
            };
            let of = |order: &[&dyn Backend]| train(order, &architecture, &adam, 1e-2);
            let expected = of(&[native; 4]);
            assert_eq!(expected.n_updates, 4);
            for order in [
                [torch; 4],
                [native, native, torch, torch],
                [torch, torch, native, torch],
            ] {
                let found = of(&order);
                assert_eq!(found.n_updates, 4);
                assert_weights_close(&found.weights, &expected.weights, "weights");
                assert_weights_close(&found.ema, &expected.ema, "moving average");
                assert_weights_close(&found.first_moment, &expected.first_moment, "first moment");
                assert_weights_close(
                    &found.second_moment,
                    &expected.second_moment,
                    "second moment",
                );
            }
        }
    }
}

/// One weight of one linear layer, by the formulas alone.
#[test]
fn an_update_follows_the_formulas() {
    let architecture = Architecture::Mlp(MlpConfig {
        in_dim: 1,
        hidden: Vec::new(),
        out_dim: 1,
    });
    let adam = |decoupled| Adam {
        beta1: 0.8,
        beta2: 0.9,
        epsilon: 1e-3,
        weight_decay: 0.5,
        decoupled,
        ema_rate: 0.75,
    };
    for backend in backends() {
        for decoupled in [false, true] {
            let adam = adam(decoupled);
            let mut start = initial_weights(&architecture, 1).unwrap();
            start.tensors.get_mut("0.weight").unwrap().values[0] = 2.0;
            let state = TrainingState::new(start);
            let mut network = backend.trainable(&architecture, state).unwrap();
            let (mut weight, mut ema, mut m, mut v) = (2.0f64, 2.0f64, 0.0f64, 0.0f64);
            for k in 1..=5 {
                // The output's gradient by the weight is x.
                let x = 0.3 * f64::from(k);
                let mut out = [0.0];
                network
                    .forward(&[x as f32], &[0.0], true, &mut out)
                    .unwrap();
                let norm = network.backward(&[1.0]).unwrap();
                assert!((norm - x.hypot(1.0)).abs() < 1e-6, "{norm}");
                network.update(&adam, 0.1).unwrap();
                let gradient = if decoupled { x } else { x + 0.5 * weight };
                if decoupled {
                    weight *= 1.0 - 0.1 * 0.5;
                }
                m = 0.8 * m + 0.2 * gradient;
                v = 0.9 * v + 0.1 * gradient * gradient;
                let (m_hat, v_hat) = (m / (1.0 - 0.8f64.powi(k)), v / (1.0 - 0.9f64.powi(k)));
                weight -= 0.1 * m_hat / (v_hat.sqrt() + 1e-3);
                ema = 0.75 * ema + 0.25 * weight;
            }
            let state = network.state();
            for (weights, expected) in [
                (&state.weights, weight),
                (&state.ema, ema),
                (&state.first_moment, m),
                (&state.second_moment, v),
            ] {
                let found = f64::from(weights.tensors["0.weight"].values[0]);
                let name = backend.name();
                assert!(
                    (found - expected).abs() < 1e-5,
                    "{name}: {found}, expected {expected}"
                );
            }
        }
    }
}
