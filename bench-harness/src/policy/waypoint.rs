//! A driver for mazes: ants that can only run straight, steered by what they are shown.

mod view;

use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::num::NonZeroUsize;
use std::path::Path;

use ksim_envs::EnvironmentSpec;
use ksim_envs::maze::{Cell, Maze, distance};
use ksim_envs::registry;
use rayon::prelude::*;

use self::view::{ACTION_DIM, ANT_DIM, View, up, yaw};
use super::mlp::{Network, Pass, read, width};
use super::noise::ActionNoise;
use super::{EpisodeStart, Policy, PolicyError};
use crate::rng::{Purpose, Rng};

/// Positions and velocities of an ant, of which its observation leaves out the place.
const ANT_STATE: [usize; 2] = [15, 14];
/// Numbers of a place.
const N_PLACE: usize = 2;
/// A waypoint is reached within this distance, in meters.
const WAYPOINT_RADIUS_M: f64 = 1.5;
/// The near network drives within this distance of the goal, in meters.
const NEAR_M: f64 = 2.5;
/// An ant whose back points less upward than this (the cosine of its tilt) has fallen.
const FALLEN: f64 = 0.3;
/// Steps for which a fallen ant holds an action.
const FLAIL_STEPS: u32 = 3;

/// Drives an ant from cell to cell along a shortest path, with networks that run towards +x.
///
/// The ant is shown a world turned so that +x leads to the waypoint. It has four equal legs, so it is further told,
/// by calling its legs by each other's names, that it already faces within 45° of where it should go. A second network,
/// slower and steadier, takes over near the goal. An ant on its back waves its legs at random, which now and then
/// turns it over. Clips to the action space.
#[derive(Debug)]
pub struct Waypoint {
    name: String,
    maze: Maze,
    /// Between waypoints, and near the goal.
    networks: [Network; 2],
    observation_dim: usize,
    noise: ActionNoise,
    drivers: Vec<Driver>,
}

impl Waypoint {
    /// Reads the networks that run between waypoints and near the goal, to act in `environment`.
    ///
    /// # Errors
    /// A file that is no network, or not of an ant; an environment that is no maze, or whose robot is no ant.
    pub fn open(
        name: String,
        files: [&Path; 2],
        noise: f64,
        environment: &EnvironmentSpec,
    ) -> Result<Self, PolicyError> {
        let maze = registry::maze_of(environment).ok_or_else(|| PolicyError::NoMaze {
            policy: name.clone(),
            environment: environment.id.clone(),
        })?;
        check_robot(&name, environment)?;
        let [far, near] = files.map(read);
        let networks = [far?, near?];
        for network in &networks {
            let (seen, moved) = (network.observation_dim(), network.action_dim());
            // Wider ones are shown zeros for the contact forces, as their simulator did.
            if seen < ANT_DIM {
                return Err(width(&name, "observations", seen, environment, ANT_DIM));
            }
            if moved != ACTION_DIM {
                return Err(width(&name, "actions", moved, environment, ACTION_DIM));
            }
        }
        Ok(Self {
            name,
            maze,
            networks,
            observation_dim: environment.observation_dim(),
            noise: ActionNoise::new(noise, environment),
            drivers: Vec::new(),
        })
    }
}

/// Refuses another robot than the ant, which a maze may have by its `xml_file`.
fn check_robot(name: &str, environment: &EnvironmentSpec) -> Result<(), PolicyError> {
    let n_actions = environment.action_dim();
    if n_actions != ACTION_DIM {
        return Err(width(name, "actions", ACTION_DIM, environment, n_actions));
    }
    let state = ["qpos", "qvel"].map(|name| {
        let mut parts = environment.info.iter();
        let part = parts.find(|part| part.name == name);
        part.map_or(0, |part| part.width)
    });
    if state == ANT_STATE {
        return Ok(());
    }
    let n_seen = state.iter().sum::<usize>().saturating_sub(N_PLACE);
    Err(width(name, "observations", ANT_DIM, environment, n_seen))
}

impl Policy for Waypoint {
    fn name(&self) -> &str {
        &self.name
    }

