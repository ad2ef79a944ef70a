//! D4RL's dataset ids and the files they are stored in.

use crate::registry::{self, Known, Store};

/// File names under which the dataset may be stored, best first; empty for a name D4RL does not have.
pub(super) fn file_names(id: &str) -> Vec<String> {
    let Some(published) = known(id).and_then(Known::file_name) else {
        return Vec::new();
    };
    // A file saved under the id itself counts too.
    let mut names = vec![published.to_owned(), format!("{id}.hdf5")];
    names.dedup();
    names
}

/// The D4RL dataset of this id.
pub(super) fn known(id: &str) -> Option<&'static Known> {
    registry::find(id).filter(|known| known.store == Store::D4rl)
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
            ("minigrid-fourrooms-v0", "minigrid/minigrid4rooms.hdf5"),
            ("pen-human-v1", "hand_dapg_v1/pen-human-v1.hdf5"),
            ("door-cloned-v0", "hand_dapg/door-demos-v0-bc-combined.hdf5"),
        ];
        for (id, path) in cases {
            assert_eq!(known(id).map(|known| known.path), Some(path), "{id}");
        }
        for unknown in [
            "hopper-medium",
            "hopper-great-v2",
            "antmaze-huge-v2",
            "x-v1",
            "hopper-medium-v9",
            "hopper-full-replay-v0",
            "D4RL/pen/human-v2",
        ] {
            assert!(known(unknown).is_none(), "{unknown}");
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
