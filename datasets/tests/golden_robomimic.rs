//! The robomimic reader against files in the layout of its collection tools, written by h5py.
//!
//! The folder is `$KSIM_GOLDEN`, by default a small part of it in the repository. Whatever is found there is
//! checked: other recordings with other values must pass as well.
#![cfg(feature = "hdf5")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the other golden tests")]
mod support;

use ksim_datasets::{Format, OpenOptions, conformance, detect, open, schema};
use serde_json::{Value, json};
use support::{Table, files, golden, read_json};

#[test]
fn golden_robomimic_demonstrations_are_bit_equal() {
    let recordings = files(&golden("formats/hdf5/robomimic"), ".expected.json");
    assert!(!recordings.is_empty());
    for expected_path in recordings {
        let expected = read_json(&expected_path);
        let path = expected_path.with_file_name(expected["file"].as_str().unwrap());
        assert_eq!(detect(&path).unwrap(), Format::Robomimic);
        let source = open(&path, &OpenOptions::default()).unwrap();
        conformance::check_source(source.as_ref()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        conformance::check_parquet_round_trip(source.as_ref(), folder.path()).unwrap();
        let info = source.info();
        assert_eq!(info.n_steps, expected["total"].as_u64());
        assert_eq!(info.env_spec.as_ref(), Some(&expected["env_args"]));
        assert_eq!(info.metadata["mask"], expected["mask"]);
        assert_eq!(info.warnings, []);
        let demos = expected["demos"].as_object().unwrap();
        let episodes = source.episodes().unwrap();
        assert_eq!(episodes.len(), demos.len());
        for pair in episodes.windows(2) {
            assert!(
                pair[0].episode_index < pair[1].episode_index,
                "by number, not by name"
            );
        }
        for episode in &episodes {
            let name = format!("demo_{}", episode.episode_index);
            let demo = &demos[&name];
            assert_eq!(Some(episode.length), demo["num_samples"].as_u64(), "{name}");
            let table = Table::read_episode(source.as_ref(), episode.episode_index);
            let action = table.leaf(schema::ACTION).steps();
            let shape = [episode.length, info.action_width() as u64];
            let sha = &demo["actions_sha256"];
            action.assert_is(
                &json!({"shape": shape, "dtype": "float64", "sha256_c_order": sha}),
                &name,
            );
            for key in demo["obs_keys"].as_array().unwrap() {
                table.leaf(&format!("observation.{}", key.as_str().unwrap()));
            }
            let hand = table.row_bytes("observation.robot0_eef_pos");
            let last = usize::try_from(episode.length).unwrap() - 1;
            assert_eq!(json!(hand[0]), demo["eef_first"], "{name}");
            assert_eq!(json!(hand[last]), demo["eef_last"], "{name}");
            if episode.has_final_obs {
                // These recordings repeat the last observation.
                assert_eq!(hand[last + 1], hand[last], "{name}");
            }
            check_masks(&expected["mask"], &name, &episode.attributes["mask"]);
        }
    }
}

fn check_masks(filters: &Value, demo: &str, found: &Value) {
    let holds = |names: &Value| names.as_array().unwrap().iter().any(|name| name == demo);
    let filters = filters.as_object().unwrap().iter();
    let expected: Vec<&String> = filters
        .filter(|(_, names)| holds(names))
        .map(|(name, _)| name)
        .collect();
    assert_eq!(*found, json!(expected), "{demo}");
}
