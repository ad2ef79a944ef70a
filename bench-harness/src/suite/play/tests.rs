use std::path::Path;

use super::*;
use crate::report::{Report, json, markdown};

/// Counts what it is told, and stops where it is told to.
#[derive(Default)]
struct Watch {
    cells: Vec<(String, bool)>,
    stop_in_cell: Option<usize>,
}

impl SuiteObserver for Watch {
    fn cell(&mut self, cell: &CellName<'_>, _number: usize, _of: usize, is_done: bool) {
        self.cells.push((cell.to_string(), is_done));
    }

    fn progress(&mut self, _n_episodes: usize, _n_steps: u64) -> Continue {
        match self.stop_in_cell == Some(self.cells.len()) {
            true => Continue::Stop,
            false => Continue::Yes,
        }
    }
}

fn suite() -> Suite {
    let planner = |name: &str, policy: &str| PlannerEntry {
        name: name.to_owned(),
        policy: Some(policy.to_owned()),
        ..PlannerEntry::default()
    };
    let environment = |name: &str, max_steps| EnvironmentEntry {
        name: name.to_owned(),
        env: Some("PointMass-v0".to_owned()),
        max_steps: Some(max_steps),
        ..EnvironmentEntry::default()
    };
    Suite {
        name: "toy".to_owned(),
        episodes: 4,
        runs: 2,
        seed: 10,
        discount: 0.9,
        environments: vec![environment("short", 5), environment("long", 30)],
        planners: vec![
            PlannerEntry {
                name: "drawn".to_owned(),
                source: Some("random".to_owned()),
                replan_interval: NonZeroUsize::new(2),
                candidates: Some(3),
                ..PlannerEntry::default()
            },
            planner("still", "zero"),
        ],
        folder: std::path::PathBuf::new(),
    }
}

fn played(suite: &Suite, folder: &Path, n_slots: usize, watch: &mut Watch) -> Played {
    let run_dir = RunDir::open(folder).unwrap();
    let n_slots = NonZeroUsize::new(n_slots).unwrap();
    play(suite, &Registry::builtin(), &run_dir, n_slots, watch).unwrap()
}

#[test]
fn every_cell_is_played_with_seeds_of_its_run() {
    let folder = tempfile::tempdir().unwrap();
    let mut watch = Watch::default();
    let played = played(&suite(), folder.path(), 3, &mut watch);
    assert!(played.finished);
    assert_eq!(played.rows.len(), 2 * 2 * 2 * 4);
    let order: Vec<&str> = watch.cells.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(
        order[..3],
        [
            "drawn in short, run 0",
            "drawn in short, run 1",
            "still in short, run 0"
        ]
    );
    for rows in played.rows.chunks(8) {
        let seeds: Vec<u64> = rows.iter().map(|row| row.record.seed).collect();
        assert_eq!(seeds, [10, 11, 12, 13, 14, 15, 16, 17]);
        let runs: Vec<usize> = rows.iter().map(|row| row.record.run).collect();
        assert_eq!(runs, [0, 0, 0, 0, 1, 1, 1, 1]);
    }
    let still = played.rows.iter().filter(|row| row.planner == "still");
    assert!(still.clone().all(|row| row.record.total_return == 0.0));
    assert!(still.clone().any(|row| row.record.length == 30));
}

#[test]
fn what_was_stopped_goes_on_and_ends_as_if_it_had_not_been() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, broken) = (folder.path().join("whole"), folder.path().join("broken"));
    let expected = played(&suite(), &whole, 1, &mut Watch::default());
    let mut watch = Watch {
        stop_in_cell: Some(3),
        ..Watch::default()
    };
    let stopped = played(&suite(), &broken, 2, &mut watch);
    assert!(!stopped.finished && stopped.rows.len() == 8);
    assert!(!broken.join("episodes.parquet").exists());
    let mut watch = Watch::default();
    let done = played(&suite(), &broken, 4, &mut watch);
    let n_done = watch.cells.iter().filter(|(_, is_done)| *is_done).count();
    assert_eq!(n_done, 2);
    assert_eq!(done, expected);
    let bytes = |folder: &Path| std::fs::read(folder.join("episodes.parquet")).unwrap();
    assert!(bytes(&whole) == bytes(&broken));
}

