//! `ksim report`: the page as a file, and, where `KSIM_BROWSER` says so, in a browser.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use arrow::array::{ArrayRef, BooleanArray, Float64Array, Int64Array, StringArray};
use serde_json::Value;

use crate::process::{Demo, Run, ksim, list, write_parquet};

/// Text that would be markup, if it were not taken for text.
const EVIL: &str =
    "</script><script>window.injected=1</script><img src=x onerror='window.injected=1'>";

/// Rollouts through the U-shaped maze: smooth, with as much noise as asked for.
#[derive(Clone, Copy)]
struct Walks {
    n_episodes: usize,
    n_steps: usize,
    noise: f64,
    /// Whether success, reward and novelty are recorded.
    facts: bool,
    /// Name of every second episode's planner.
    planner: Option<&'static str>,
}

impl Walks {
    const fn new(n_episodes: usize, n_steps: usize, noise: f64) -> Self {
        Self {
            n_episodes,
            n_steps,
            noise,
            facts: false,
            planner: None,
        }
    }

    fn write(self, path: impl AsRef<Path>) {
        let n = self.n_episodes * self.n_steps;
        let at = |row: usize| ((row / self.n_steps) as f64, (row % self.n_steps) as f64);
        let (mut positions, mut states, mut actions) = (Vec::new(), Vec::new(), Vec::new());
        for row in 0..n {
            let (episode, step) = at(row);
            let noise =
                |i: f64| self.noise * ((row as f64 * 78.233 + i * 37.719).sin() * 43_758.5).fract();
            let angle = 3.0 * step / self.n_steps as f64 + 0.02 * (episode % 50.0);
            positions.extend([
                (4.0 * angle.sin() + noise(1.0)) as f32,
                (4.0 * angle.cos() + noise(2.0)) as f32,
            ]);
            states.extend((0..6).map(|i| {
                ((angle * (1.0 + f64::from(i))).sin() + noise(3.0 + f64::from(i))) as f32
            }));
            actions.extend(
                (0..3).map(|i| {
                    ((2.0 * angle + f64::from(i)).cos() + noise(9.0 + f64::from(i))) as f32
                }),
            );
        }
        let int = |of: &dyn Fn((f64, f64)) -> f64| -> ArrayRef {
            Arc::new((0..n).map(|row| of(at(row)) as i64).collect::<Int64Array>())
        };
        let mut columns: Vec<(&str, ArrayRef)> = vec![
            ("episode_index", int(&|(episode, _)| episode)),
            ("step_index", int(&|(_, step)| step)),
            ("observation.achieved_goal", list(2, &positions)),
            ("observation.observation", list(6, &states)),
            ("observation.desired_goal", list(2, &[-4.0].repeat(2 * n))),
            ("action", list(3, &actions)),
        ];
        if self.facts {
            let last = self.n_steps as f64 - 1.0;
            let reached = |row: usize| at(row).1 == last && at(row).0 % 3.0 != 0.0;
            let number = |of: &dyn Fn(usize) -> f64| -> ArrayRef {
                Arc::new((0..n).map(of).collect::<Float64Array>())
            };
            columns.push(("reward", number(&|row| f64::from(u8::from(reached(row))))));
            columns.push((
                "info.success",
                Arc::new(BooleanArray::from((0..n).map(reached).collect::<Vec<_>>())),
            ));
            columns.push(("info.novelty", number(&|row| 1e-3 * (1.0 + at(row).1))));
        }
        if let Some(planner) = self.planner {
            let name = |row| {
                if at(row).0 % 2.0 == 0.0 {
                    planner
                } else {
                    "plain"
                }
            };
            columns.push((
                "planner",
                Arc::new(StringArray::from_iter_values((0..n).map(name))),
            ));
        }
        write_parquet(path, columns);
    }
}

/// A folder with a dataset and rollouts.
struct World {
    folder: tempfile::TempDir,
}

impl World {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("it is as the test made it");
        Walks::new(12, 200, 0.02).write(folder.path().join("data.parquet"));
        Self { folder }
    }

    fn at(&self, name: &str) -> String {
        self.folder
            .path()
            .join(name)
            .to_str()
            .expect("it is as the test made it")
            .to_owned()
    }

    fn write(&self, name: &str, walks: Walks) -> String {
        walks.write(self.at(name));
        self.at(name)
    }

    /// `command` of the rollouts against the dataset.
    fn run(&self, command: &str, rollouts: &[&str], flags: &[&str]) -> Run {
        let dataset = self.at("data.parquet");
        let start = [command, "--dataset", &dataset];
        ksim(start.iter().chain(rollouts).chain(flags))
    }

    /// Writes a page and what it must agree with beside each other into `folder`.
    fn page(&self, folder: &Path, name: &str, rollouts: &[&str], flags: &[&str]) {
        let file = |ending: &str| folder.join(format!("{name}.{ending}"));
        let html = file("html");
        let output = ["-o", html.to_str().expect("it is as the test made it")];
        let flags: Vec<&str> = output.iter().chain(flags).copied().collect();
        let run = self.run("report", rollouts, &flags);
        assert_eq!(run.code, 0, "{}", run.stderr);
        let json = self.run("score", rollouts, &["--format", "json"]).json();
        std::fs::write(file("json"), json.to_string()).expect("it is as the test made it");
    }
}

