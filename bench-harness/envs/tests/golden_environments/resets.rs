//! First states of seeded resets, bit for bit those of the published environments: `environments/seeded_resets.json`.

use ksim_envs::{EnvironmentError, ResetOptions, mujoco};
use serde_json::{Map, Value};

use crate::recording;

fn numbers(value: &Value) -> Vec<f64> {
    serde_json::from_value(value.clone()).unwrap()
}

#[test]
fn golden_first_states_of_every_seed() {
    let text = std::fs::read_to_string(recording::folder().join("seeded_resets.json")).unwrap();
    let recorded: Value = serde_json::from_str(&text).unwrap();
    let mut n_known = 0;
    for (id, resets) in recorded["seeded_resets"].as_object().unwrap() {
        let mut environment = match mujoco::make(id, &Map::new(), None) {
            Err(EnvironmentError::UnknownId { .. }) => continue,
            made => made.unwrap(),
        };
        n_known += 1;
        let mut observation = vec![0.0; environment.spec().observation_dim()];
        let mut info = vec![0.0; environment.spec().info_dim()];
        for reset in resets.as_array().unwrap() {
            let options = ResetOptions::default();
            let mut seed = reset["seed"].as_u64();
            if reset["seed"] == "second reset after seed 0" {
                environment
                    .reset(Some(0), &options, &mut observation)
                    .unwrap();
                seed = None;
            }
            environment.reset(seed, &options, &mut observation).unwrap();
            environment.read_info(&mut info);
            let goal = reset.get("goal").map_or(Vec::new(), numbers);
            let expected = [numbers(&reset["qpos"]), numbers(&reset["qvel"]), goal].concat();
            assert_eq!(info, expected, "{id}, seed {seed:?}");
        }
    }
    assert!(n_known >= 8, "{n_known} environments with seeded resets");
}
