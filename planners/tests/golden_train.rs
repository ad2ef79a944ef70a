//! Ten updates of each network from recorded batches, timesteps and noise: losses, rates and final weights.

#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod support;

use ksim_planners::diffusion::{
    DiffusionLoss, Noised, Schedule, novelty_loss, paired_loss, value_loss,
};
use ksim_planners::model::network;
use ksim_planners::nets::{Backend, TimestepEmbedding, TrainingState, Weights};
use ksim_planners::training::{Learner, Rate};
use support::tolerance::assert_close;
use support::{File, Folder, backends, folders};

/// Updates of the cosine schedule of the traces.
const N_COSINE: u64 = 20;

#[test]
fn golden_training_traces() {
    let mut n_traces = 0;
    for folder in folders() {
        for file in folder.files("train_") {
            for name in ["diffusion", "reward", "rnd"] {
                for backend in backends() {
                    trace(&folder, &file, name, backend.as_ref());
                    n_traces += 1;
                }
            }
        }
    }
    assert!(n_traces > 0);
}

fn learner(folder: &Folder, file: &File, name: &str, backend: &dyn Backend) -> Learner {
    let (net, label) = match name {
        "diffusion" => ("unet", network::DIFFUSION),
        "reward" => ("reward", network::REWARD),
        _ => ("rnd_pred", network::CURIOSITY_PREDICTOR),
    };
    let architecture = file.architecture(net, TimestepEmbedding::Integer);
    let state = TrainingState::new(folder.weights(file, net));
    let defaults = &file.entry["traces"][name]["defaults"];
    let rate = defaults["lr"].as_f64().unwrap();
    let decay = defaults["weight_decay"].as_f64().unwrap();
    let learner = Learner::new(
        label,
        backend,
        &architecture,
        state,
        Rate::Cosine {
            first: rate,
            n_updates: N_COSINE,
        },
    )
    .unwrap();
    let learner = learner.average(file.entry["traces"][name]["ema_rate"].as_f64().unwrap());
    if name == "diffusion" {
        learner.decoupled_decay(decay)
    } else {
        learner.l2_decay(decay)
    }
}

fn trace(folder: &Folder, file: &File, name: &str, backend: &dyn Backend) {
    let label = format!("{} {name} ({})", file.name, backend.name());
    let schedule = Schedule::cosine(20);
    let shape = &file.tensor("x0").shape;
    let (n_steps, n, window_len) = (shape[0], shape[1], shape[2] * shape[3]);
    let observation_dim = file.entry["config"]["obs"].as_u64().unwrap() as usize;
    let mut learner = learner(folder, file, name, backend);
    let mut target = (name == "rnd").then(|| {
        let architecture = file.architecture("rnd_target", TimestepEmbedding::Integer);
        backend
            .network(&architecture, &folder.weights(file, "rnd_target"))
            .unwrap()
    });
    let (mut losses, mut rates) = (Vec::new(), Vec::new());
    for step in 0..n_steps {
        let part = |tensor: &str, len: usize| &file.values(tensor)[step * len..(step + 1) * len];
        let x0 = part("x0", n * window_len);
        let values = part("val", n);
        let t = part(&format!("{name}.t"), n)
            .iter()
            .map(|&t| t as usize)
            .collect::<Vec<_>>();
        let epsilon = part(&format!("{name}.eps"), n * window_len);
        let noised = Noised::new(&schedule, x0, &t, epsilon, observation_dim).unwrap();
        if step == 0 {
            let expected = file.values(&format!("{name}.xt_step0"));
            assert_close(&noised.x, expected, 1e-6, &format!("{label} x_t"));
        }
        let mut fixed = vec![0.0; n * 64];
        if let Some(target) = &mut target {
            target
                .forward(&noised.x, &noised.t, false, &mut fixed)
                .unwrap();
        }
        let diffusion = DiffusionLoss {
            window_len,
            observation_dim,
            width: shape[3],
            action_weight: 10.0,
        };
        let update = learner.update(&noised.x, &noised.t, |out, gradient| match name {
            "diffusion" => diffusion.loss(out, x0, gradient),
            "reward" => value_loss(out, values, false, gradient),
            _ => novelty_loss(out, &fixed, gradient),
        });
        let update = update.unwrap();
        losses.push(update.loss as f32);
        rates.push(update.learning_rate as f32);
    }
    for (loss, expected) in losses.iter().zip(file.values(&format!("{name}.loss"))) {
        assert_close(&[*loss], &[*expected], 1e-4, &format!("{label} loss"));
    }
    assert_close(
        &rates,
        file.values(&format!("{name}.lr")),
        1e-6,
        &format!("{label} rate"),
    );
    let state = learner.state().unwrap();
    check_norms(file, name, "model", &state.weights, &label);
    check_norms(file, name, "ema", &state.ema, &label);
    check_elements(file, name, &state.weights, &label);
}

