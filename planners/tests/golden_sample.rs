//! Guided sampling of mode reference with recorded noise, step by step.

#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod support;

use ksim_planners::config::{Mode, Solver};
use ksim_planners::diffusion::{
    Denoising, Guide, Prior, RecordedNoise, Sampler, SamplingTable, Schedule,
};
use ksim_planners::nets::{Backend, TimestepEmbedding};
use serde_json::Value;
use support::tolerance::assert_close;
use support::{File, Folder, backends, folders};

/// Step that the file keeps the predictions of, counted down as there.
const PREDICTION_STEP: usize = 11;

#[test]
fn golden_sampling() {
    let mut n_cases = 0;
    for folder in folders() {
        for file in folder.files("sample_") {
            for (name, case) in file.entry["cases"].as_object().unwrap() {
                for backend in backends() {
                    replay(&folder, &file, name, case, backend.as_ref());
                    n_cases += 1;
                }
            }
        }
    }
    assert!(n_cases > 0);
}

/// The guide of a case. Without curiosity the other two networks are not even made.
fn guide(folder: &Folder, file: &File, case: &Value, backend: &dyn Backend) -> Guide {
    let network = |net: &str| {
        let architecture = file.architecture(net, TimestepEmbedding::Integer);
        backend
            .network(&architecture, &folder.weights(file, net))
            .unwrap()
    };
    let guide = Guide::new(network("reward"), 0.0, 1.0);
    match case["classifier"].as_str().unwrap() {
        "reward" => guide,
        _ => {
            let weight = case["lambda"].as_f64().unwrap();
            guide.with_curiosity(network("rnd_pred"), network("rnd_target"), weight)
        }
    }
}

fn replay(folder: &Folder, file: &File, name: &str, case: &Value, backend: &dyn Backend) {
    let schedule = Schedule::cosine(20);
    let table = SamplingTable::new(&schedule, 20, Mode::Reference, Solver::Ddpm);
    let architecture = file.architecture("unet", TimestepEmbedding::Integer);
    let mut network = backend
        .network(&architecture, &folder.weights(file, "unet"))
        .unwrap();
    let mut guide = guide(folder, file, case, backend);
    let n = file.tensor("noise").shape[1];
    let observation_dim = file.tensor("obs0").shape[1];
    let prior = Prior {
        observations: &file.values("obs0").repeat(n),
        observation_dim,
        start: None,
    };
    // λ = 10^6 may be off three times as far.
    let lambda = case["lambda"].as_f64().unwrap();
    let loose = if lambda >= 1e6 { 3.0 } else { 1.0 };
    let label = format!("{} {name} ({})", file.name, backend.name());
    let values = |what: &str| file.values(&format!("{name}.{what}"));
    let kept: Vec<u64> = file.entry["kept_i"]
        .as_array()
        .unwrap()
        .iter()
        .map(|i| i.as_u64().unwrap())
        .collect();
    let mut watch = |seen: &Denoising<'_>| {
        let i = 20 - seen.step;
        let len = seen.x.len();
        if let Some(at) = kept.iter().position(|kept| *kept == i as u64) {
            let expected = &values("x_before_step")[at * len..(at + 1) * len];
            assert_close(seen.x, expected, 1e-4 * loose, &format!("{label} x at {i}"));
        }
        if i == PREDICTION_STEP {
            let what = format!("{label} prediction");
            assert_close(
                seen.prediction,
                values("pred_unguided"),
                1e-4 * loose,
                &what,
            );
            assert_close(seen.guided, values("pred_guided"), 1e-4 * loose, &what);
        }
        if let Some(score) = seen.score {
            let expected = &values("step_logp")[seen.step * n..(seen.step + 1) * n];
            assert_close(
                &score.log_p,
                expected,
                5e-5 * loose,
                &format!("{label} log p at {i}"),
            );
        }
    };
    let sample = Sampler {
        network: network.as_mut(),
        guide: Some(&mut guide),
        schedule: &schedule,
        table: &table,
        temperature: 0.5,
        guidance_weight: case["w_cg"].as_f64().unwrap() as f32,
    }
    .sample(
        &prior,
        &mut RecordedNoise::new(file.values("noise")),
        &mut watch,
    )
    .unwrap();
    assert_close(
        &sample.x,
        values("final"),
        1e-4 * loose,
        &format!("{label} final"),
    );
    assert_close(
        &sample.score.log_p,
        values("logp"),
        5e-5 * loose,
        &format!("{label} log p"),
    );
    let best = (0..n)
        .max_by(|&a, &b| sample.score.log_p[a].total_cmp(&sample.score.log_p[b]))
        .unwrap();
    assert_eq!(
        best as u64,
        case["argmax_candidate"].as_u64().unwrap(),
        "{label}"
    );
    let width =
        architecture.output_len() / file.entry["config"]["horizon"].as_u64().unwrap() as usize;
    let first = best * architecture.output_len() + observation_dim;
    let action: Vec<f32> = sample.x[first..first + width - observation_dim]
        .iter()
        .map(|a| a.clamp(-1.0, 1.0))
        .collect();
    assert_close(
        &action,
        values("action"),
        1e-4 * loose,
        &format!("{label} action"),
    );
}
