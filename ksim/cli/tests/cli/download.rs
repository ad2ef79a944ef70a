//! `ksim dataset download` from a server of this test, and the list of what is published.

use crate::process::{Run, command, finished, ksim};
use crate::server::{Reply, Server};

const NAME: &str = "kitchen-complete-v0";
const FILE: &str = "mini_kitchen_microwave_kettle_light_slider-v0.hdf5";

fn file() -> Vec<u8> {
    let fixtures = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../tests/fixtures/golden/data_fixtures"
    );
    std::fs::read(format!("{fixtures}/d4rl/hopper_medium-v0_layout.hdf5")).expect("it works")
}

fn download(folder: &std::path::Path, arguments: &[&str]) -> Run {
    let mut command = command();
    command.env("D4RL_DATASET_DIR", folder).env("NO_PROXY", "*");
    let command = command.args(["dataset", "download"]).args(arguments);
    finished(&command.output().expect("it works"))
}

#[test]
fn a_dataset_is_fetched_by_its_name() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(|request, _| Reply::file(request, "\"a\"", &file()));
    let run = |flags: &[&str]| {
        let base = ["--base-url", &server.url, NAME];
        download(folder.path(), &[&base, flags].concat())
    };
    let dry = run(&["--dry-run"]).stdout;
    for part in [
        FILE,
        &server.url,
        folder.path().to_str().unwrap(),
        "not known",
    ] {
        assert!(dry.contains(part), "no {part} in {dry}");
    }
    assert_eq!(server.asked().len(), 0);
    let text = run(&[]);
    assert_eq!(
        (text.code, text.stderr.contains("warning")),
        (0, true),
        "{}",
        text.stderr
    );
    assert!(
        text.stdout.contains(&format!("--dataset {NAME}")),
        "{}",
        text.stdout
    );
    assert_eq!(std::fs::read(folder.path().join(FILE)).unwrap(), file());
    let json = run(&["--format", "json"]).json();
    assert_eq!(json["schema"], "ksim.dataset-download/1");
    assert_eq!(json["datasets"][0]["was_there"], true);
    assert_eq!(json["datasets"][0]["bytes"], file().len());
    assert_eq!(server.asked().len(), 1);
    #[cfg(feature = "hdf5")]
    {
        let mut info = command();
        info.env("D4RL_DATASET_DIR", folder.path());
        let json = finished(
            &info
                .args(["dataset", "info", NAME, "--format", "json"])
                .output()
                .unwrap(),
        );
        let json: serde_json::Value = serde_json::from_str(&json.stdout).unwrap();
        assert_eq!(
            (&json["ref_min_score"], &json["ref_max_score"]),
            (&0.0.into(), &4.0.into())
        );
    }
}

#[test]
fn a_failed_download_says_why_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(|_, _| Reply::new(404, ""));
    let base = ["--base-url", &server.url];
    let run = |name: &str| download(folder.path(), &[&base[..], &[name]].concat());
    run("pen-human-v1").failed(1, &["404", &server.url, "D4RL/pen/human-v2"]);
    run("no-such-name").failed(1, &["dataset list --known"]);
    run("../x-v0").failed(1, &["refused"]);
    download(folder.path(), &["--base-url", "http://127.0.0.1:1", NAME])
        .failed(1, &["cannot reach"]);
    download(folder.path(), &[]).failed(2, &["NAME"]);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn what_is_published_is_listed() {
    let all = ksim(["dataset", "list", "--known", "--format", "json"]).json();
    assert_eq!(all["schema"], "ksim.known-datasets/1");
    let n_all = all["datasets"].as_array().unwrap().len();
    let some = ksim([
        "dataset",
        "list",
        "--known",
        "hopper-medium",
        "--format",
        "json",
    ])
    .json();
    let some = some["datasets"].as_array().unwrap();
    assert!(!some.is_empty() && some.len() < n_all);
    assert!(
        some.iter()
            .all(|known| known["id"].as_str().unwrap().contains("hopper-medium"))
    );
    let text = ksim(["dataset", "list", "--known", "atari"]).stdout;
    assert!(text.contains("atari/*/expert-v0"), "{text}");
    let none = ksim(["dataset", "list", "--known", "nothing-of-it"]).stdout;
    assert!(none.contains("no published dataset"), "{none}");
}
