//! AntMaze: to walk to a goal on four legs.
//!
//! The rules are those of gymnasium-robotics' `AntMaze_*-v4` and `-v5`, which move the same robot. Where the ant is, is
//! its fresh `qpos`. The ant's own reward, health and end play no part: one that lies on its back plays on.

use serde_json::{Map, Value};

use super::Version;
use super::ant::{Ant, AntParams};
use crate::environment::{EnvironmentSpec, Part, ResetOptions, RewardTerms};
use crate::error::EnvironmentError;
use crate::maze::{GOAL_RADIUS_M, Maze, Variant, distance};
use crate::mujoco::arguments::Arguments;
use crate::mujoco::models;
use crate::mujoco::{MujocoEnvironment, MujocoModel, MujocoPhysics};
use crate::numpy_rng::Generator;
use crate::simulation::{Judgement, SimEnvironment, Task};

/// Numbers of a place.
const N_PLACE: usize = 2;

/// Arguments of the ant's constructor that the maze gives it.
const OF_THE_MAZE: [&str; 2] = [
    "exclude_current_positions_from_observation",
    "reset_noise_scale",
];

/// Makes a variant, with the keyword arguments of gymnasium-robotics' constructors and those that they
/// hand on to the ant's. The time limit is the id's if no other is given.
///
/// # Errors
/// An argument that the version does not take or cannot use, a map that is no maze, or a model file that
/// does not compile.
pub(super) fn make(
    variant: &Variant,
    kwargs: &Map<String, Value>,
    max_episode_steps: Option<usize>,
) -> Result<Box<dyn MujocoEnvironment>, EnvironmentError> {
    let id = &variant.id();
    let version = if variant.version == 4 {
        Version::V4
    } else {
        Version::V5
    };
    let mut arguments = Arguments::new(id, kwargs);
    let rules = Rules::read(id, variant, kwargs, &mut arguments)?;
    let model = model(id, version, &rules.maze, &mut arguments)?;
    let frame_skip = super::frame_skip(version, &mut arguments, 5)?;
    let params = AntParams::read(version, &mut arguments)?;
    let physics = MujocoPhysics::new(&model, frame_skip, params.observes_contact_forces())?;
    let ant = Ant::new(id, params, &model, &physics)?;
    let (action_low, action_high) = super::action_ranges(id, &physics)?;
    let part = |name, width| Part { name, width };
    let spec = EnvironmentSpec {
        id: id.clone(),
        observation: vec![
            part("achieved_goal", N_PLACE),
            part("observation", ant.observation_dim(&physics)),
            part("desired_goal", N_PLACE),
        ],
        action_low,
        action_high,
        info: vec![
            part("qpos", physics.qpos().len()),
            part("qvel", physics.qvel().len()),
            part("goal", N_PLACE),
        ],
        max_episode_steps: max_episode_steps.unwrap_or(variant.max_episode_steps()),
        dt_s: physics.dt_s(),
        reports_success: true,
        kwargs: arguments.finish()?,
    };
    let task = AntMaze {
        ant,
        rules,
        goal: [0.0; N_PLACE],
    };
    Ok(Box::new(SimEnvironment::new(spec, physics, task)))
}

/// Our own ant, or that of `xml_file`, in the maze. Version 4 has no such argument.
fn model(
    id: &str,
    version: Version,
    maze: &Maze,
    arguments: &mut Arguments<'_>,
) -> Result<MujocoModel, EnvironmentError> {
    let file = match version {
        Version::V4 => None,
        Version::V5 => arguments.take("xml_file", None, "the path of a file", |path| {
            path.as_str().map(|path| Some(path.to_owned()))
        })?,
    };
    let world = models::maze::world(maze);
    let Some(path) = file else {
        return MujocoModel::from_xml(id, &models::ant::xml(&world));
    };
    let refuse = |message: String| EnvironmentError::Model {
        model: path.clone(),
        message,
    };
    let xml = std::fs::read_to_string(&path).map_err(|error| refuse(error.to_string()))?;
    let end = xml.find("</worldbody>");
    let end =
        end.ok_or_else(|| refuse("expected a `worldbody` to put the maze into".to_owned()))?;
    let (head, tail) = xml.split_at(end);
    MujocoModel::from_xml(&path, &[head, &world, tail].concat())
}

/// What the maze's constructor takes.
#[derive(Debug)]
struct Rules {
    maze: Maze,
    is_dense: bool,
    /// Whether the episode goes on at the goal.
    is_continuing: bool,
    /// Whether the goal moves when it was reached.
    moves_goal: bool,
}