    fn start_episode(
        &mut self,
        slot: usize,
        start: &EpisodeStart,
    ) -> Result<Option<NonZeroUsize>, PolicyError> {
        if self.drivers.len() <= slot {
            self.drivers.resize_with(slot + 1, || Driver::new(0));
        }
        self.drivers[slot] = Driver::new(start.seed);
        self.noise.start(slot, start.seed);
        Ok(None)
    }

    fn act(
        &mut self,
        slots: &[usize],
        observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), Vec<(usize, PolicyError)>> {
        for (row, &slot) in slots.iter().enumerate() {
            self.drivers[slot].row = Some(row);
        }
        let (maze, networks, width) = (&self.maze, &self.networks, self.observation_dim);
        self.drivers.par_iter_mut().for_each(|driver| {
            if let Some(row) = driver.row.take() {
                driver.drive(&observations[row * width..][..width], maze, networks);
            }
        });
        for (&slot, action) in slots.iter().zip(actions.chunks_exact_mut(ACTION_DIM)) {
            action.copy_from_slice(&self.drivers[slot].action);
            self.noise.apply(slot, action);
        }
        Ok(())
    }
}

/// What is remembered of one slot.
#[derive(Debug)]
struct Driver {
    /// Row of the current observations, if it is to drive.
    row: Option<usize>,
    /// Cells to the goal, and which of them comes next.
    path: Vec<Cell>,
    next: usize,
    /// Steps since the ant fell; 0 while it stands.
    n_fallen: u32,
    recovery: Rng,
    pass: Pass,
    action: [f64; ACTION_DIM],
}

impl Driver {
    fn new(seed: u64) -> Self {
        Self {
            row: None,
            path: Vec::new(),
            next: 0,
            n_fallen: 0,
            recovery: Rng::new(seed, Purpose::Recovery),
            pass: Pass::default(),
            action: [0.0; ACTION_DIM],
        }
    }

    /// Finds the action for an observation of AntMaze: place, ant, goal.
    fn drive(&mut self, observation: &[f64], maze: &Maze, networks: &[Network; 2]) {
        let place = [observation[0], observation[1]];
        let goal = [
            observation[observation.len() - 2],
            observation[observation.len() - 1],
        ];
        let ant = &observation[2..2 + ANT_DIM];
        if up(ant) < FALLEN {
            return self.flail();
        }
        self.n_fallen = 0;
        let target = self.target(maze, place, goal);
        let heading = (target[1] - place[1]).atan2(target[0] - place[0]);
        let quarters = (wrap(heading - yaw(ant)) / FRAC_PI_2).round();
        let view = View {
            heading,
            quarters: quarters.rem_euclid(4.0) as usize,
        };
        let network = &networks[usize::from(distance(place, goal) < NEAR_M)];
        network.forward(&view.observation(ant), &mut self.pass);
        let mut seen = [0.0; ACTION_DIM];
        network.mean_action(&self.pass, &mut seen);
        self.action = view.action(&seen.map(|value| value.clamp(-1.0, 1.0)));
    }

    fn flail(&mut self) {
        if self.n_fallen.is_multiple_of(FLAIL_STEPS) {
            let rng = &mut self.recovery;
            self.action = [(); ACTION_DIM].map(|()| if rng.below(2) == 0 { -1.0 } else { 1.0 });
        }
        self.n_fallen += 1;
    }

    /// Where to run to: the center of the next cell on the path, or the goal if no cell is left.
    fn target(&mut self, maze: &Maze, place: [f64; 2], goal: [f64; 2]) -> [f64; 2] {
        let (Some(here), Some(there)) = (maze.cell_at(place), maze.cell_at(goal)) else {
            return goal;
        };
        if !self.path.contains(&here) || self.path.last() != Some(&there) {
            self.path = maze.shortest_path(here, there).unwrap_or_default();
            self.next = 1;
        }
        // The last cell is the goal's: it is not its center that counts.
        let between = self.path.len().saturating_sub(1);
        while self.next < between
            && distance(place, maze.center(self.path[self.next])) < WAYPOINT_RADIUS_M
        {
            self.next += 1;
        }
        match self.path.get(self.next) {
            Some(&cell) if self.next < between => maze.center(cell),
            _ => goal,
        }
    }
}