/// The data of a page.
fn data(html: &str) -> Value {
    let (_, rest) = html
        .split_once("<script type=\"application/json\" id=\"data\">")
        .expect("it is as the test made it");
    serde_json::from_str(
        rest.split_once("</script>")
            .expect("it is as the test made it")
            .0,
    )
    .expect("it is as the test made it")
}

fn read(path: impl AsRef<Path>) -> String {
    std::fs::read_to_string(path).expect("it is as the test made it")
}

#[test]
fn the_page_has_the_numbers_of_score_and_is_the_same_every_time() {
    let demo = Demo::new();
    let rollouts = ["good.parquet", "random.parquet"].map(|name| demo.at(name));
    let score = demo
        .score(&["good.parquet", "random.parquet"], &["--format", "json"])
        .json();
    let write = |name: &str| {
        let out = demo.at(name);
        let run = ksim([
            "report",
            &rollouts[0],
            &rollouts[1],
            "--dataset",
            &demo.at("dataset.parquet"),
            "-o",
            &out,
        ]);
        assert_eq!(run.code, 0, "{}", run.stderr);
        assert!(run.stdout.starts_with("wrote "), "{}", run.stdout);
        read(out)
    };
    let html = write("a.html");
    assert_eq!(html, write("b.html"));
    let data = data(&html);
    for (place, result) in score["results"].as_array().unwrap().iter().enumerate() {
        let shown = data["document"]["results"][place].as_object().unwrap();
        for (field, value) in shown {
            assert_eq!(*value, result[field], "{field}");
        }
        assert!(shown.contains_key("k_sim") && !shown.contains_key("elapsed_s"));
        for (number, episode) in result["episodes"].as_array().unwrap().iter().enumerate() {
            for (field, value) in episode.as_object().unwrap() {
                assert_eq!(
                    data["groups"][place]["episodes"][field][number], *value,
                    "{field}"
                );
            }
        }
    }
    assert_eq!(data["document"]["fingerprint"], score["fingerprint"]);
    assert_eq!(data["map"]["kind"], "projection");
    // Nothing of the machine, and nothing that would be loaded.
    assert!(!html.contains(demo.at("").trim_end_matches('/')));
    assert!(html.contains("default-src 'none'; script-src 'sha256-"));
    for part in [" src=", "@import", "<link rel=\"stylesheet"] {
        assert!(!html.contains(part), "{part}");
    }
    let held = &data["held_out"];
    assert_eq!(held["n_episodes"], 2);
    assert!(held["mean_scaled_distance"].as_f64().unwrap() > 0.0);
}

