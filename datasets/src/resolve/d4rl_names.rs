//! D4RL's dataset ids and the files they are stored in.

/// Where D4RL's files are published.
const BASE: &str = "http://rail.eecs.berkeley.edu/datasets/offline_rl/";

const LOCOMOTION: [&str; 4] = ["halfcheetah", "hopper", "walker2d", "ant"];
const LOCOMOTION_SETS: [&str; 6] = [
    "random",
    "medium",
    "expert",
    "medium-replay",
    "full-replay",
    "medium-expert",
];
const ADROIT: [&str; 4] = ["pen", "hammer", "door", "relocate"];

/// File names under which the dataset may be stored, best first; empty for a name D4RL does not have.
pub(super) fn file_names(id: &str) -> Vec<String> {
    let mut names: Vec<String> = paths(id)
        .iter()
        .map(|path| path.rsplit('/').next().unwrap_or(path).to_owned())
        .collect();
    // A file saved under the id itself.
    if !names.is_empty() {
        let own = format!("{id}.hdf5");
        if !names.contains(&own) {
            names.push(own);
        }
    }
    names
}

/// Where the dataset is published.
pub(super) fn urls(id: &str) -> Vec<String> {
    paths(id)
        .iter()
        .map(|path| format!("{BASE}{path}"))
        .collect()
}

fn paths(id: &str) -> Vec<String> {
    let Some((stem, version)) = id.rsplit_once("-v") else {
        return Vec::new();
    };
    let Some((family, set)) = stem.split_once('-') else {
        return Vec::new();
    };
    let path = match family {
        _ if LOCOMOTION.contains(&family) => locomotion(family, set, version),
        "antmaze" => antmaze(set, version),
        "maze2d" => maze2d(set, version),
        "kitchen" if version == "0" => kitchen(set),
        _ if ADROIT.contains(&family) => adroit(family, set, version),
        "minigrid" if version == "0" => Some(format!(
            "minigrid/{}.hdf5",
            stem.replace("fourrooms-random", "fourrooms_random")
                .replace('-', "")
        ))
        .filter(|_| set.starts_with("fourrooms")),
        _ => None,
    };
    path.into_iter().collect()
}

fn locomotion(env: &str, set: &str, version: &str) -> Option<String> {
    let known = LOCOMOTION_SETS.contains(&set);
    match version {
        "1" | "2" if known => Some(format!(
            "gym_mujoco_v{version}/{env}_{}-v{version}.hdf5",
            set.replace('-', "_")
        )),
        "0" if set == "medium-replay" => {
            // The one file whose environment is called otherwise.
            let env = if env == "walker2d" { "walker" } else { env };
            Some(format!("gym_mujoco/{env}_mixed.hdf5"))
        }
        "0" if known || (env == "ant" && set == "random-expert") => {
            Some(format!("gym_mujoco/{env}_{}.hdf5", set.replace('-', "_")))
        }
        _ => None,
    }
}

fn antmaze(set: &str, version: &str) -> Option<String> {
    let (maze, start, goal) = match set {
        "umaze" => (0, "False", "False"),
        "umaze-diverse" => (0, "True", "True"),
        "medium-play" => (1, "True", "False"),
        "medium-diverse" => (1, "True", "True"),
        "large-play" => (2, "True", "False"),
        "large-diverse" => (2, "True", "True"),
        _ => return None,
    };
    let (folder, mazes, suffix) = match version {
        "0" => (
            "ant_maze_new",
            ["u-maze", "big-maze", "hardest-maze"],
            "sparse",
        ),
        "1" => ("ant_maze_v1", ["umaze", "medium", "large"], "sparse"),
        "2" => (
            "ant_maze_v2",
            ["u-maze", "big-maze", "hardest-maze"],
            "sparse_fixed",
        ),
        _ => return None,
    };
    let maze = mazes[maze];
    Some(format!(
        "{folder}/Ant_maze_{maze}_noisy_multistart_{start}_multigoal_{goal}_{suffix}.hdf5"
    ))
}

