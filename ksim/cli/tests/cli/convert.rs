//! `ksim convert`.

use crate::process::{Demo, ksim};

#[test]
fn a_dataset_is_converted_and_the_report_says_what_became_of_it() {
    let demo = Demo::new();
    let (from, to) = (demo.at("good.parquet"), demo.at("out.parquet"));
    let flags = [
        "--episodes",
        "0",
        "--columns",
        "observation,action",
        "--cast",
        "action=float16",
        "--format",
        "json",
    ];
    let run = ksim(["convert", &from, &to].into_iter().chain(flags));
    let report = run.json();
    assert_eq!(report["n_episodes"], 1);
    assert_eq!(report["casts"][0]["to"], "Float16");
    assert!(
        report["casts"][0]["max_abs_error"]
            .as_f64()
            .is_some_and(|e| e > 0.0)
    );

    // It is a dataset, and a second try does not replace it unasked.
    assert_eq!(ksim(["dataset", "info", &to]).code, 0);
    ksim(["convert", &from, &to]).failed(1, &["out.parquet", "there is something already"]);
    let again = ksim(["convert", &from, &to, "--overwrite"]);
    assert_eq!(again.code, 0, "{}", again.stderr);
    assert!(
        again.stdout.contains("nothing was lost"),
        "{}",
        again.stdout
    );
    assert_eq!(demo.others().len(), 1, "{:?}", demo.others());
}

#[test]
fn what_is_there_stays_unless_it_can_be_replaced() {
    let demo = Demo::new();
    let (from, to) = (demo.at("good.parquet"), demo.at("out.parquet"));
    assert_eq!(ksim(["convert", &from, &to]).code, 0);
    let before = std::fs::read(&to).unwrap();
    // A file without actions could not be opened again.
    let without = [
        "convert",
        &from,
        &to,
        "--overwrite",
        "--columns",
        "observation",
    ];
    ksim(without).failed(1, &["no action column"]);
    assert_eq!(std::fs::read(&to).unwrap(), before);
    // A folder with a recording in it may hold anything else.
    let folder = demo.at("recordings");
    std::fs::create_dir(&folder).unwrap();
    std::fs::write(format!("{folder}/run.mcap"), "").unwrap();
    let over = ["convert", &from, &folder, "--to", "lerobot", "--overwrite"];
    ksim(over).failed(1, &["there is something already"]);
    // A folder around what is read.
    let inside = format!("{folder}/in.parquet");
    std::fs::copy(&from, &inside).unwrap();
    let around = [
        "convert",
        &inside,
        &folder,
        "--to",
        "lerobot",
        "--overwrite",
    ];
    ksim(around).failed(1, &["would replace what is read"]);
    assert!(std::fs::metadata(&inside).is_ok());
}

#[test]
fn wrong_usage_is_told_before_anything_is_read() {
    let demo = Demo::new();
    let from = demo.at("good.parquet");
    ksim(["convert", &from, &demo.at("out")]).failed(1, &["--to"]);
    ksim(["convert", &from, &from, "--overwrite"]).failed(1, &["would replace what is read"]);
    let to = demo.at("out.parquet");
    ksim(["convert", &from, &to, "--cast", "float31"]).failed(2, &["unknown type"]);
    ksim(["convert", &from, &to, "--episodes", "5..5"]).failed(2, &["empty range"]);
    ksim(["convert", &from, &to, "--episodes", "9000"]).failed(1, &["no episode in 9000..9001"]);
    assert!(demo.others().is_empty());
}