#[test]
fn paths_lie_in_the_maze_with_goals_success_and_novelty() {
    let world = World::new();
    let facts = Walks {
        facts: true,
        ..Walks::new(4, 60, 0.3)
    };
    let rollouts = world.write("walks.parquet", facts);
    let out = world.at("page.html");
    let run = world.run(
        "report",
        &[&rollouts],
        &["-o", &out, "--env", "antmaze-umaze"],
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let data = data(&read(&out));
    assert_eq!(data["map"]["kind"], "maze");
    assert_eq!(
        data["map"]["rows"],
        serde_json::json!(["11111", "10001", "11101", "10001", "11111"])
    );
    let episodes = &data["groups"][0]["episodes"];
    assert_eq!(
        episodes["success"],
        serde_json::json!([false, true, true, false])
    );
    assert_eq!(episodes["return"], serde_json::json!([0.0, 1.0, 1.0, 0.0]));
    assert_eq!(episodes["goals"][1], serde_json::json!([[-4.0, -4.0]]));
    assert_eq!(data["groups"][0]["steps"]["novelty"]["type"], "f32");
    // The dataset does not say what it was made in.
    let run = world.run("report", &[&rollouts], &["-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(self::data(&read(&out))["map"]["kind"], "projection");
    world
        .run("report", &[&rollouts], &["-o", &out, "--env", "Hopper-v5"])
        .failed(1, &["`Hopper-v5` has no maze"]);
}

#[test]
fn names_in_files_stay_text() {
    let world = World::new();
    let evil = Walks {
        planner: Some(EVIL),
        ..Walks::new(4, 30, 0.3)
    };
    let rollouts = world.write("<img src=x onerror='window.injected=1'>.parquet", evil);
    let out = world.at("page.html");
    let run = world.run("report", &[&rollouts], &["-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let html = read(&out);
    assert!(!html.contains("<img") && !html.contains("<script>window"));
    assert!(html.contains("<title>K-Sim of &lt;img src=x onerror='window.injected=1'&gt;.parquet"));
    let label = data(&html)["groups"][0]["label"]
        .as_str()
        .unwrap()
        .to_owned();
    assert!(label.ends_with(EVIL), "{label}");
}

#[test]
fn what_cannot_be_shown_is_said_and_leaves_no_page() {
    let world = World::new();
    let out = world.at("page.html");
    let refused = |rollouts: &str, parts: &[&str]| {
        world
            .run("report", &[rollouts], &["-o", &out])
            .failed(1, parts);
        assert!(!Path::new(&out).exists());
    };
    let none = world.write("none.parquet", Walks::new(0, 1, 0.0));
    refused(&none, &["none.parquet: no steps"]);
    let nan = world.write("nan.parquet", Walks::new(2, 5, f64::NAN));
    refused(
        &nan,
        &[
            "nan.parquet",
            "episode 0, step 0",
            "holds NaN, expected a finite number",
        ],
    );
    let many = world.write("many.parquet", Walks::new(10_001, 1, 0.1));
    refused(&many, &["10001 episodes, a page holds 10000"]);
    let own = world.write("own.parquet", Walks::new(2, 5, 0.1));
    world
        .run("report", &[&own], &["-o", &own])
        .failed(1, &["would replace what is read"]);
}

#[test]
fn one_step_and_a_novelty_without_a_number_give_a_page() {
    let world = World::new();
    let one = world.write("one.parquet", Walks::new(1, 1, 0.1));
    let out = world.at("page.html");
    let run = world.run("report", &[&one], &["-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let data = data(&read(&out));
    assert_eq!(data["groups"][0]["steps"]["n"], serde_json::json!([1]));
    assert_eq!(data["document"]["results"][0]["interval_95"], Value::Null);
    let n = 20;
    write_parquet(
        world.at("nan.parquet"),
        vec![
            (
                "episode_index",
                Arc::new(Int64Array::from(vec![0; n])) as ArrayRef,
            ),
            ("observation", list(10, &vec![0.5; 10 * n])),
            ("action", list(3, &vec![0.5; 3 * n])),
            (
                "info.novelty",
                Arc::new(Float64Array::from(vec![f64::NAN; n])),
            ),
            ("reward", Arc::new(Float64Array::from(vec![f64::NAN; n]))),
        ],
    );
    let run = world.run("report", &[&world.at("nan.parquet")], &["-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let steps = &self::data(&read(&out))["groups"][0];
    assert_eq!(steps["steps"]["novelty"], Value::Null);
    assert_eq!(steps["episodes"].get("return"), None);
}

/// Where the script of the browser lies.
fn browser_tests() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser")
}

/// Opens pages in a browser: `KSIM_BROWSER=1` after `npm ci` in `tests/browser`. `KSIM_PAGES` keeps them in a folder.
#[test]
fn pages_work_in_a_browser() {
    let in_browser = std::env::var_os("KSIM_BROWSER").is_some();
    let kept = std::env::var_os("KSIM_PAGES").map(PathBuf::from);
    if !in_browser && kept.is_none() {
        return;
    }
    let world = World::new();
    let folder = kept.unwrap_or_else(|| world.folder.path().join("pages"));
    std::fs::create_dir_all(&folder).unwrap();
    let facts = |walks: Walks| Walks {
        facts: true,
        ..walks
    };
    let rough = world.write("rough.parquet", facts(Walks::new(6, 300, 0.8)));
    let smooth = world.write("smooth.parquet", facts(Walks::new(8, 300, 0.1)));
    world.page(
        &folder,
        "maze",
        &[&smooth, &rough],
        &["--env", "antmaze-umaze"],
    );
    let evil = Walks {
        planner: Some(EVIL),
        ..Walks::new(30, 60, 0.4)
    };
    let evil = world.write("<img src=x onerror='window.injected=1'>.parquet", evil);
    world.page(&folder, "names", &[&evil], &[]);
    let one = world.write("one.parquet", Walks::new(1, 1, 0.1));
    world.page(&folder, "one", &[&one], &[]);
    let large = world.write("large.parquet", facts(Walks::new(100, 1000, 0.4)));
    world.page(&folder, "large", &[&large], &["--env", "antmaze-umaze"]);
    let size = folder.join("large.html").metadata().unwrap().len();
    assert!(
        size <= 5_000_000,
        "100 episodes of 1000 steps take {size} bytes"
    );
    let many = world.write("many.parquet", facts(Walks::new(10_000, 15, 0.4)));
    world.page(&folder, "many", &[&many], &[]);
    let notes = data(&read(folder.join("many.html")))["notes"].to_string();
    assert!(notes.contains("of every 2 steps of an episode"), "{notes}");
    if in_browser {
        let script = browser_tests().join("check.mjs");
        let output = Command::new("node")
            .arg(script)
            .arg(&folder)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(
            output.status.success(),
            "{said}\n{}",
            String::from_utf8_lossy(&output.stderr)
        );
    }
}
