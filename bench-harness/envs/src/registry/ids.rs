//! The registered environments.

use serde_json::{Map, Value};

use super::suggest;
use crate::error::EnvironmentError;
use crate::maze::Variant;
use crate::toy;

/// Environments that share their rules up to arguments and version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Family {
    /// A point mass on a line, with a return known in closed form.
    PointMass,
    /// A two-legged runner in a plane.
    HalfCheetah,
    /// A one-legged hopper in a plane.
    Hopper,
    /// A two-legged walker in a plane.
    Walker2d,
    /// A four-legged walker.
    Ant,
    /// The ant in a maze.
    AntMaze,
}

/// Families of Gymnasium's own locomotion environments, by their name in ids.
const LOCOMOTION: [(&str, Family, &str); 4] = [
    (
        "HalfCheetah",
        Family::HalfCheetah,
        "run forward on two legs in a plane",
    ),
    (
        "Hopper",
        Family::Hopper,
        "hop forward on one leg without falling",
    ),
    (
        "Walker2d",
        Family::Walker2d,
        "walk forward on two legs without falling",
    ),
    ("Ant", Family::Ant, "walk forward on four legs"),
];

impl Family {
    /// Returns that count as 0 and 1 in D4RL's normalized scores of the robot. For version 4 and 5 of the environments
    /// they are a convention, not an equivalence: D4RL's own are older.
    pub fn reference_scores(self) -> Option<(f64, f64)> {
        let dataset = match self {
            Self::HalfCheetah => "halfcheetah-medium-v2",
            Self::Hopper => "hopper-medium-v2",
            Self::Walker2d => "walker2d-medium-v2",
            Self::Ant => "ant-medium-v2",
            // D4RL's 0 and 1 of its mazes are success rates of episodes that end at the goal.
            Self::AntMaze | Self::PointMass => return None,
        };
        let known = ksim_datasets::registry::find(dataset)?;
        known.ref_min_score.zip(known.ref_max_score)
    }
}

/// A registered environment.
#[derive(Debug, Clone, PartialEq)]
pub struct EnvironmentInfo {
    /// Its id.
    pub id: String,
    /// The environments it belongs to.
    pub family: Family,
    /// The number after `-v`.
    pub version: u32,
    /// What is asked, in a few words.
    pub description: String,
    /// The keyword arguments with which it is registered, where they differ from the constructor's.
    pub kwargs: Map<String, Value>,
    /// Time limit in steps.
    pub max_episode_steps: usize,
    /// Whether it needs feature `mujoco`.
    pub needs_mujoco: bool,
}

/// All environments: the point mass, locomotion by robot and version, mazes by version, map and reward.
pub fn all() -> impl Iterator<Item = EnvironmentInfo> {
    let robots = LOCOMOTION.into_iter();
    let locomotion = robots.flat_map(|robot| [4, 5].map(|version| locomotion(robot, version)));
    let mazes = Variant::all().map(|variant| ant_maze(&variant));
    std::iter::once(point_mass()).chain(locomotion).chain(mazes)
}

/// The environment of an id, or of a name that is close enough.
///
/// # Errors
/// A name that leads to none, with the ids it resembles; a version that was given up.
pub fn find(name: &str) -> Result<EnvironmentInfo, EnvironmentError> {
    let wanted = plain(name);
    let found = all().find(|info| {
        let id = plain(&info.id);
        id == wanted || (is_default(info) && stem(&id) == wanted)
    });
    found.ok_or_else(|| {
        retired(&wanted).unwrap_or_else(|| EnvironmentError::UnknownId {
            id: name.to_owned(),
            suggestions: suggest::closest(&wanted, all().map(|info| info.id), plain),
        })
    })
}

/// Says why version 3 of a maze is not offered, if that is what was asked for.
fn retired(wanted: &str) -> Option<EnvironmentError> {
    let stem = wanted.strip_suffix("_v3")?;
    let mut mazes = Variant::all().map(|variant| variant.id());
    let instead = mazes.find(|id| plain(id) == format!("{stem}_v4"))?;
    Some(EnvironmentError::Retired {
        id: instead.replace("-v4", "-v3"),
        reason: "its goal moves before the reward is computed, so that reaching it almost never pays",
        instead,
    })
}

/// Whether the environment is meant where no version is given.
fn is_default(info: &EnvironmentInfo) -> bool {
    match info.family {
        Family::PointMass => true,
        Family::AntMaze => info.version == 4,
        _ => info.version == 5,
    }
}

