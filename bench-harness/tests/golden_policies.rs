//! Networks against the actions of other implementations. `$KSIM_POLICIES` names a folder of networks, of which
//! `$KSIM_GOLDEN/data_fixtures/policy_golden.safetensors` holds observations and actions (`NAME.obs`, `NAME.action`);
//! without them, small networks of random weights, which `make_policies.py` beside them made.

use std::path::{Path, PathBuf};

use ksim_bench_harness::policy::{EpisodeStart, Mlp, MlpOptions, Policy as _};
use ksim_envs::{EnvironmentSpec, Part};
use safetensors::SafeTensors;

/// NumPy sums in another order, and its tanh rounds otherwise.
const TOLERANCE: f64 = 2e-6;

/// The folder of networks, and the recording.
fn inputs() -> (PathBuf, PathBuf) {
    match (
        std::env::var_os("KSIM_POLICIES"),
        std::env::var_os("KSIM_GOLDEN"),
    ) {
        (Some(policies), Some(golden)) => (
            policies.into(),
            Path::new(&golden).join("data_fixtures/policy_golden.safetensors"),
        ),
        _ => {
            let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/policies");
            let recording = folder.join("policy_golden.safetensors");
            (folder, recording)
        }
    }
}

fn environment(observation_dim: usize, action_dim: usize) -> EnvironmentSpec {
    EnvironmentSpec {
        id: "Recorded-v0".to_owned(),
        observation: vec![Part {
            name: "",
            width: observation_dim,
        }],
        action_low: vec![-1.0; action_dim],
        action_high: vec![1.0; action_dim],
        info: Vec::new(),
        max_episode_steps: 1,
        dt_s: 1.0,
        reports_success: false,
        kwargs: serde_json::Map::new(),
    }
}

#[test]
fn golden_actions_are_repeated() {
    let (policies, recording) = inputs();
    let bytes = std::fs::read(recording).unwrap();
    let recorded = SafeTensors::deserialize(&bytes).unwrap();
    let mut names: Vec<&str> = recorded.names();
    names.retain(|name| name.ends_with(".obs"));
    assert!(!names.is_empty());
    for name in names {
        let name = name.trim_end_matches(".obs");
        let observations = recorded.tensor(&format!("{name}.obs")).unwrap();
        let expected = recorded.tensor(&format!("{name}.action")).unwrap();
        let spec = environment(observations.shape()[1], expected.shape()[1]);
        let file = policies.join(format!("{name}.safetensors"));
        let mut mlp = Mlp::open(name.to_owned(), &file, MlpOptions::default(), &spec).unwrap();
        let slots: Vec<usize> = (0..observations.shape()[0]).collect();
        for &slot in &slots {
            let start = EpisodeStart {
                episode: 0,
                seed: 0,
            };
            mlp.start_episode(slot, &start).unwrap();
        }
        let observations: Vec<f64> = (observations.data().as_chunks().0.iter())
            .map(|bytes| f64::from_le_bytes(*bytes))
            .collect();
        let mut actions = vec![0.0; slots.len() * spec.action_dim()];
        mlp.act(&slots, &observations, &mut actions).unwrap();
        let expected = expected.data().as_chunks().0.iter();
        for (found, expected) in actions.iter().zip(expected) {
            let expected = f64::from(f32::from_le_bytes(*expected));
            assert!(
                (found - expected).abs() < TOLERANCE,
                "{name}: {found}, {expected}"
            );
        }
    }
}
