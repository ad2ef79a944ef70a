//! Columns of the rollouts and of the dataset: which go together, and what is refused.

use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array};

use crate::process::{list, write_parquet};

/// A folder for files with leaves of their own.
struct Leaves(tempfile::TempDir);

impl Leaves {
    /// A file of two episodes whose leaves are named, in this order; equal names hold equal values.
    fn write(&self, file: &str, leaves: &[(&str, usize)], shift: f32) -> String {
        let episodes: Vec<i64> = (0..40).map(|row| row / 20).collect();
        let n = episodes.len();
        let mut columns: Vec<(&str, ArrayRef)> =
            vec![("episode_index", Arc::new(Int64Array::from(episodes)))];
        for &(name, width) in leaves {
            let phase = name.bytes().map(f32::from).sum::<f32>();
            let scale = if name.ends_with('a') { 1.0 } else { 50.0 };
            let value = |i: usize| scale * ((i as f32 * 0.7 + phase).sin() + shift);
            let values: Vec<f32> = (0..n * width).map(value).collect();
            columns.push((name, list(width, &values)));
        }
        let path = self.0.path().join(file);
        write_parquet(&path, columns);
        path.to_str().expect("UTF-8").to_owned()
    }
}

fn score(rollouts: &str, dataset: &str, flags: &[&str]) -> crate::process::Run {
    let fixed = ["score", rollouts, "--dataset", dataset, "--format", "json"];
    crate::process::ksim(fixed.iter().chain(flags))
}

fn k_sim(rollouts: &str, dataset: &str, flags: &[&str]) -> f64 {
    let document = score(rollouts, dataset, flags).json();
    document["results"][0]["k_sim"].as_f64().expect("a number")
}

#[test]
fn leaves_go_together_by_name_whatever_their_order() {
    let files = Leaves(tempfile::tempdir().unwrap());
    let (a, b) = (("observation.a", 2), ("observation.b", 2));
    let (arm, leg) = (("action.a", 1), ("action.b", 1));
    let dataset = files.write("dataset.parquet", &[a, b, arm, leg], 0.0);
    let same = files.write("same.parquet", &[a, b, arm, leg], 0.3);
    let other = files.write("other.parquet", &[leg, b, arm, a], 0.3);
    for flags in [
        &[][..],
        &["--state-columns", "a"],
        &["--state-columns", "b[1],a[0]"],
        &["--definition", "released"],
    ] {
        let expected = k_sim(&same, &dataset, flags);
        assert!(expected < 1.0);
        assert_eq!(k_sim(&other, &dataset, flags), expected, "{flags:?}");
    }
    // Nothing but the chosen leaves has to be there.
    let only_a = files.write("only.parquet", &[a, leg, arm], 0.3);
    let flags = ["--state-columns", "a"];
    assert_eq!(
        k_sim(&only_a, &dataset, &flags),
        k_sim(&same, &dataset, &flags)
    );
}

#[test]
fn leaves_without_a_counterpart_are_refused() {
    let files = Leaves(tempfile::tempdir().unwrap());
    let (a, b, action) = (("observation.a", 2), ("observation.b", 3), ("action", 1));
    let dataset = files.write("dataset.parquet", &[a, b, action], 0.0);
    let renamed = files.write("renamed.parquet", &[a, ("observation.c", 3), action], 0.3);
    score(&renamed, &dataset, &[]).failed(
        1,
        &[
            "nothing goes with observation.b",
            "observation.a (2), observation.c (3)",
            "observation.a (2), observation.b (3)",
        ],
    );
    let arms = [a, b, ("action.a", 1), ("action.b", 1)];
    let arms = files.write("arms.parquet", &arms, 0.3);
    score(&arms, &dataset, &[]).failed(1, &["actions have 2 columns, expected 1"]);
    // The total is the same, the widths are not.
    let swapped = [("observation.a", 3), ("observation.b", 2), action];
    let swapped = files.write("swapped.parquet", &swapped, 0.3);
    score(&swapped, &dataset, &[]).failed(1, &["observation.a has 3 columns, expected 2"]);
    let [one, two] = ["observation.x", "observation.y"]
        .map(|name| files.write(&format!("{name}.parquet"), &[(name, 5), action], 0.3));
    score(&one, &two, &[]).failed(1, &["nothing goes with observation.y"]);
    score(&one, &dataset, &[]).failed(1, &["nothing goes with observation.a"]);
}

#[test]
fn a_single_vector_goes_by_position_and_lists_go_as_listed() {
    let files = Leaves(tempfile::tempdir().unwrap());
    let (a, b, action) = (("observation.a", 2), ("observation.b", 3), ("action", 1));
    let dataset = files.write("dataset.parquet", &[a, b, action], 0.0);
    let flat = files.write("flat.parquet", &[("observation", 5), action], 0.3);
    assert!(k_sim(&flat, &dataset, &[]) <= 1.0);
    let short = files.write("short.parquet", &[("observation", 4), action], 0.3);
    score(&short, &dataset, &[]).failed(1, &["observations have 4 columns, expected 5"]);
    let own = files.write("own.parquet", &[("q", 3), ("p", 2), action], 0.3);
    let lists = |own: &'static str| {
        [
            own,
            "--dataset-observation-columns=observation.a,observation.b",
        ]
    };
    let listed = k_sim(&own, &dataset, &lists("--observation-columns=p,q"));
    assert!(listed <= 1.0);
    score(&own, &dataset, &lists("--observation-columns=q,p"))
        .failed(1, &["observation.q has 3 columns, expected 2"]);
}
