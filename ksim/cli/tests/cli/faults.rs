//! Bad input and interrupts: a clear message, the right exit code, no file left behind.

use crate::process::{Demo, Rollouts, command, finished, ksim, wait_until_at_work};

#[test]
fn bad_input_is_named_and_leaves_no_file() {
    let demo = Demo::new();
    Rollouts::new(&[0, 0], [29, 8]).write(demo.at("narrow.parquet"));
    Rollouts::new(&[0, 0], [31, 6]).write(demo.at("arms.parquet"));
    Rollouts::new(&[], [31, 8]).write(demo.at("norows.parquet"));
    let mut bad = Rollouts::new(&[5, 5, 5], [31, 8]);
    bad.observations[31 + 7] = f32::NAN;
    bad.write(demo.at("nan.parquet"));
    let mut bad = Rollouts::new(&[5, 5, 5], [31, 8]);
    bad.actions[2 * 8] = f32::INFINITY;
    bad.write(demo.at("inf.parquet"));
    std::fs::write(demo.at("zero.parquet"), "").unwrap();
    std::fs::write(demo.at("notes.txt"), "hello").unwrap();
    let whole = std::fs::read(demo.at("good.parquet")).unwrap();
    std::fs::write(demo.at("half.parquet"), &whole[..whole.len() / 2]).unwrap();
    std::fs::create_dir(demo.at("folder")).unwrap();
    let before = demo.others().len();
    let out = demo.at("steps.parquet");
    for (file, parts) in [
        (
            "narrow.parquet",
            &[
                "narrow.parquet",
                "observations have 29 columns, expected 31",
                "dataset.parquet",
            ][..],
        ),
        (
            "arms.parquet",
            &["arms.parquet", "actions have 6 columns, expected 8"],
        ),
        ("norows.parquet", &["norows.parquet", "no "]),
        (
            "nan.parquet",
            &[
                "nan.parquet: episode 5, step 1: observation column 7",
                "NaN",
            ],
        ),
        (
            "inf.parquet",
            &["inf.parquet: episode 5, step 2: action column 0 holds inf"],
        ),
        ("zero.parquet", &["zero.parquet", "empty"]),
        ("notes.txt", &["notes.txt", "hello"]),
        ("half.parquet", &["half.parquet"]),
        ("folder", &["folder", "not a dataset"]),
        ("missing.parquet", &["missing.parquet"]),
    ] {
        demo.score(&["good.parquet", file], &["--per-step", &out])
            .failed(1, parts);
        let dataset = demo.at(file);
        ksim([
            "score",
            &demo.at("good.parquet"),
            "--dataset",
            &dataset,
            "--per-step",
            &out,
        ])
        .failed(1, &[]);
    }
    assert_eq!(demo.others().len(), before, "{:?}", demo.others());
}

#[test]
fn dataset_names_are_looked_up_with_care() {
    let demo = Demo::new();
    let good = demo.at("good.parquet");
    let roots = tempfile::tempdir().unwrap();
    let run = |name: &str| {
        let mut command = command();
        command.env("MINARI_DATASETS_PATH", roots.path());
        finished(
            &command
                .args(["score", &good, "--dataset", name])
                .output()
                .unwrap(),
        )
    };
    run("../antmaze-large-play").failed(1, &[".."]);
    run("D4RL/../../antmaze/large-play-v1").failed(1, &[".."]);
    run("antmaze-large-play").failed(
        1,
        &["antmaze-large-play", "looked for", "ksim dataset download"],
    );
}

#[test]
fn a_target_that_cannot_be_written_is_refused_before_the_work() {
    let demo = Demo::new();
    std::fs::create_dir(demo.at("folder")).unwrap();
    let score = |target: &str| demo.score(&["no-such.parquet"], &["--per-step", &demo.at(target)]);
    score("folder").failed(1, &["is a folder"]);
    score("none/steps.parquet").failed(1, &["there is no folder"]);
}

#[test]
fn an_input_is_never_written_over() {
    let demo = Demo::new();
    let bytes = |name: &str| std::fs::read(demo.at(name)).unwrap();
    let before = ["dataset.parquet", "good.parquet"].map(bytes);
    for target in ["dataset.parquet", "good.parquet", "./good.parquet"] {
        let target = demo.at(target);
        demo.score(&["good.parquet"], &["--per-step", &target])
            .failed(1, &["would replace what is read"]);
    }
    // Centers are refused before they are read.
    let centers = demo.at("noisy.parquet");
    let flags = ["--centers", &centers, "--per-step", &centers];
    demo.score(&["good.parquet"], &flags)
        .failed(1, &["would replace what is read"]);
    assert_eq!(["dataset.parquet", "good.parquet"].map(bytes), before);
}

#[cfg(unix)]
#[test]
fn a_device_is_no_target() {
    let demo = Demo::new();
    demo.score(&["no-such.parquet"], &["--per-step", "/dev/null"])
        .failed(1, &["is not a regular file"]);
}

/// Sends a signal to a process of this test.
#[cfg(unix)]
fn interrupted(signal: &str) {
    let demo = Demo::new();
    let (out, dataset) = (demo.at("steps.parquet"), demo.at("dataset.parquet"));
    let mut command = command();
    command.args([
        "score",
        "--search",
        "linear",
        "--dataset",
        &dataset,
        "--per-step",
        &out,
    ]);
    // Long enough to be interrupted: the dataset against itself, again and again.
    command.args(std::iter::repeat_n(&dataset, 500));
    let mut child = command
        .stderr(std::process::Stdio::null())
        .spawn()
        .expect("the binary runs");
    wait_until_at_work(&child);
    let id = child.id().to_string();
    assert!(
        std::process::Command::new("kill")
            .args([signal, &id])
            .status()
            .expect("kill runs")
            .success()
    );
    let code = child.wait().expect("it ends").code();
    let expected = if signal == "-KILL" { None } else { Some(130) };
    assert_eq!(code, expected);
    assert!(demo.others().is_empty(), "{:?}", demo.others());
}

#[cfg(unix)]
#[test]
fn an_interrupt_leaves_no_file() {
    interrupted("-INT");
    interrupted("-TERM");
    interrupted("-KILL");
}
