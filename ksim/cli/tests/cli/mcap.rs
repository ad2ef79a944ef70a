//! Recordings: inspected, mapped and scored.

use std::path::Path;

use crate::process::ksim;

/// A recording of the golden folder.
fn recording(name: &str) -> String {
    let root = match std::env::var_os("KSIM_GOLDEN") {
        Some(root) => root.into(),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fixtures/golden"),
    };
    let path = root.join("formats/mcap").join(name);
    path.to_str().expect("a path in UTF-8").to_owned()
}

#[test]
fn golden_mcap_a_recording_is_inspected_mapped_and_scored() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| {
        folder
            .path()
            .join(name)
            .to_str()
            .expect("a path in UTF-8")
            .to_owned()
    };
    let file = recording("ros2_zstd.mcap");
    let mapping = at("mapping.toml");

    ksim(["score", &file, "--dataset", &file]).failed(1, &["needs a mapping", "--propose"]);
    let inspection = ksim([
        "dataset",
        "inspect",
        &file,
        "--format",
        "json",
        "--propose",
        &mapping,
    ])
    .json();
    assert_eq!(
        inspection["topics"][0]["topic"],
        "/camera/wrist/image_raw/compressed"
    );
    let text = ksim(["dataset", "inspect", &file]);
    assert!(text.stdout.contains("/joint_states"), "{}", text.stdout);

    let flags = ["--mapping", &mapping];
    let info = ksim(["dataset", "info", &file].into_iter().chain(flags));
    assert_eq!(info.code, 0, "{}", info.stderr);
    let score = ["score", &file, "--dataset", &file, "--format", "json"];
    let document = ksim(score.into_iter().chain(flags)).json();
    assert_eq!(document["results"][0]["n_episodes"], 1, "{document}");

    let out = at("out.parquet");
    let convert = ksim(["convert", &file, &out].into_iter().chain(flags));
    assert_eq!(convert.code, 0, "{}", convert.stderr);
    let back = at("back.mcap");
    let convert = ksim(["convert", &out, &back]);
    assert_eq!(convert.code, 0, "{}", convert.stderr);
    let columns = |args: &[&str]| {
        ksim(
            ["dataset", "info"]
                .iter()
                .chain(args)
                .chain(&["--format", "json"]),
        )
        .json()["columns"]
            .clone()
    };
    assert_eq!(
        columns(&[&back]),
        columns(&[&out]),
        "a written recording brings its mapping along"
    );

    // It is proposed as it is, and never over what is there.
    let own = at("own.toml");
    let propose = || ksim(["dataset", "inspect", &back, "--propose", &own]);
    assert_eq!(propose().code, 0);
    propose().failed(1, &["there is something already"]);
    let steps = |flags: &[&str]| {
        let start = ["dataset", "info", &back, "--format", "json"];
        ksim(start.iter().chain(flags)).json()["n_steps"].clone()
    };
    assert_eq!(steps(&["--mapping", &own]), steps(&[]));
    let text = std::fs::read_to_string(&own).expect("it was written");
    assert!(text.starts_with("# Written by ksim"), "{text}");
}

#[test]
fn golden_mcap_what_cannot_be_inspected_is_named() {
    ksim(["dataset", "inspect", "none.mcap"]).failed(1, &["none.mcap"]);
    ksim(["dataset", "inspect", &recording("ros2_truncated.mcap")])
        .failed(1, &["ros2_truncated.mcap"]);
    let recovered = ksim([
        "dataset",
        "inspect",
        "--recover",
        &recording("ros2_truncated.mcap"),
    ]);
    assert_eq!(recovered.code, 3, "{}", recovered.stderr);
}