impl Rules {
    fn read(
        id: &str,
        variant: &Variant,
        kwargs: &Map<String, Value>,
        arguments: &mut Arguments<'_>,
    ) -> Result<Self, EnvironmentError> {
        let id = || id.to_owned();
        if let Some((name, value)) = kwargs
            .iter()
            .find(|(name, _)| OF_THE_MAZE.contains(&name.as_str()))
        {
            return Err(EnvironmentError::Argument {
                id: id(),
                name: name.clone(),
                expected: "none, since the maze sets it".to_owned(),
                found: value.to_string(),
            });
        }
        // The map's own error says more than that it is unusable.
        if let Some(map) = kwargs.get("maze_map") {
            Maze::from_json(map).map_err(|source| EnvironmentError::Maze { id: id(), source })?;
        }
        let maze = arguments.take("maze_map", variant.maze(), "a maze", |map| {
            Maze::from_json(map).ok()
        })?;
        let types = "\"sparse\" or \"dense\"";
        let is_dense = arguments.take(
            "reward_type",
            variant.is_dense,
            types,
            |value| match value.as_str()? {
                "sparse" => Some(false),
                "dense" => Some(true),
                _ => None,
            },
        )?;
        Ok(Self {
            maze,
            is_dense,
            is_continuing: arguments.flag("continuing_task", true)?,
            moves_goal: arguments.flag("reset_target", false)?,
        })
    }
}

/// The task.
#[derive(Debug)]
struct AntMaze {
    ant: Ant,
    rules: Rules,
    goal: [f64; N_PLACE],
}

impl AntMaze {
    fn distance_to_goal(&self, physics: &MujocoPhysics) -> f64 {
        distance(place(physics), self.goal)
    }
}

/// Where the ant is.
fn place(physics: &MujocoPhysics) -> [f64; N_PLACE] {
    let qpos = physics.qpos();
    [qpos[0], qpos[1]]
}

impl Task<MujocoPhysics> for AntMaze {
    fn initialize(
        &mut self,
        physics: &mut MujocoPhysics,
        generator: &mut Generator,
        options: &ResetOptions,
    ) -> Result<Option<bool>, EnvironmentError> {
        let (goal, start) = (options.goal_cell, options.reset_cell);
        let layout = self.rules.maze.draw_episode(goal, start, generator)?;
        self.goal = layout.goal;
        physics.reset_data();
        physics.qpos_mut()[..N_PLACE].copy_from_slice(&layout.start);
        physics.forward();
        Ok(Some(self.distance_to_goal(physics) <= GOAL_RADIUS_M))
    }

    fn before_step(&mut self, _: &MujocoPhysics) {}

    fn observe(&self, physics: &MujocoPhysics, observation: &mut [f64]) {
        let (achieved, rest) = observation.split_at_mut(N_PLACE);
        let (observed, desired) = rest.split_at_mut(rest.len() - N_PLACE);
        achieved.copy_from_slice(&place(physics));
        self.ant.observe(physics, observed);
        desired.copy_from_slice(&self.goal);
    }

    fn judge(
        &mut self,
        physics: &MujocoPhysics,
        _: &[f64],
        generator: &mut Generator,
    ) -> Judgement {
        let rules = &self.rules;
        let distance = self.distance_to_goal(physics);
        let success = distance <= GOAL_RADIUS_M;
        let reward = if rules.is_dense {
            (-distance).exp()
        } else {
            f64::from(u8::from(success))
        };
        if success && rules.is_continuing && rules.moves_goal {
            let next = rules.maze.draw_next_goal(place(physics), generator);
            self.goal = next.unwrap_or(self.goal);
        }
        Judgement {
            reward,
            terminated: success && !self.rules.is_continuing,
            success: Some(success),
            terms: RewardTerms::default(),
        }
    }

    fn read_info(&self, physics: &MujocoPhysics, info: &mut [f64]) {
        let (state, goal) = info.split_at_mut(info.len() - N_PLACE);
        physics.read_state(state);
        goal.copy_from_slice(&self.goal);
    }

