//! `ksim dataset validate` at its border: exit codes, text and JSON.

use crate::process::{Demo, Rollouts, ksim};

fn validate(path: &str, flags: &[&str]) -> crate::process::Run {
    ksim(["dataset", "validate", path].iter().chain(flags))
}

#[test]
fn a_good_dataset_passes() {
    let demo = Demo::new();
    let run = validate(&demo.at("dataset.parquet"), &[]);
    assert_eq!((run.code, run.stderr.as_str()), (0, ""));
    assert!(!run.stdout.contains("error "), "{}", run.stdout);
    let run = validate(&demo.at("dataset.parquet"), &["--format", "json"]);
    let report = run.json();
    assert_eq!(report["schema"], "ksim.dataset-validate/1");
    assert_eq!(report["complete"], true);
    assert_eq!(report["n_errors"], 0);
    let checks = report["checks"].as_array().map_or(0, Vec::len);
    assert!(checks >= 5, "{checks} checks");
}

#[test]
fn the_exit_code_follows_the_severity() {
    let demo = Demo::new();
    let path = demo.at("spoiled.parquet");
    let mut spoiled = Rollouts::new(&[0; 40], [3, 2]);
    spoiled.observations[3 * 7 + 1] = f32::NAN;
    spoiled.observations[3 * 9 + 1] = 5e6;
    spoiled.write(&path);
    let run = validate(&path, &[]);
    assert_eq!((run.code, run.stderr.as_str()), (1, ""));
    let first = run.stdout.lines().nth(1).expect("a finding");
    assert!(
        first.starts_with("error    not-finite: 1 NaN in \"observation\""),
        "{first}"
    );
    assert!(
        run.stdout.contains("observation[1] episode 0 step 7"),
        "{}",
        run.stdout
    );
    assert_eq!(validate(&path, &["--fail-on", "never"]).code, 0);
    let only = validate(
        &path,
        &[
            "--fail-on",
            "never",
            "--max-findings",
            "1",
            "--format",
            "json",
        ],
    );
    let report = only.json();
    assert_eq!(report["findings"].as_array().map(Vec::len), Some(1));
    assert_eq!(report["findings"][0]["places"][0]["step"], 7);
    assert!(
        report["n_findings_left_out"].as_u64() >= Some(1),
        "{report}"
    );

    let mut huge = Rollouts::new(&[0; 40], [3, 2]);
    huge.observations[3 * 9 + 1] = 5e6;
    huge.write(&path);
    assert_eq!(validate(&path, &[]).code, 0);
    assert_eq!(validate(&path, &["--fail-on", "warning"]).code, 1);
}

#[test]
fn a_file_that_does_not_open_is_a_finding_and_a_missing_one_is_not() {
    let demo = Demo::new();
    let whole = std::fs::read(demo.at("good.parquet")).expect("the file is there");
    std::fs::write(demo.at("half.parquet"), &whole[..whole.len() / 2]).expect("it is written");
    let run = validate(&demo.at("half.parquet"), &["--format", "json"]);
    assert_eq!((run.code, run.stderr.as_str()), (1, ""));
    let report: serde_json::Value = serde_json::from_str(&run.stdout).expect("JSON");
    assert_eq!(report["findings"][0]["code"], "unreadable");
    assert_eq!(report["complete"], false);
    validate(&demo.at("missing.parquet"), &[]).failed(1, &["missing.parquet"]);
    validate(&demo.at("half.parquet"), &["--fail-on", "sometimes"]).failed(2, &["--fail-on"]);
}