#[test]
fn the_report_has_both_accounting_rules_with_intervals() {
    let folder = tempfile::tempdir().unwrap();
    let mut suite = suite();
    // As if it were a task of the paper: its figures stand beside.
    suite.environments[0].paper = Some("antmaze-large-play".to_owned());
    let mut played = played(&suite, folder.path(), 2, &mut Watch::default());
    let key = ("drawn".to_owned(), "short".to_owned());
    played.families.insert(key, "curiosity-diffuser".to_owned());
    let report = Report::new(&suite, &played);
    assert_eq!(report.entries.len(), 4);
    assert_eq!(report.entries[0].summary.n_episodes, 8);
    let text = markdown(&report);
    for part in [
        "# toy",
        "2 runs of 4 episodes each, seeds from 10",
        "| at any step | at the last step |",
        "| short | drawn | 0.0 [0.0, 32.4] | 0.0 [0.0, 32.4] | paper: 34.0 at the last step, λ 1e6 |",
        "| short | still | 0.0 [0.0, 32.4] | 0.0 [0.0, 32.4] | – |",
        "the released code counts Diffuser's success at any step",
    ] {
        assert!(text.contains(part), "{part} in {text}");
    }
    assert!(!text.contains("## K-Sim") && !text.contains("## Normalized"));
    let document = json(&report, &played);
    assert_eq!(document["results"][0]["paper"]["rule"], "at-end");
    assert_eq!(
        document["results"][0]["summary"]["success"]["ever"]["value"],
        0.0
    );
    assert_eq!(document["manifest"]["suite"]["planner"][0]["candidates"], 3);
}

#[test]
fn other_files_and_settings_are_refused_and_change_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (results, file) = (
        folder.path().join("results"),
        folder.path().join("p.safetensors"),
    );
    let write = |text: &str| {
        let text = format!("{{\"__metadata__\":{{\"ksim\":{text:?}}}}}");
        let mut bytes = (text.len() as u64).to_le_bytes().to_vec();
        bytes.extend(text.as_bytes());
        std::fs::write(&file, bytes).unwrap();
    };
    // Files are hashed, whatever they are.
    let player = |suite: &Suite| -> Value {
        let planner = PlannerEntry {
            source: Some(file.to_str().unwrap().to_owned()),
            ..PlannerEntry::default()
        };
        let source = planner
            .source_in(&suite.environments[0], &suite.folder)
            .unwrap();
        let player = Player {
            suite,
            families: &Registry::builtin(),
            planner: &planner,
            source,
            n_slots: NonZeroUsize::MIN,
        };
        let site = Site::new(&suite.environments[0], &mut Watch::default()).unwrap();
        player.settings(&site, &mut Contents::default()).unwrap()
    };
    let mut suite = suite();
    write("{\"family\":\"diffuser\",\"finished\":true}");
    let before = player(&suite);
    assert_eq!(player(&suite), before);
    write("{\"family\":\"diffuser\",\"finished\":null}");
    assert_ne!(player(&suite)["run_hash"], before["run_hash"]);
    assert_eq!(before["version"], env!("CARGO_PKG_VERSION"));
    suite.planners.truncate(1);
    played(&suite, &results, 1, &mut Watch::default());
    let manifest = std::fs::read(results.join("manifest.json")).unwrap();
    suite.planners[0].candidates = Some(2);
    let run_dir = RunDir::open(&results).unwrap();
    let slots = NonZeroUsize::MIN;
    let error = play(
        &suite,
        &Registry::builtin(),
        &run_dir,
        slots,
        &mut Watch::default(),
    );
    assert_eq!(error.unwrap_err().to_string(), "drawn in short, run 0");
    assert!(std::fs::read(results.join("manifest.json")).unwrap() == manifest);
}

#[test]
fn a_cell_that_fails_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let run_dir = RunDir::open(folder.path()).unwrap();
    let mut suite = suite();
    suite.planners[1].policy = Some("mlp:none.safetensors".to_owned());
    let mut watch = Watch::default();
    let slots = NonZeroUsize::MIN;
    let error = play(&suite, &Registry::builtin(), &run_dir, slots, &mut watch).unwrap_err();
    assert_eq!(error.to_string(), "still in short, run 0");
    // Before anything is played or written.
    assert!(watch.cells.is_empty() && !folder.path().join("manifest.json").exists());
    suite.planners[1].policy = None;
    suite.planners[1].source = Some("no/such/run".to_owned());
    let error = play(&suite, &Registry::builtin(), &run_dir, slots, &mut watch).unwrap_err();
    assert!(error.to_string().contains("still"), "{error}");
}
