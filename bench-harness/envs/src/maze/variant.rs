//! The registered AntMaze environments: maps, reward types and versions.

use serde_json::{Map, Value};

use super::Maze;

/// What stands in an AntMaze id.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Variant {
    /// Name of the map.
    pub(crate) map: &'static str,
    /// Whether every step pays by its distance, not only those at the goal.
    pub(crate) is_dense: bool,
    /// 4 or 5.
    pub(crate) version: u32,
}

impl Variant {
    /// All of them: by version, map and reward type.
    pub(crate) fn all() -> impl Iterator<Item = Self> {
        [4, 5].into_iter().flat_map(|version| {
            Maze::names().flat_map(move |map| {
                [false, true].map(|is_dense| Self {
                    map,
                    is_dense,
                    version,
                })
            })
        })
    }

    #[cfg(feature = "mujoco")]
    pub(crate) fn of_id(id: &str) -> Option<Self> {
        Self::all().find(|variant| variant.id() == id)
    }

    pub(crate) fn id(&self) -> String {
        let dense = if self.is_dense { "Dense" } else { "" };
        format!("AntMaze_{}{dense}-v{}", self.map, self.version)
    }

    /// The published maze.
    pub(crate) fn maze(&self) -> Maze {
        Maze::published(self.map).expect("variants are made of published names")
    }

    /// Gymnasium's name of the reward.
    pub(crate) fn reward_type(&self) -> &'static str {
        if self.is_dense { "dense" } else { "sparse" }
    }

    /// Time limit in steps.
    pub(crate) fn max_episode_steps(&self) -> usize {
        if self.map == "UMaze" || self.map.starts_with("Open") {
            700
        } else {
            1000
        }
    }

    /// The keyword arguments with which gymnasium-robotics registers it.
    pub(crate) fn kwargs(&self) -> Map<String, Value> {
        let entries = [
            ("maze_map", self.maze().to_json()),
            ("reward_type", self.reward_type().into()),
        ];
        entries
            .map(|(name, value)| (name.to_owned(), value))
            .into_iter()
            .collect()
    }
}
