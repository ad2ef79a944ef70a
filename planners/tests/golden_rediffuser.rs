//! ReDiffuser's confidence and choice against recorded ones.

#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod support;

use std::collections::BTreeMap;

use ksim_planners::algorithms::{
    confidence_probabilities, confidence_uncertainties, top_candidates,
};
use ksim_planners::config::ConfidenceRule;
use ksim_planners::nets::{Architecture, MlpConfig, Tensor, Weights};
use support::tolerance::assert_close;
use support::{File, backends, folders};

fn weights(file: &File, part: &str) -> Weights {
    let mut tensors = BTreeMap::new();
    for layer in ["0", "2", "4"] {
        for kind in ["weight", "bias"] {
            let name = format!("{layer}.{kind}");
            let stored = file.tensor(&format!("rnd.{part}.{name}"));
            let tensor = Tensor {
                shape: stored.shape.clone(),
                values: stored.values.clone(),
            };
            tensors.insert(name, tensor);
        }
    }
    Weights { tensors }
}

#[test]
fn golden_confidence_and_choice() {
    let mut n_files = 0;
    for folder in folders() {
        for file in folder.files("rediffuser_select") {
            for backend in backends() {
                n_files += 1;
                let shape = &file.tensor("traj").shape;
                let (n_candidates, n_envs, in_dim) = (shape[0], shape[1], shape[2] * shape[3]);
                let architecture = Architecture::Mlp(MlpConfig {
                    in_dim,
                    hidden: vec![32, 32],
                    out_dim: 64,
                });
                let n = n_candidates * n_envs;
                let outputs = ["predictor", "target"].map(|part| {
                    let weights = weights(&file, part);
                    let mut network = backend.network(&architecture, &weights).unwrap();
                    let mut out = vec![0.0; n * 64];
                    network
                        .forward(file.values("traj"), &vec![0.0; n], false, &mut out)
                        .unwrap();
                    out
                });
                let [predicted, target] = &outputs;
                let u = confidence_uncertainties(ConfidenceRule::Windows, 64, predicted, target);
                let u: Vec<f32> = u.iter().map(|&u| u as f32).collect();
                assert_close(&u, file.values("uncertainty_all"), 1e-5, "uncertainty");
                for env in 0..n_envs {
                    choose(&file, &u, env, (n_candidates, n_envs));
                }
            }
        }
    }
    assert!(n_files > 0);
}

fn choose(file: &File, u: &[f32], env: usize, (n_candidates, n_envs): (usize, usize)) {
    let of_env = |values: &[f32]| -> Vec<f64> {
        (0..n_candidates)
            .map(|at| f64::from(values[at * n_envs + env]))
            .collect()
    };
    let (scores, u) = (of_env(file.values("value_score")), of_env(u));
    let top = top_candidates(&scores, 4);
    let expected = &file.values("top4_indices_by_env")[env * 4..env * 4 + 4];
    let found: Vec<f32> = top.iter().map(|&at| at as f32).collect();
    assert_eq!(found, expected, "environment {env}");
    let among: Vec<f64> = top.iter().map(|&at| u[at]).collect();
    let probabilities: Vec<f32> = confidence_probabilities(&among, 0.2)
        .iter()
        .map(|&p| p as f32)
        .collect();
    let expected = &file.values("probs_by_env")[env * 4..env * 4 + 4];
    assert_close(&probabilities, expected, 1e-6, "probabilities");
}
