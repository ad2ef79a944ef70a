//! K-Sim against values recorded from the reference scripts (numpy, scikit-learn), with the
//! reference's cluster centers where it clusters. Runs over every recording it finds under
//! `$KSIM_GOLDEN`, or the copies in `tests/fixtures/golden`.

#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use ksim::{KSim, KSimParams, Report, Search, Trajectories};
use ksim_datasets::{OpenOptions, TransitionOptions, TransitionReader};
use safetensors::{Dtype, SafeTensors};

/// Scores, distances and means of f64 recordings agree to this, relative to 1 and above.
const TOLERANCE: f64 = 1e-9;

fn golden() -> PathBuf {
    match std::env::var_os("KSIM_GOLDEN") {
        Some(folder) => PathBuf::from(folder),
        None => ksim_tests::root().join("tests/fixtures/golden"),
    }
}

/// The recordings in one folder whose names start with `ksim`.
fn recordings(folder: &str) -> Vec<PathBuf> {
    let folder = golden().join(folder);
    let entries =
        std::fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let mut found: Vec<PathBuf> = entries
        .map(|entry| entry.unwrap().path())
        .filter(|path| {
            let name = path
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned();
            name.starts_with("ksim") && name.ends_with(".safetensors")
        })
        .collect();
    found.sort();
    assert!(!found.is_empty(), "no recording in {}", folder.display());
    found
}

struct Recording {
    tensors: HashMap<String, (Vec<usize>, Vec<f64>)>,
    metadata: HashMap<String, String>,
    name: String,
}

impl Recording {
    fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap();
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let tensors = SafeTensors::deserialize(&bytes).unwrap();
        let tensors = tensors
            .iter()
            .map(|(name, view)| {
                let bytes = view.data();
                let values = match view.dtype() {
                    Dtype::F64 => bytes
                        .as_chunks()
                        .0
                        .iter()
                        .map(|b| f64::from_le_bytes(*b))
                        .collect(),
                    Dtype::F32 => bytes
                        .as_chunks()
                        .0
                        .iter()
                        .map(|b| f32::from_le_bytes(*b).into())
                        .collect(),
                    Dtype::I32 => bytes
                        .as_chunks()
                        .0
                        .iter()
                        .map(|b| i32::from_le_bytes(*b).into())
                        .collect(),
                    Dtype::I64 => bytes
                        .as_chunks()
                        .0
                        .iter()
                        .map(|b| i64::from_le_bytes(*b) as f64)
                        .collect(),
                    other => panic!("{name} is {other:?}"),
                };
                (name.to_owned(), (view.shape().to_vec(), values))
            })
            .collect();
        let metadata = header.metadata().clone().unwrap_or_default();
        Self {
            tensors,
            metadata,
            name: path.display().to_string(),
        }
    }

    fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    fn get(&self, name: &str) -> &[f64] {
        &self
            .tensors
            .get(name)
            .unwrap_or_else(|| panic!("{}: no {name}", self.name))
            .1
    }

    fn width(&self, name: &str) -> usize {
        self.tensors[name].0[1]
    }

    /// The first `columns` of a matrix.
    fn columns(&self, name: &str, columns: std::ops::Range<usize>) -> Vec<f64> {
        let rows = self.get(name).chunks_exact(self.width(name));
        rows.flat_map(|row| row[columns.clone()].to_vec()).collect()
    }
}

#[track_caller]
fn assert_close(found: f64, expected: f64, what: &str) {
    let allowed = TOLERANCE * expected.abs().max(1.0);
    assert!(
        (found - expected).abs() <= allowed,
        "{what}: found {found}, expected {expected}"
    );
}

#[track_caller]
fn assert_all_close(found: impl ExactSizeIterator<Item = f64>, expected: &[f64], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}: number of values");
    for (index, (found, &expected)) in found.zip(expected).enumerate() {
        assert_close(found, expected, &format!("{what}[{index}]"));
    }
}

