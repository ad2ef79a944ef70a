//! What is asked of the robots, by the rules of the published environments.

pub(crate) mod ant;
mod ant_maze;
mod planar;

use serde_json::{Map, Value};

use super::arguments::Arguments;
use super::{MujocoEnvironment, MujocoModel, MujocoPhysics, models};
use crate::environment::{EnvironmentSpec, Part, RewardTerms};
use crate::error::EnvironmentError;
use crate::maze::Variant;
use crate::numpy_rng::Generator;
use crate::simulation::{Judgement, SimEnvironment, Task};
use planar::Robot;

/// Which generation of Gymnasium's rules.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Version {
    V4,
    V5,
}

/// Makes an environment that MuJoCo steps, with the keyword arguments of Gymnasium's constructor: `HalfCheetah`,
/// `Hopper`, `Walker2d` or `Ant`, `-v4` or `-v5`, of 1000 steps if no other limit is given, or an `AntMaze`.
///
/// # Errors
/// Another id, an argument that the version does not take or cannot use, or a model file that does not compile.
pub fn make(
    id: &str,
    kwargs: &Map<String, Value>,
    max_episode_steps: Option<usize>,
) -> Result<Box<dyn MujocoEnvironment>, EnvironmentError> {
    if let Some(variant) = Variant::of_id(id) {
        return ant_maze::make(&variant, kwargs, max_episode_steps);
    }
    let version = match id.rsplit_once('-') {
        Some((_, "v4")) => Version::V4,
        Some((_, "v5")) => Version::V5,
        _ => return Err(unknown(id)),
    };
    let mut arguments = Arguments::new(id, kwargs);
    let max_episode_steps = max_episode_steps.unwrap_or(1000);
    let robot = match &id[..id.len() - "-v4".len()] {
        "Ant" => {
            return ant::make(version, id, &mut arguments)?.finish(
                id,
                arguments,
                max_episode_steps,
            );
        }
        "HalfCheetah" => Robot::HalfCheetah,
        "Hopper" => Robot::Hopper,
        "Walker2d" => Robot::Walker2d,
        _ => return Err(unknown(id)),
    };
    let rules = robot.make(version, id, &mut arguments)?;
    rules.finish(id, arguments, max_episode_steps)
}

fn unknown(id: &str) -> EnvironmentError {
    EnvironmentError::UnknownId {
        id: id.to_owned(),
        suggestions: Vec::new(),
    }
}

/// A simulation with its task, and how the task observes it.
struct Rules<T> {
    observation: Vec<Part>,
    physics: MujocoPhysics,
    task: T,
}

impl<T: Task<MujocoPhysics> + 'static> Rules<T> {
    fn finish(
        self,
        id: &str,
        arguments: Arguments<'_>,
        max_episode_steps: usize,
    ) -> Result<Box<dyn MujocoEnvironment>, EnvironmentError> {
        let (action_low, action_high) = action_ranges(id, &self.physics)?;
        let part = |name, width| Part { name, width };
        let spec = EnvironmentSpec {
            id: id.to_owned(),
            observation: self.observation,
            action_low,
            action_high,
            info: vec![
                part("qpos", self.physics.qpos().len()),
                part("qvel", self.physics.qvel().len()),
            ],
            max_episode_steps,
            dt_s: self.physics.dt_s(),
            reports_success: false,
            kwargs: arguments.finish()?,
        };
        Ok(Box::new(SimEnvironment::new(spec, self.physics, self.task)))
    }
}

/// Lowest and highest action, the lowest below the highest.
fn action_ranges(
    id: &str,
    physics: &MujocoPhysics,
) -> Result<(Vec<f64>, Vec<f64>), EnvironmentError> {
    let refuse = |message: String| EnvironmentError::Model {
        model: id.to_owned(),
        message,
    };
    let (low, high) = physics.control_ranges();
    if low.is_empty() {
        return Err(refuse("no actuators, expected at least one".to_owned()));
    }
    // MuJoCo gives an actuator without limits the range from 0 to 0, to which every policy would be clipped.
    match low.iter().zip(&high).position(|(low, high)| low >= high) {
        None => Ok((low, high)),
        Some(at) => Err(refuse(format!(
            "actuator {at} has the control range [{}, {}], expected a `ctrlrange` whose first number is the smaller",
            low[at], high[at]
        ))),
    }
}

/// The model of `xml_file`, where the constructor takes one: a published name, or else the path of a file.
fn model(
    takes_file: bool,
    arguments: &mut Arguments<'_>,
    default: &str,
) -> Result<MujocoModel, EnvironmentError> {
    let file = if takes_file {
        arguments.text("xml_file", default)?
    } else {
        default.to_owned()
    };
    match models::published(&file) {
        Some(xml) => MujocoModel::from_xml(&file, &xml),
        None => MujocoModel::from_file(file.as_ref()),
    }
}

/// Engine steps per control step, which version 5 lets one choose.
fn frame_skip(
    version: Version,
    arguments: &mut Arguments<'_>,
    default: usize,
) -> Result<usize, EnvironmentError> {
    match version {
        Version::V4 => Ok(default),
        Version::V5 => arguments.count("frame_skip", default),
    }
}