fn maze2d(set: &str, version: &str) -> Option<String> {
    let (eval, set) = match set.strip_prefix("eval-") {
        Some(set) => ("eval-", set),
        None => ("", set),
    };
    let (maze, reward) = match set.strip_suffix("-dense") {
        Some(maze) => (maze, "dense"),
        None => (set, "sparse"),
    };
    match (maze, version) {
        ("umaze" | "medium" | "large", "1") => {
            Some(format!("maze2d/maze2d-{eval}{maze}-{reward}-v1.hdf5"))
        }
        ("open", "0") => Some(format!("maze2d/maze2d-{eval}open-{reward}.hdf5")),
        _ => None,
    }
}

fn kitchen(set: &str) -> Option<String> {
    let tasks = match set {
        "complete" => "mini_kitchen_microwave_kettle_light_slider",
        "partial" => "kitchen_microwave_kettle_light_slider",
        "mixed" => "kitchen_microwave_kettle_bottomburner_light",
        _ => return None,
    };
    Some(format!("kitchen/{tasks}-v0.hdf5"))
}

fn adroit(task: &str, set: &str, version: &str) -> Option<String> {
    match (set, version) {
        ("human" | "cloned" | "expert", "1") => Some(format!("hand_dapg_v1/{task}-{set}-v1.hdf5")),
        ("human", "0") => Some(format!("hand_dapg/{task}-v0_demos_clipped.hdf5")),
        ("cloned", "0") => Some(format!("hand_dapg/{task}-demos-v0-bc-combined.hdf5")),
        ("expert", "0") => Some(format!("hand_dapg/{task}-v0_expert_clipped.hdf5")),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_family_has_its_file_names() {
        let cases = [
            (
                "hopper-medium-expert-v2",
                "gym_mujoco_v2/hopper_medium_expert-v2.hdf5",
            ),
            (
                "halfcheetah-full-replay-v1",
                "gym_mujoco_v1/halfcheetah_full_replay-v1.hdf5",
            ),
            ("hopper-medium-replay-v0", "gym_mujoco/hopper_mixed.hdf5"),
            ("walker2d-medium-replay-v0", "gym_mujoco/walker_mixed.hdf5"),
            ("walker2d-medium-v0", "gym_mujoco/walker2d_medium.hdf5"),
            ("ant-random-expert-v0", "gym_mujoco/ant_random_expert.hdf5"),
            (
                "antmaze-umaze-v2",
                "ant_maze_v2/Ant_maze_u-maze_noisy_multistart_False_multigoal_False_sparse_fixed.hdf5",
            ),
            (
                "antmaze-large-play-v0",
                "ant_maze_new/Ant_maze_hardest-maze_noisy_multistart_True_multigoal_False_sparse.hdf5",
            ),
            (
                "antmaze-medium-diverse-v1",
                "ant_maze_v1/Ant_maze_medium_noisy_multistart_True_multigoal_True_sparse.hdf5",
            ),
            ("maze2d-umaze-v1", "maze2d/maze2d-umaze-sparse-v1.hdf5"),
            ("maze2d-large-dense-v1", "maze2d/maze2d-large-dense-v1.hdf5"),
            ("maze2d-open-v0", "maze2d/maze2d-open-sparse.hdf5"),
            (
                "kitchen-complete-v0",
                "kitchen/mini_kitchen_microwave_kettle_light_slider-v0.hdf5",
            ),
            ("pen-human-v1", "hand_dapg_v1/pen-human-v1.hdf5"),
            ("door-cloned-v0", "hand_dapg/door-demos-v0-bc-combined.hdf5"),
        ];
        for (id, path) in cases {
            assert_eq!(paths(id), [path], "{id}");
        }
        for unknown in [
            "hopper-medium",
            "hopper-great-v2",
            "antmaze-huge-v2",
            "x-v1",
            "hopper-medium-v9",
        ] {
            assert!(paths(unknown).is_empty(), "{unknown}");
        }
    }

    #[test]
    fn a_file_saved_under_the_id_is_found_too() {
        assert_eq!(
            file_names("hopper-medium-v2"),
            ["hopper_medium-v2.hdf5", "hopper-medium-v2.hdf5"]
        );
    }
}