/// What does not matter in a name taken out of it.
fn plain(name: &str) -> String {
    name.trim().to_ascii_lowercase().replace('-', "_")
}

/// A plain id without its version.
fn stem(id: &str) -> &str {
    id.rsplit_once("_v").map_or(id, |(stem, _)| stem)
}

fn point_mass() -> EnvironmentInfo {
    EnvironmentInfo {
        id: toy::POINT_MASS_ID.to_owned(),
        family: Family::PointMass,
        version: 0,
        description: "push a mass past a point; the return is known in closed form".to_owned(),
        kwargs: Map::new(),
        max_episode_steps: toy::MAX_EPISODE_STEPS,
        needs_mujoco: false,
    }
}

fn locomotion((name, family, task): (&str, Family, &str), version: u32) -> EnvironmentInfo {
    EnvironmentInfo {
        id: format!("{name}-v{version}"),
        family,
        version,
        description: format!("{task}, by the rules of Gymnasium's version {version}"),
        kwargs: Map::new(),
        max_episode_steps: 1000,
        needs_mujoco: true,
    }
}

fn ant_maze(variant: &Variant) -> EnvironmentInfo {
    let pays = if variant.is_dense {
        "every step pays exp(-distance)"
    } else {
        "steps at the goal pay 1"
    };
    let map = variant.map;
    EnvironmentInfo {
        id: variant.id(),
        family: Family::AntMaze,
        version: variant.version,
        description: format!("walk on four legs to a goal in maze {map}; {pays}"),
        kwargs: variant.kwargs(),
        max_episode_steps: variant.max_episode_steps(),
        needs_mujoco: true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id_of(name: &str) -> String {
        find(name).map(|info| info.id).expect(name)
    }

    #[test]
    fn every_id_leads_to_itself() {
        let ids: Vec<String> = all().map(|info| info.id).collect();
        assert_eq!(ids.len(), 1 + 8 + 40);
        for id in &ids {
            assert_eq!(&id_of(id), id);
        }
    }

    #[test]
    fn time_limits_are_the_registered_ones() {
        for (id, limit) in [
            ("Hopper-v4", 1000),
            ("AntMaze_UMazeDense-v5", 700),
            ("AntMaze_Open_Diverse_GR-v4", 700),
            ("AntMaze_Medium-v4", 1000),
            ("AntMaze_Large_Diverse_GDense-v5", 1000),
        ] {
            assert_eq!(
                find(id).map(|info| info.max_episode_steps),
                Ok(limit),
                "{id}"
            );
        }
    }

    #[test]
    fn names_lead_to_ids() {
        for (name, id) in [
            ("halfcheetah", "HalfCheetah-v5"),
            ("hopper-v4", "Hopper-v4"),
            ("WALKER2D", "Walker2d-v5"),
            ("antmaze-large", "AntMaze_Large-v4"),
            ("antmaze_large_diverse_gr-v5", "AntMaze_Large_Diverse_GR-v5"),
            ("antmaze-umazedense", "AntMaze_UMazeDense-v4"),
            ("pointmass", "PointMass-v0"),
        ] {
            assert_eq!(id_of(name), id);
        }
    }

    #[test]
    fn other_names_say_what_may_have_been_meant() {
        let message = |name: &str| find(name).expect_err(name).to_string();
        assert_eq!(
            message("Hoper-v4"),
            "unknown environment `Hoper-v4`; did you mean Hopper-v4, Hopper-v5?"
        );
        assert!(message("Walker2d-v2").contains("Walker2d-v4, Walker2d-v5"));
        assert!(
            message("AntMaze_Big-v4").contains("AntMaze_"),
            "{}",
            message("AntMaze_Big-v4")
        );
        assert!(message("Humanoid-v5").contains("ksim env list"));
        assert!(message("").contains("ksim env list"));
        assert_eq!(
            message("AntMaze_UMazeDense-v3"),
            "environment `AntMaze_UMazeDense-v3` is not offered: its goal moves before the reward is computed, so that \
             reaching it almost never pays; use `AntMaze_UMazeDense-v4`"
        );
    }

    #[test]
    fn robots_have_d4rls_reference_scores() {
        assert_eq!(
            Family::Hopper.reference_scores(),
            Some((-20.272305, 3234.3))
        );
        assert_eq!(Family::Ant.reference_scores(), Some((-325.6, 3879.7)));
        assert_eq!(Family::AntMaze.reference_scores(), None);
        let robots = LOCOMOTION.map(|(_, family, _)| family);
        assert!(
            robots
                .iter()
                .all(|robot| robot.reference_scores().is_some())
        );
    }
}