/// How many positions the observation leaves out: `n_horizontal` unless one wants to see them.
fn n_hidden(arguments: &mut Arguments<'_>, n_horizontal: usize) -> Result<usize, EnvironmentError> {
    let is_excluded = arguments.flag("exclude_current_positions_from_observation", true)?;
    Ok(if is_excluded { n_horizontal } else { 0 })
}

/// HalfCheetah's and Ant's first state: uniform noise on every position, normal noise on every velocity.
fn reset_with_normal_velocities(
    physics: &mut MujocoPhysics,
    generator: &mut Generator,
    scale: f64,
) {
    physics.reset_data();
    for value in physics.qpos_mut() {
        *value += generator.uniform(-scale, scale);
    }
    for value in physics.qvel_mut() {
        *value += scale * generator.standard_normal();
    }
    physics.forward();
}

/// The reward of its terms, added in the published order. Costs are given as positive numbers.
fn forward_terms(
    forward: f64,
    survive: f64,
    control_cost: f64,
    contact_cost: f64,
    terminated: bool,
) -> Judgement {
    Judgement {
        reward: (forward + survive) - (control_cost + contact_cost),
        terminated,
        success: None,
        terms: RewardTerms {
            forward,
            survive,
            control: -control_cost,
            contact: -contact_cost,
        },
    }
}

/// Sum of squares in the order of NumPy's pairwise summation, so that rewards are equal to the last bit: eight partial
/// sums for eight numbers or more, from left to right for fewer.
fn sum_of_squares(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n_values = values.len();
    let mut squares = values.map(|value| value * value);
    pairwise_sum(n_values, &mut squares)
}

/// Sums the next `n_values`; NumPy halves runs of more than 128.
fn pairwise_sum(n_values: usize, values: &mut impl Iterator<Item = f64>) -> f64 {
    if n_values < 8 {
        return values.take(n_values).fold(0.0, |sum, value| sum + value);
    }
    if n_values > 128 {
        let n_left = n_values / 2 - n_values / 2 % 8;
        return pairwise_sum(n_left, values) + pairwise_sum(n_values - n_left, values);
    }
    let mut partial = [0.0; 8];
    for _ in 0..n_values / 8 {
        for sum in &mut partial {
            *sum += values.next().unwrap_or_default();
        }
    }
    let [a, b, c, d, e, f, g, h] = partial;
    let whole = ((a + b) + (c + d)) + ((e + f) + (g + h));
    values
        .take(n_values % 8)
        .fold(whole, |sum, value| sum + value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn error(id: &str, kwargs: Value) -> String {
        let kwargs = kwargs.as_object().unwrap();
        match make(id, kwargs, None) {
            Ok(_) => panic!("{id} took {kwargs:?}"),
            Err(error) => error.to_string(),
        }
    }

    #[test]
    fn unusable_arguments_are_named() {
        for (id, kwargs, expected) in [
            (
                "Hopper-v5",
                json!({"healthy_reward": "much"}),
                "argument `healthy_reward`: expected a number, found \"much\"",
            ),
            (
                "HalfCheetah-v5",
                json!({"healthy_reward": 1.0}),
                "argument `healthy_reward`: expected one of ",
            ),
            (
                "HalfCheetah-v4",
                json!({"frame_skip": 2}),
                "argument `frame_skip`",
            ),
            (
                "Ant-v5",
                json!({"frame_skip": 0}),
                "a positive whole number",
            ),
            ("Ant-v5", json!({"main_body": "tail"}), "no body \"tail\""),
            (
                "Ant-v5",
                json!({"healthy_z_range": [1.0, 0.0]}),
                "low <= high",
            ),
            ("Ant-v4", json!({"xml_file": "no/such.xml"}), "no/such.xml"),
            ("Swimmer-v5", json!({}), "unknown environment"),
            ("", json!({}), "unknown environment"),
        ] {
            let message = error(id, kwargs);
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn arguments_change_the_specification() {
        let given = json!({
            "include_cfrc_ext_in_observation": false,
            "healthy_z_range": [0.0, "inf"],
            "healthy_reward": 1.0,
            "frame_skip": 2,
        });
        let environment = make("Ant-v5", given.as_object().unwrap(), Some(7)).unwrap();
        let spec = environment.spec();
        assert_eq!(spec.observation_dim(), 27);
        assert_eq!((spec.max_episode_steps, spec.dt_s), (7, 0.02));
        let names: Vec<_> = spec.kwargs.keys().map(String::as_str).collect();
        assert_eq!(
            names,
            [
                "frame_skip",
                "healthy_z_range",
                "include_cfrc_ext_in_observation"
            ]
        );
    }

    #[test]
    fn sums_go_in_numpys_order() {
        // NumPy 2.4: numpy.sum(numpy.square([1 / (i + 3) for i in range(n)])).
        let values = |n: usize| (0..n).map(|i| 1.0 / (i + 3) as f64);
        for (n, expected) in [
            (3, 0.2136111111111111),
            (8, 0.29976773116654065),
            (84, 0.3833735019574619),
            (300, 0.3916282847347757),
        ] {
            assert_eq!(
                sum_of_squares(values(n)).to_bits(),
                f64::to_bits(expected),
                "{n}"
            );
        }
    }
}