/// An angle brought into [-π, π).
fn wrap(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

#[cfg(test)]
mod tests {
    use ksim_envs::Part;

    use super::*;

    const OBSERVATION_DIM: usize = 2 + ANT_DIM + 2;

    fn driver() -> (Driver, Maze) {
        (
            Driver::new(0),
            Maze::published("UMaze").expect("a published map"),
        )
    }

    #[test]
    fn waypoints_lead_around_the_wall_to_the_goal() {
        let (mut driver, maze) = driver();
        let goal = [-4.3, -4.4];
        let mut place = maze.center((1, 1));
        let mut visited = Vec::new();
        for _ in 0..200 {
            let target = driver.target(&maze, place, goal);
            let step = distance(place, target).max(1e-12);
            place = [0, 1].map(|k| place[k] + 0.3 * (target[k] - place[k]) / step.max(0.3));
            let cell = maze.cell_at(place).expect("inside");
            if visited.last() != Some(&cell) {
                visited.push(cell);
            }
        }
        assert_eq!(
            visited,
            [(1, 1), (1, 2), (1, 3), (2, 3), (3, 3), (3, 2), (3, 1)]
        );
        assert!(distance(place, goal) < 0.01);
    }

    #[test]
    fn another_robot_than_the_ant_is_refused() {
        let part = |name, width| Part { name, width };
        let spec = |n_positions, n_actions| EnvironmentSpec {
            id: "AntMaze_UMaze-v5".to_owned(),
            observation: vec![
                part("achieved_goal", 2),
                part("observation", n_positions + 14 - 2),
                part("desired_goal", 2),
            ],
            action_low: vec![-1.0; n_actions],
            action_high: vec![1.0; n_actions],
            info: vec![part("qpos", n_positions), part("qvel", 14), part("goal", 2)],
            max_episode_steps: 700,
            dt_s: 0.05,
            reports_success: true,
            kwargs: serde_json::Map::new(),
        };
        let open = |spec: &EnvironmentSpec| {
            let missing = Path::new("no such network");
            let opened = Waypoint::open("waypoint:w".to_owned(), [missing; 2], 0.0, spec);
            opened.expect_err("there is no network").to_string()
        };
        assert_eq!(
            open(&spec(15, 4)),
            "policy `waypoint:w` has 8 actions, environment `AntMaze_UMaze-v5` has 4"
        );
        assert_eq!(
            open(&spec(11, 8)),
            "policy `waypoint:w` has 27 observations, environment `AntMaze_UMaze-v5` has 23"
        );
        assert_eq!(open(&spec(15, 8)), "read no such network");
    }

    #[test]
    fn a_new_goal_and_a_push_off_the_path_give_a_new_path() {
        let (mut driver, maze) = driver();
        let start = maze.center((1, 1));
        driver.target(&maze, start, maze.center((3, 1)));
        assert_eq!(driver.path.len(), 7);
        driver.target(&maze, start, maze.center((1, 3)));
        assert_eq!(driver.path.len(), 3);
        driver.target(&maze, maze.center((3, 3)), maze.center((1, 3)));
        assert_eq!(driver.path, [(3, 3), (2, 3), (1, 3)]);
        // The goal alone is left where there is no way.
        assert_eq!(driver.target(&maze, [99.0, 0.0], [1.0, 2.0]), [1.0, 2.0]);
    }

    #[test]
    fn a_fallen_ant_holds_its_actions_and_follows_its_seed() {
        let mut observation = [0.0; OBSERVATION_DIM];
        observation[2..7].copy_from_slice(&[0.3, 0.0, 1.0, 0.0, 0.0]);
        let actions = |seed| {
            let mut driver = Driver::new(seed);
            [(); 6].map(|()| {
                driver.flail();
                driver.action
            })
        };
        assert!(up(&observation[2..]) < FALLEN);
        let flailed = actions(1);
        assert_eq!(flailed[0], flailed[2]);
        assert_ne!(flailed[2], flailed[3]);
        assert_eq!(flailed, actions(1));
        assert_ne!(flailed, actions(2));
        assert!(
            flailed
                .as_flattened()
                .iter()
                .all(|value| value.abs() == 1.0)
        );
    }
}
