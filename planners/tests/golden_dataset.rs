//! Windows, values and statistics of mode reference against those of the reference's datasets.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod support;

use std::collections::BTreeMap;

use ksim_planners::config::{DataConfig, Mode, RewardRule};
use ksim_planners::data::{EpisodeSpan, Episodes, Subset, Windows};
use support::tolerance::assert_close;
use support::{File, folders};

const HORIZON: usize = 8;
const MAX_PATH_LENGTH: usize = 20;

fn config(rule: RewardRule) -> DataConfig {
    let goal = rule == RewardRule::Goal;
    DataConfig {
        horizon: HORIZON,
        max_path_length: MAX_PATH_LENGTH,
        discount: if goal { 0.99 } else { 0.997 },
        rule,
        terminal_penalty: -100.0,
        goal_bonus: 100.0,
        reward_offset: -0.5,
    }
}

fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&value| f64::from(value)).collect()
}

/// Rows of a D4RL file, cut where a flag says so; the rest has no end.
fn locomotion(file: &File) -> Episodes {
    let terminals = file.values("in.terminals");
    let timeouts = file.values("in.timeouts");
    let mut spans = Vec::new();
    let mut start = 0;
    for row in 0..terminals.len() {
        let (terminated, truncated) = (terminals[row] != 0.0, timeouts[row] != 0.0);
        if terminated || truncated || row + 1 == terminals.len() {
            spans.push(EpisodeSpan {
                start,
                length: row + 1 - start,
                terminated,
                truncated,
            });
            start = row + 1;
        }
    }
    let dim = |name: &str| file.tensor(name).shape[1];
    Episodes {
        observation_dim: dim("in.observations"),
        action_dim: dim("in.actions"),
        observations: widen(file.values("in.observations")),
        actions: widen(file.values("in.actions")),
        rewards: widen(file.values("in.rewards")),
        spans,
        observation_order: Vec::new(),
        has_goal: false,
    }
}

/// Episodes of Minari's AntMaze: one more observation than actions, which is dropped.
fn maze(file: &File) -> Episodes {
    let parts =
        ["in.achieved_goal", "in.observation", "in.desired_goal"].map(|name| file.tensor(name));
    let action = file.tensor("in.actions");
    let (n_episodes, length) = (action.shape[0], action.shape[1]);
    let mut observations = Vec::new();
    for episode in 0..n_episodes {
        for step in 0..length {
            for part in parts {
                let first = (episode * part.shape[1] + step) * part.shape[2];
                observations.extend(widen(&part.values[first..first + part.shape[2]]));
            }
        }
    }
    let span = |episode| EpisodeSpan {
        start: episode * length,
        length,
        terminated: false,
        truncated: true,
    };
    Episodes {
        observation_dim: parts.iter().map(|part| part.shape[2]).sum(),
        action_dim: action.shape[2],
        observations,
        actions: widen(&action.values),
        rewards: widen(file.values("in.rewards")),
        spans: (0..n_episodes).map(span).collect(),
        observation_order: Vec::new(),
        has_goal: true,
    }
}

fn check(file: &File, windows: &Windows, subset: Subset) {
    let n = windows.n_windows(subset);
    let width = windows.width();
    assert_eq!(
        n as u64,
        file.entry["n_windows"].as_u64().unwrap(),
        "{}",
        file.name
    );
    assert_close(&windows.normalizer.mean, file.values("mean"), 1e-6, "mean");
    assert_close(&windows.normalizer.std, file.values("std"), 1e-6, "std");
    let (mut observations, mut actions, mut rewards, mut values) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut window = vec![f32::NAN; HORIZON * width];
    let mut window_rewards = vec![f32::NAN; HORIZON];
    for index in 0..n {
        let (path, start) = windows.place(subset, index);
        let indices = &file.values("indices")[3 * index..3 * index + 3];
        let place = [path as f32, start as f32, (start + HORIZON) as f32];
        assert_eq!(indices, place, "{} window {index}", file.name);
        windows.fill(subset, index, &mut window);
        for row in window.chunks_exact(width) {
            observations.extend_from_slice(&row[..windows.observation_dim()]);
            actions.extend_from_slice(&row[windows.observation_dim()..]);
        }
        windows.fill_rewards(subset, index, &mut window_rewards);
        rewards.extend_from_slice(&window_rewards);
        values.push(windows.value(subset, index));
    }
    assert_close(&observations, file.values("obs"), 1e-6, "observations");
    assert_eq!(actions, file.values("act"));
    assert_close(&rewards, file.values("rew"), 1e-6, "rewards");
    assert_close(&values, file.values("val"), 1e-6, "values");
}

#[test]
fn golden_windows() {
    let mut n_files = 0;
    for folder in folders() {
        for file in folder.files("dataset_") {
            n_files += 1;
            let subset = if file.name.contains("succ") {
                Subset::Successful
            } else {
                Subset::All
            };
            let (rule, episodes) = if file.name.contains("antmaze") {
                (RewardRule::Goal, maze(&file))
            } else {
                (RewardRule::Locomotion, locomotion(&file))
            };
            let windows = Windows::new(&episodes, &config(rule), Mode::Reference).unwrap();
            check(&file, &windows, subset);
        }
    }
    assert!(n_files >= 4, "{n_files} files");
}

/// Corrected windows lie inside their episode; where they exist they equal the reference's.
#[test]
fn corrected_windows_stay_inside_their_episode() {
    for folder in folders() {
        for file in folder.files("dataset_mujoco.") {
            let episodes = locomotion(&file);
            let config = config(RewardRule::Locomotion);
            let [reference, corrected] = [Mode::Reference, Mode::Corrected]
                .map(|mode| Windows::new(&episodes, &config, mode).unwrap());
            let ended: Vec<EpisodeSpan> = episodes
                .spans
                .iter()
                .copied()
                .filter(|span| span.terminated || span.truncated)
                .collect();
            let n_expected: usize = ended
                .iter()
                .map(|span| (span.length + 1).saturating_sub(HORIZON))
                .sum();
            assert_eq!(corrected.n_windows(Subset::All), n_expected);
            assert_eq!(corrected.n_short(), 1, "the episode of 7 steps");
            let mut places = BTreeMap::new();
            for index in 0..reference.n_windows(Subset::All) {
                places.insert(reference.place(Subset::All, index), index);
            }
            let mut windows = [vec![0.0; HORIZON * 6], vec![0.0; HORIZON * 6]];
            for index in 0..n_expected {
                let (path, start) = corrected.place(Subset::All, index);
                assert!(start + HORIZON <= ended[path].length);
                let other = places[&(path, start)];
                corrected.fill(Subset::All, index, &mut windows[0]);
                reference.fill(Subset::All, other, &mut windows[1]);
                assert_eq!(windows[0], windows[1]);
                assert_eq!(
                    corrected.value(Subset::All, index),
                    reference.value(Subset::All, other)
                );
            }
        }
    }
}