/// The released script's rule: states are the first two columns, every trajectory is cut to the
/// shorter of its observations and actions. The recording does not say its K: one must fit all.
#[test]
fn golden_released_script() {
    for path in recordings("planners") {
        let recording = Recording::read(&path);
        let n_actions = recording.width("ref_act");
        let mut reference = Trajectories::new(2, n_actions).unwrap();
        reference
            .push(
                0,
                &recording.columns("ref_obs", 0..2),
                recording.get("ref_act"),
            )
            .unwrap();
        let params = KSim::params()
            .search(Search::Clusters)
            .centers(recording.get("xy.centers").to_vec());
        let ksim = params.clone().fit(reference.clone()).unwrap();
        let (states, actions) = ksim.normalizers();
        let means = states
            .mean()
            .iter()
            .chain(actions.mean())
            .copied()
            .collect::<Vec<_>>();
        let stds = states
            .std()
            .iter()
            .chain(actions.std())
            .copied()
            .collect::<Vec<_>>();
        assert_all_close(means.into_iter(), recording.get("std.mean"), "mean");
        assert_all_close(stds.into_iter(), recording.get("std.std"), "std");
        let labels = ksim.index().kmeans().unwrap().labels();
        assert_all_close(
            labels.iter().map(|&l| l.into()),
            recording.get("xy.labels"),
            "labels",
        );

        let rollouts = released_rollouts(&recording, n_actions);
        assert!(!rollouts.is_empty(), "{}: no trajectory", recording.name);
        let fits = |k: &usize| {
            let ksim = params
                .clone()
                .n_neighbors(*k)
                .fit(reference.clone())
                .unwrap();
            let mut distances = rollouts.iter().map(|(rollout, expected)| {
                let steps = ksim.score(rollout).unwrap().steps;
                steps.iter().zip(expected).all(|(step, expected)| {
                    let found = [step.distance, step.state_distance, step.action_distance];
                    found
                        .iter()
                        .zip(expected)
                        .all(|(f, e)| (f - e).abs() <= TOLERANCE * e.max(1.0))
                })
            });
            distances.all(|same| same)
        };
        assert!(
            (1..=100).any(|k| fits(&k)),
            "{}: no K gives the distances",
            recording.name
        );
    }
}

/// Every trajectory with the distances recorded for its steps: joint, of states, of actions.
fn released_rollouts(
    recording: &Recording,
    n_actions: usize,
) -> Vec<(Trajectories, Vec<[f64; 3]>)> {
    (0..)
        .take_while(|t| recording.has(&format!("traj{t}.obs")))
        .map(|t| {
            let states = recording.columns(&format!("traj{t}.obs"), 0..2);
            let actions = recording.get(&format!("traj{t}.act"));
            let n = (states.len() / 2).min(actions.len() / n_actions);
            let mut rollout = Trajectories::new(2, n_actions).unwrap();
            rollout
                .push(0, &states[..n * 2], &actions[..n * n_actions])
                .unwrap();
            let [joint, state, action] = ["state_action", "state", "action"]
                .map(|what| recording.get(&format!("xy.traj{t}.dist_{what}")));
            assert_eq!(
                joint.len(),
                n,
                "{}: steps of trajectory {t}",
                recording.name
            );
            (
                rollout,
                (0..n).map(|i| [joint[i], state[i], action[i]]).collect(),
            )
        })
        .collect()
}

/// One column selection of the paper's rule on real states.
struct Case<'a> {
    recording: &'a Recording,
    name: &'a str,
    reference: &'a Trajectories,
    query: &'a Trajectories,
}

impl Case<'_> {
    fn score(&self, params: KSimParams) -> (KSim, Report) {
        let ksim = params.fit(self.reference.clone()).unwrap();
        let report = ksim.score(self.query).unwrap();
        (ksim, report)
    }

    fn check(&self, report: &Report, search: &str) {
        let expected = |what: &str| {
            self.recording
                .get(&format!("{}.{search}.{what}", self.name))
        };
        let what = |part: &str| format!("{} {}.{search} {part}", self.recording.name, self.name);
        let steps = || report.steps.iter();
        let rows = steps().map(|s| f64::from(s.reference_row));
        assert_all_close(rows, expected("neighbour"), &what("neighbor"));
        assert_all_close(
            steps().map(|s| s.distance),
            expected("distance"),
            &what("distance"),
        );
        assert_all_close(steps().map(|s| s.score), expected("score"), &what("score"));
        let mean = self.recording.metadata[&format!("{}.{search}", self.name)]
            .parse()
            .unwrap();
        assert_close(report.state_action.pooled, mean, &what("mean"));
    }
}

