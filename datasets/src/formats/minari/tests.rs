//! Datasets with the HDF5 backend that Minari itself would not write.
#![expect(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use hdf5_metno as hdf5;
use serde_json::json;

use super::MinariSource;
use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::source::{DatasetSource, Scan, Warning};

/// A dataset of two episodes of two steps; `change` may spoil the second one.
fn dataset(folder: &Path, change: impl Fn(&hdf5::Group)) -> hdf5::File {
    let space = json!({"type": "Box", "dtype": "float64", "shape": [1]}).to_string();
    metadata(folder, &space);
    let file = hdf5::File::create(folder.join("data/main_data.hdf5")).unwrap();
    for name in ["episode_0", "episode_1"] {
        let episode = file.create_group(name).unwrap();
        let array = |name: &str, n: usize| {
            let values = ndarray::Array2::from_elem((n, 1), 0.5);
            let builder = episode.new_dataset_builder().with_data(&values);
            builder.create(name).unwrap();
        };
        array("observations", 3);
        array("actions", 2);
        array("rewards", 2);
        let infos = episode.create_group("infos").unwrap();
        let builder = infos.new_dataset_builder().with_data(&[1.0, 2.0, 3.0]);
        builder.create("speed").unwrap();
    }
    change(&file.group("episode_1").unwrap());
    file
}

fn metadata(folder: &Path, space: &str) {
    std::fs::create_dir_all(folder.join("data")).unwrap();
    let metadata = json!({"dataset_id": "a-v0", "minari_version": "0.5.4", "data_format": "hdf5",
        "total_episodes": 2, "total_steps": 4, "observation_space": space, "action_space": space});
    std::fs::write(folder.join("data/metadata.json"), metadata.to_string()).unwrap();
}

fn open(folder: &Path) -> Result<MinariSource> {
    MinariSource::open(folder, &OpenOptions::default())
}

fn read(folder: &Path) -> Result<usize> {
    let source = open(folder)?;
    let mut n_rows = 0;
    for batch in source.scan(&Scan::default())? {
        n_rows += batch?.num_rows();
    }
    Ok(n_rows)
}

/// The error of a dataset whose second episode is changed so.
fn refused(change: impl Fn(&Path, &hdf5::Group)) -> String {
    let dir = tempfile::tempdir().unwrap();
    let file = dataset(dir.path(), |episode| change(dir.path(), episode));
    file.close().unwrap();
    let error = read(dir.path()).unwrap_err();
    assert!(
        error.to_string().ends_with("main_data.hdf5"),
        "{error} names the file"
    );
    assert!(
        matches!(error.cause(), DatasetError::Unsupported { .. }),
        "{error:?}"
    );
    error.cause().to_string()
}

#[test]
fn a_dataset_that_is_left_alone_reads() {
    let dir = tempfile::tempdir().unwrap();
    dataset(dir.path(), |_| {}).close().unwrap();
    assert_eq!(read(dir.path()).unwrap(), 6);
}

#[test]
fn links_out_of_the_file_are_refused_in_every_episode() {
    for key in ["observations", "rewards", "actions", "infos/speed"] {
        let error = refused(|folder, episode| {
            let other = hdf5::File::create(folder.join("other.hdf5")).unwrap();
            let values = ndarray::Array2::from_elem((3, 1), 7.0);
            let builder = other.new_dataset_builder().with_data(&values);
            builder.create("x").unwrap();
            other.close().unwrap();
            episode.unlink(key).unwrap();
            let target = folder.join("other.hdf5");
            episode
                .link_external(target.to_str().unwrap(), "x", key)
                .unwrap();
        });
        let expected = format!("\"episode_1/{key}\" is a soft or external link");
        assert!(error.ends_with(&expected), "{error}");
    }
}

#[test]
fn arrays_stored_in_another_file_are_refused_in_every_episode() {
    for (key, n) in [("observations", 3), ("rewards", 2), ("actions", 2)] {
        let error = refused(|folder, episode| {
            let outside = folder.join("outside.bin");
            std::fs::write(&outside, [0; 64]).unwrap();
            episode.unlink(key).unwrap();
            let builder = episode.new_dataset::<f64>().shape((n, 1));
            let builder = builder.external(outside.to_str().unwrap(), 0, n * 8);
            builder.create(key).unwrap();
        });
        let expected = format!("\"episode_1/{key}\" is stored in another file");
        assert!(error.ends_with(&expected), "{error}");
    }
}

#[test]
fn infos_that_a_later_episode_adds_are_left_out_with_a_word() {
    let dir = tempfile::tempdir().unwrap();
    let file = dataset(dir.path(), |episode| {
        let more = episode.create_group("infos/more").unwrap();
        let builder = more.new_dataset_builder().with_data(&[1.0, 2.0, 3.0]);
        builder.create("late").unwrap();
        episode.unlink("infos/speed").unwrap();
    });
    file.close().unwrap();
    let expected = Warning::ColumnLeftOut {
        column: "infos/more/late".to_owned(),
        reason: "the first episode does not have it",
    };
    assert_eq!(open(dir.path()).unwrap().info().warnings, [expected]);
    assert_eq!(read(dir.path()).unwrap(), 6);
}

#[test]
fn without_episodes_the_spaces_tell_the_columns() {
    let dir = tempfile::tempdir().unwrap();
    let space = r#"{"type": "Dict", "subspaces": {
        "b": {"type": "Tuple", "subspaces": [{"type": "Discrete", "n": 3, "start": 0},
            {"type": "Box", "dtype": "float32", "shape": [2, 2], "low": [[-Infinity]]}]},
        "achieved_goal": {"type": "MultiBinary", "n": 3}}}"#;
    metadata(dir.path(), space);
    let empty = hdf5::File::create(dir.path().join("data/main_data.hdf5")).unwrap();
    empty.close().unwrap();
    let source = open(dir.path()).unwrap();
    let columns: Vec<&str> = source
        .info()
        .observation
        .iter()
        .map(|leaf| leaf.column.as_str())
        .collect();
    assert_eq!(
        columns,
        [
            "observation.achieved_goal",
            "observation.b[0]",
            "observation.b[1]"
        ]
    );
    assert_eq!(source.info().observation_width(), 3 + 1 + 4);
    assert_eq!(source.info().n_episodes, Some(0));
    assert_eq!(source.episodes().unwrap(), []);
    assert_eq!(source.scan(&Scan::default()).unwrap().count(), 0);
    assert_eq!(crate::summarize(&source).unwrap().n_rows, 0);
    // Two warnings: the counts of the metadata are those of other episodes.
    assert_eq!(source.info().warnings.len(), 2);
}

#[test]
fn without_episodes_and_a_known_space_the_error_says_so() {
    for space in [
        r#"{"type": "Graph"}"#,
        r#"{"type": "Box", "dtype": "<U3", "shape": [1]}"#,
    ] {
        let dir = tempfile::tempdir().unwrap();
        metadata(dir.path(), space);
        let empty = hdf5::File::create(dir.path().join("data/main_data.hdf5")).unwrap();
        empty.close().unwrap();
        let error = open(dir.path()).err().unwrap();
        assert!(
            matches!(error.cause(), DatasetError::Metadata { field, .. } if field == "observation_space"),
            "{error:?}"
        );
    }
}