/// L2 norms of all tensors after the last step.
fn check_norms(file: &File, name: &str, which: &str, weights: &Weights, label: &str) {
    let key = format!("final_stats_{which}_[l2,sum]");
    let stats = file.entry["traces"][name][&key].as_object().unwrap();
    assert_eq!(stats.len(), weights.tensors.len(), "{label}");
    for (tensor, stats) in stats {
        let expected = stats[0].as_f64().unwrap();
        let values = &weights.tensors[tensor].values;
        let found = values
            .iter()
            .map(|&value| f64::from(value).powi(2))
            .sum::<f64>()
            .sqrt();
        let error = (found - expected).abs() / expected;
        assert!(
            error <= 1e-5,
            "{label} {which} {tensor}: norm {found}, expected {expected}"
        );
    }
}

/// Every number of every tensor, where the file has them. Adam's first steps are sign-like: a gradient near zero may
/// flip and move a weight by up to the rate, which the specification allows for a few.
fn check_elements(file: &File, name: &str, weights: &Weights, label: &str) {
    let (mut n, mut n_far) = (0, 0);
    for (tensor, found) in &weights.tensors {
        let key = format!("{name}.final.{tensor}");
        if !file.has(&key) {
            return;
        }
        for (found, expected) in found.values.iter().zip(file.values(&key)) {
            n += 1;
            n_far += usize::from((found - expected).abs() > 5e-5);
        }
    }
    assert!(
        n_far * 1000 <= n,
        "{label}: {n_far} of {n} weights are off by more than 5e-5"
    );
}

#[test]
fn golden_reward_loss_broadcast() {
    let mut n_files = 0;
    for folder in folders() {
        for file in folder.files("reward_loss_broadcast") {
            n_files += 1;
            let (prediction, values) = (file.values("pred"), file.values("val"));
            let mut gradient = vec![0.0; values.len()];
            let paired = value_loss(prediction, values, false, &mut gradient);
            assert_close(&[paired as f32], file.values("loss_val_2d"), 1e-6, "paired");
            let broadcast = value_loss(prediction, values, true, &mut gradient);
            assert_close(
                &[broadcast as f32],
                file.values("loss_val_1d_broadcast"),
                1e-6,
                "broadcast",
            );
            check_gradient(prediction, &gradient, |prediction, gradient| {
                value_loss(prediction, values, true, gradient)
            });
        }
    }
    assert!(n_files > 0);
}

/// Gradients against finite differences.
fn check_gradient(x: &[f32], gradient: &[f32], loss: impl Fn(&[f32], &mut [f32]) -> f64) {
    let mut unused = vec![0.0; x.len()];
    for at in 0..x.len() {
        let step = 1e-2;
        let mut moved = x.to_vec();
        moved[at] = x[at] + step;
        let above = loss(&moved, &mut unused);
        moved[at] = x[at] - step;
        let below = loss(&moved, &mut unused);
        let expected = (above - below) / (2.0 * f64::from(step));
        let error = (f64::from(gradient[at]) - expected).abs();
        assert!(
            error <= 1e-3 * expected.abs().max(1.0),
            "{} {expected}",
            gradient[at]
        );
    }
}

#[test]
fn gradients_of_losses_are_their_slopes() {
    let x = [0.5, -1.0, 2.0, 0.25, 1.5, -0.75, 0.1, 0.9];
    let y = [0.0, 1.0, 1.0, -0.5, 2.5, 0.75, 0.3, -0.2];
    let mut gradient = vec![0.0; x.len()];
    let weighted = DiffusionLoss {
        window_len: 4,
        observation_dim: 1,
        width: 2,
        action_weight: 10.0,
    };
    let diffusion = |x: &[f32], gradient: &mut [f32]| weighted.loss(x, &y, gradient);
    let loss = diffusion(&x, &mut gradient);
    // One window of two rows of one observation and one action: (0, 10, 1, 1) are the weights.
    let weights = [0.0, 10.0, 1.0, 1.0, 0.0, 10.0, 1.0, 1.0];
    let terms = x
        .iter()
        .zip(&y)
        .zip(&weights)
        .map(|((x, y), w)| f64::from(w * (x - y) * (x - y)));
    assert!((loss - terms.sum::<f64>() / 8.0).abs() < 1e-6);
    check_gradient(&x, &gradient, diffusion);
    let paired = |x: &[f32], gradient: &mut [f32]| paired_loss(x, &y, gradient);
    paired(&x, &mut gradient);
    check_gradient(&x, &gradient, paired);
}