    fn restore(&mut self, physics: &mut MujocoPhysics, info: &[f64]) {
        let (state, goal) = info.split_at(info.len() - N_PLACE);
        physics.restart(state);
        self.goal.copy_from_slice(goal);
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn make(id: &str, kwargs: &Value) -> Result<Box<dyn MujocoEnvironment>, EnvironmentError> {
        crate::mujoco::make(id, kwargs.as_object().unwrap(), None)
    }

    /// A maze whose goal is where the ant stands.
    fn at_the_goal(kwargs: &Value) -> (Box<dyn MujocoEnvironment>, Vec<f64>, Vec<f64>) {
        let mut environment = make("AntMaze_UMaze-v4", kwargs).unwrap();
        let mut observation = vec![0.0; environment.spec().observation_dim()];
        let mut info = vec![0.0; environment.spec().info_dim()];
        let options = ResetOptions::default();
        environment
            .reset(Some(1), &options, &mut observation)
            .unwrap();
        environment.read_info(&mut info);
        let (x, y) = (info[0], info[1]);
        info[29..].copy_from_slice(&[x, y + 0.4]);
        environment.restore(&info).unwrap();
        environment.observe(&mut observation).unwrap();
        (environment, observation, info)
    }

    #[test]
    fn parts_stand_in_the_published_order() {
        let (environment, observation, info) = at_the_goal(&json!({}));
        let names: Vec<_> = environment
            .spec()
            .observation
            .iter()
            .map(|part| (part.name, part.width))
            .collect();
        assert_eq!(
            names,
            [
                ("achieved_goal", 2),
                ("observation", 27),
                ("desired_goal", 2)
            ]
        );
        assert_eq!(observation[..], info[..]);
    }

    #[test]
    fn observations_have_the_width_that_version_and_arguments_ask_for() {
        for (id, kwargs, width) in [
            ("AntMaze_Large-v4", json!({}), 31),
            (
                "AntMaze_Large-v4",
                json!({"use_contact_forces": true}),
                31 + 84,
            ),
            ("AntMaze_Large-v5", json!({}), 31 + 78),
            (
                "AntMaze_Large-v5",
                json!({"include_cfrc_ext_in_observation": false}),
                31,
            ),
        ] {
            let environment = make(id, &kwargs).unwrap();
            assert_eq!(environment.spec().observation_dim(), width, "{id} {kwargs}");
        }
    }

    #[test]
    fn a_reached_goal_pays_and_the_episode_goes_on_or_ends() {
        for (kwargs, terminated) in [
            (json!({}), false),
            (json!({"continuing_task": false}), true),
        ] {
            let (mut environment, mut observation, _) = at_the_goal(&kwargs);
            let outcome = environment.step(&[0.0; 8], &mut observation).unwrap();
            assert_eq!((outcome.reward, outcome.success), (1.0, Some(true)));
            assert_eq!(outcome.terminated, terminated, "{kwargs}");
        }
    }

    #[test]
    fn a_dense_reward_falls_with_the_distance() {
        let (mut environment, mut observation, _) = at_the_goal(&json!({"reward_type": "dense"}));
        let outcome = environment.step(&[0.0; 8], &mut observation).unwrap();
        let distance = distance(
            [observation[0], observation[1]],
            [observation[29], observation[30]],
        );
        assert_eq!(outcome.reward, (-distance).exp());
    }

    #[test]
    fn a_reached_goal_moves_and_only_the_next_observation_shows_it() {
        let (mut environment, mut observation, info) = at_the_goal(&json!({"reset_target": true}));
        environment.step(&[0.0; 8], &mut observation).unwrap();
        assert_eq!(observation[29..], info[29..]);
        let outcome = environment.step(&[0.0; 8], &mut observation).unwrap();
        assert_ne!(observation[29..], info[29..]);
        assert_eq!(outcome.success, Some(false));
    }

    #[test]
    fn unusable_arguments_are_named() {
        for (id, kwargs, expected) in [
            (
                "AntMaze_UMaze-v4",
                json!({"maze_map": [[1, 1], [1]]}),
                "argument `maze_map`: row 1 has 1 cells, expected 2",
            ),
            (
                "AntMaze_UMaze-v4",
                json!({"reward_type": "none"}),
                "\"sparse\" or \"dense\"",
            ),
            (
                "AntMaze_UMaze-v4",
                json!({"reset_noise_scale": 1.0}),
                "the maze sets it",
            ),
            (
                "AntMaze_UMaze-v4",
                json!({"xml_file": "ant.xml"}),
                "argument `xml_file`: expected one of ",
            ),
            (
                "AntMaze_UMaze-v5",
                json!({"xml_file": "no/such.xml"}),
                "model no/such.xml: ",
            ),
        ] {
            let Err(error) = make(id, &kwargs) else {
                panic!("{id} took {kwargs}");
            };
            let cause = std::error::Error::source(&error);
            let cause = cause.map_or(String::new(), |cause| format!(": {cause}"));
            let message = format!("{error}{cause}");
            assert!(message.contains(expected), "{message}");
        }
    }
}