/// The paper's rule on a Minari dataset: exact by every engine that takes the width, and with the
/// recorded centers.
#[test]
fn golden_antmaze() {
    for path in recordings("data_fixtures") {
        let recording = Recording::read(&path);
        let dataset = golden()
            .join("data_fixtures/minari")
            .join(trained_on(&recording));
        let source = ksim_datasets::open(&dataset, &OpenOptions::default()).unwrap();
        for name in ["full31", "full29", "xy2"] {
            let width = recording.width(&format!("{name}.centroids"));
            let options = TransitionOptions {
                state_columns: Some((0..width).collect()),
                ..TransitionOptions::default()
            };
            let mut reference = Trajectories::new(width, recording.width("query.actions")).unwrap();
            for rows in TransitionReader::new(&*source, &options).unwrap() {
                let rows = rows.unwrap();
                let (states, actions) = (rows.states.chunks_exact(width), rows.action_width);
                let actions = rows.actions.chunks_exact(actions);
                for ((episode, state), action) in rows.episode_index.iter().zip(states).zip(actions)
                {
                    reference.push(*episode, state, action).unwrap();
                }
            }
            let mut query = Trajectories::new(width, recording.width("query.actions")).unwrap();
            let states = recording.columns("query.states", 0..width);
            query
                .push(0, &states, recording.get("query.actions"))
                .unwrap();
            check_case(&Case {
                recording: &recording,
                name,
                reference: &reference,
                query: &query,
            });
        }
    }
}

fn check_case(case: &Case<'_>) {
    let recorded = |what: &str| case.recording.get(&format!("{}.{what}", case.name));
    let width = case.reference.state_dim();
    for search in [
        Search::Auto,
        Search::Linear,
        Search::Blocked,
        Search::KdTree,
    ] {
        if search == Search::KdTree && width > ksim::KdTree::MAX_FEATURES {
            continue;
        }
        case.check(&case.score(KSim::params().search(search)).1, "exact");
    }
    let params = KSim::params()
        .search(Search::Clusters)
        .centers(recorded("centroids").to_vec());
    let (ksim, report) = case.score(params);
    case.check(&report, "clustered");
    let clusters = report.steps.iter().map(|s| s.cluster.unwrap().into());
    assert_all_close(clusters, recorded("clustered.cluster"), "cluster");
    let labels = ksim.index().kmeans().unwrap().labels();
    assert_all_close(
        labels.iter().map(|&l| l.into()),
        recorded("labels"),
        "labels",
    );
    let (states, actions) = ksim.normalizers();
    assert_all_close(
        states.mean().iter().copied(),
        recorded("state_mean"),
        "state mean",
    );
    assert_all_close(
        states.std().iter().copied(),
        recorded("state_std"),
        "state std",
    );
    let of_actions = |what: &str| case.recording.get(&format!("action_{what}"));
    assert_all_close(
        actions.mean().iter().copied(),
        of_actions("mean"),
        "action mean",
    );
    assert_all_close(
        actions.std().iter().copied(),
        of_actions("std"),
        "action std",
    );

    // Our own clusters are others, but as tight, and the score moves by what other seeds move it.
    let (own_ksim, own) = case.score(KSim::params().search(Search::Clusters));
    let inertia = |ksim: &KSim| ksim.index().kmeans().unwrap().inertia();
    assert!(
        inertia(&own_ksim) < 1.02 * inertia(&ksim),
        "{}: inertia",
        case.name
    );
    let mean: f64 = case.recording.metadata[&format!("{}.clustered", case.name)]
        .parse()
        .unwrap();
    assert!(
        (own.state_action.pooled - mean).abs() < 0.02,
        "{}: {own:?} {mean}",
        case.name
    );
}

/// The dataset named in the recording's header: `… D4RL/antmaze/large-play-v1 (…)`.
fn trained_on(recording: &Recording) -> String {
    let train = &recording.metadata["train"];
    let id = train
        .split_whitespace()
        .find(|word| word.contains("antmaze/"));
    id.unwrap_or_else(|| panic!("{}: train is {train:?}", recording.name))
        .to_owned()
}
