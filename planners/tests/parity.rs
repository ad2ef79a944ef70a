//! Both backends compute the same, and go on from each other's training.
#![cfg(all(feature = "native", feature = "torch"))]
#![allow(clippy::unwrap_used, reason = "a test that gets no network fails")]

mod support;

use ksim_planners::native::NativeBackend;
use ksim_planners::nets::{
    Adam, Architecture, Backend, HalfJannerConfig, JannerConfig, MlpConfig, TimestepEmbedding,
    TrainableNetwork, TrainingState, Weights, initial_weights,
};
use ksim_planners::torch::{Device, TorchBackend};
use support::tolerance::assert_close;

/// Relative to the largest number.
const PARITY: f64 = 1e-5;
/// Of gradients by weights: as of those by the input (`golden_forward`).
const GRADIENT: f64 = 2e-5;
/// Of what is computed in f32 from the same numbers.
const ROUNDING: f64 = 1e-6;

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

/// A network under training that has passed a batch forward and back, and its outputs.
fn passed(
    backend: &dyn Backend,
    architecture: &Architecture,
    state: TrainingState,
) -> (Box<dyn TrainableNetwork>, Vec<f32>) {
    let seed = state.n_updates as f32;
    let mut network = backend.trainable(architecture, state).unwrap();
    let x = numbers(N * architecture.input_len(), seed);
    let t: Vec<f32> = (0..N).map(|t| t as f32).collect();
    let mut out = vec![f32::NAN; N * architecture.output_len()];
    network.forward(&x, &t, true, &mut out).unwrap();
    // The gradient of half the sum of squares.
    network.backward(&out).unwrap();
    (network, out)
}

/// The gradient by the weights: an Adam without a past keeps it as its first moment.
fn gradient(backend: &dyn Backend, architecture: &Architecture, state: &TrainingState) -> Weights {
    let bare = TrainingState {
        n_updates: state.n_updates,
        ..TrainingState::new(state.weights.clone())
    };
    let (mut network, _) = passed(backend, architecture, bare);
    let watch = Adam {
        beta1: 0.0,
        weight_decay: 0.0,
        ..ADAM
    };
    network.update(&watch, 0.0).unwrap();
    network.state().unwrap().first_moment
}

const LEARNING_RATE: f64 = 1e-2;
const ADAM: Adam = Adam {
    beta1: 0.9,
    beta2: 0.999,
    epsilon: 1e-8,
    weight_decay: 0.1,
    decoupled: false,
    ema_rate: 0.9,
};

/// That a state follows from the one before and a gradient by Adam's formulas, to rounding.
fn assert_follows(after: &TrainingState, before: &TrainingState, gradient: &Weights, adam: &Adam) {
    assert_eq!(after.n_updates, before.n_updates + 1);
    let k = i32::try_from(after.n_updates).unwrap();
    let (m_correction, v_correction) = (1.0 - adam.beta1.powi(k), 1.0 - adam.beta2.powi(k));
    let (l2, keep) = if adam.decoupled {
        (0.0, 1.0 - LEARNING_RATE * adam.weight_decay)
    } else {
        (adam.weight_decay, 1.0)
    };
    for (name, gradient) in &gradient.tensors {
        let of = |weights: &Weights| -> Vec<f64> {
            let values = weights.tensors[name].values.iter();
            values.map(|value| f64::from(*value)).collect()
        };
        let [w, ema] = [of(&before.weights), of(&before.ema)];
        let [m, v] = [of(&before.first_moment), of(&before.second_moment)];
        let [m_after, v_after] = [of(&after.first_moment), of(&after.second_moment)];
        let mut expected: [Vec<f32>; 4] = Default::default();
        for at in 0..w.len() {
            let g = f64::from(gradient.values[at]) + l2 * w[at];
            let m = adam.beta1 * m[at] + (1.0 - adam.beta1) * g;
            let v = adam.beta2 * v[at] + (1.0 - adam.beta2) * g * g;
            // From the moments that it has, whose last digits decide where both are near zero.
            let scale = (v_after[at] / v_correction).sqrt() + adam.epsilon;
            let w = keep * w[at] - LEARNING_RATE * m_after[at] / m_correction / scale;
            let ema = adam.ema_rate * ema[at] + (1.0 - adam.ema_rate) * w;
            for (list, number) in expected.iter_mut().zip([m, v, w, ema]) {
                list.push(number as f32);
            }
        }
        let found = [
            &after.first_moment,
            &after.second_moment,
            &after.weights,
            &after.ema,
        ];
        let names = ["first moment", "second moment", "weights", "moving average"];
        for ((found, expected), what) in found.iter().zip(&expected).zip(names) {
            let found = &found.tensors[name].values;
            assert_close(found, expected, ROUNDING, &format!("{what} {name}"));
        }
    }
}

/// Every update of a training that changes hands, computed by both backends from the same state: outputs and gradients
/// agree, and what each makes of its gradient follows from Adam's formulas to rounding.
///
/// Weights after several updates of each backend are not compared, though that is what one would like to know. Adam
/// divides a gradient by its own size: where it is near zero its last digits decide how far, and whither, a weight
/// moves, so that two right backends may differ there by as much as the learning rate. Rounding the sum of gradient and
/// decay to f32 instead of f64 alone moves one by 3·10⁻⁴ of the largest. Convolutions by Winograd have other last
/// digits than direct ones (gradients by weights differ by up to 10⁻⁵ of the largest), and a tolerance that lets those
/// weights pass says nothing about the others.
#[test]
fn trainings_agree_and_change_hands() {
    let backends = backends();
    for architecture in architectures() {
        for decoupled in [false, true] {
            let adam = Adam { decoupled, ..ADAM };
            let mut state = TrainingState::new(initial_weights(&architecture, 4).unwrap());
            // Each goes on with its own state, and with the other's.
            for going_on in [0, 0, 1, 1, 0, 1] {
                let gradients =
                    [0, 1].map(|at: usize| gradient(backends[at].as_ref(), &architecture, &state));
                for (name, expected) in &gradients[0].tensors {
                    let found = &gradients[1].tensors[name].values;
                    assert_close(
                        found,
                        &expected.values,
                        GRADIENT,
                        &format!("gradient by {name}"),
                    );
                }
                let [native, torch] = [0, 1].map(|at: usize| {
                    let backend = backends[at].as_ref();
                    let (mut network, out) = passed(backend, &architecture, state.clone());
                    network.update(&adam, LEARNING_RATE).unwrap();
                    let after = network.state().unwrap();
                    assert_follows(&after, &state, &gradients[at], &adam);
                    (after, out)
                });
                assert_close(&torch.1, &native.1, PARITY, "outputs");
                state = if going_on == 0 { native.0 } else { torch.0 };
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
            let state = network.state().unwrap();
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
