//! An environment described as Gymnasium and Minari do.

use serde_json::{Map, Value, json};

use super::ids::{EnvironmentInfo, Family, find};
use crate::environment::EnvironmentSpec;

/// The environment as `EnvSpec.to_json` of Gymnasium writes it: what Minari keeps as `env_spec`. `None` for one that
/// Gymnasium does not have.
pub fn env_spec(spec: &EnvironmentSpec) -> Option<Value> {
    let info = find(&spec.id).ok()?;
    let mut kwargs = info.kwargs.clone();
    kwargs.extend(spec.kwargs.clone());
    Some(json!({
        "id": info.id,
        "entry_point": entry_point(&info)?,
        "reward_threshold": reward_threshold(info.family),
        "nondeterministic": false,
        "max_episode_steps": spec.max_episode_steps,
        "order_enforce": true,
        "disable_env_checker": false,
        "kwargs": kwargs,
        "additional_wrappers": [],
        "vector_entry_point": null,
    }))
}

/// The Python class that Gymnasium makes of an id.
pub(super) fn entry_point(info: &EnvironmentInfo) -> Option<String> {
    let version = info.version;
    let class = |module: &str, name: &str| {
        Some(format!(
            "gymnasium.envs.mujoco.{module}_v{version}:{name}Env"
        ))
    };
    match info.family {
        Family::PointMass => None,
        Family::HalfCheetah => class("half_cheetah", "HalfCheetah"),
        Family::Hopper => class("hopper", "Hopper"),
        Family::Walker2d => class("walker2d", "Walker2d"),
        Family::Ant => class("ant", "Ant"),
        Family::AntMaze => Some(format!(
            "gymnasium_robotics.envs.maze.ant_maze_v{version}:AntMazeEnv"
        )),
    }
}

/// The return at which Gymnasium calls a task solved.
fn reward_threshold(family: Family) -> Option<f64> {
    match family {
        Family::HalfCheetah => Some(4800.0),
        Family::Hopper => Some(3800.0),
        Family::Ant => Some(6000.0),
        Family::Walker2d | Family::AntMaze | Family::PointMass => None,
    }
}

/// The observation space as Minari writes it; infinities are the texts `-Infinity` and `Infinity`, as in the canonical
/// columns' [`SPACE_OBSERVATION`](ksim_datasets::schema::SPACE_OBSERVATION).
pub fn observation_space(spec: &EnvironmentSpec) -> Value {
    let unbounded = |width: usize| {
        let ends = ["-Infinity", "Infinity"].map(|end| vec![Value::from(end); width]);
        boxed("float64", ends)
    };
    if let [part] = &spec.observation[..]
        && part.name.is_empty()
    {
        return unbounded(part.width);
    }
    let mut parts: Vec<_> = spec.observation.iter().collect();
    // Gymnasium's dictionary spaces are sorted by key.
    parts.sort_by_key(|part| part.name);
    let parts = parts
        .iter()
        .map(|part| (part.name.to_owned(), unbounded(part.width)));
    json!({"type": "Dict", "subspaces": parts.collect::<Map<_, _>>()})
}

/// The action space as Minari writes it.
pub fn action_space(spec: &EnvironmentSpec) -> Value {
    let ends = [&spec.action_low, &spec.action_high];
    boxed(
        "float32",
        ends.map(|end| end.iter().map(|&x| Value::from(x)).collect()),
    )
}

fn boxed(dtype: &str, [low, high]: [Vec<Value>; 2]) -> Value {
    json!({"type": "Box", "dtype": dtype, "shape": [low.len()], "low": low, "high": high})
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::environment::Part;
    use crate::registry::{EnvironmentRequest, all, for_minari_spec};

    fn spec(info: &EnvironmentInfo) -> EnvironmentSpec {
        let part = |name, width| Part { name, width };
        EnvironmentSpec {
            id: info.id.clone(),
            observation: vec![part("observation", 1), part("desired_goal", 2)],
            action_low: vec![-1.0],
            action_high: vec![1.0],
            info: Vec::new(),
            max_episode_steps: info.max_episode_steps,
            dt_s: 0.05,
            reports_success: false,
            kwargs: Map::new(),
        }
    }

    #[test]
    fn every_id_is_written_as_gymnasium_writes_it() {
        // Made by fixtures/env_specs.py.
        let recorded = include_str!("../../tests/fixtures/env_specs.json");
        let recorded: Map<String, Value> = serde_json::from_str(recorded).expect("JSON");
        assert_eq!(recorded.len(), 48);
        for info in all().filter(|info| info.needs_mujoco) {
            let written = env_spec(&spec(&info)).expect(&info.id);
            assert_eq!(written, recorded[&info.id], "{}", info.id);
        }
    }

    #[test]
    fn arguments_go_over_the_registered_ones() {
        let mut spec = spec(&find("AntMaze_UMaze-v4").expect("known"));
        spec.kwargs.insert("reward_type".to_owned(), "dense".into());
        spec.kwargs
            .insert("continuing_task".to_owned(), false.into());
        let kwargs = &env_spec(&spec).expect("known")["kwargs"];
        assert_eq!(kwargs["reward_type"], "dense");
        assert_eq!(kwargs["continuing_task"], false);
        assert!(kwargs["maze_map"].is_array());
    }

    #[test]
    fn what_is_written_leads_back_to_the_environment() {
        for info in all().filter(|info| info.needs_mujoco) {
            let mut spec = spec(&info);
            spec.max_episode_steps = 77;
            spec.kwargs
                .insert("ctrl_cost_weight".to_owned(), 0.25.into());
            let mut kwargs = info.kwargs.clone();
            kwargs.extend(spec.kwargs.clone());
            let expected = EnvironmentRequest {
                id: info.id.clone(),
                kwargs,
                max_episode_steps: Some(77),
            };
            let written = env_spec(&spec).expect(&info.id);
            assert_eq!(
                for_minari_spec("mine", &written),
                Ok(expected),
                "{}",
                info.id
            );
        }
    }

    #[test]
    fn spaces_are_boxes_in_the_order_of_their_keys() {
        let spec = spec(&find("AntMaze_UMaze-v4").expect("known"));
        let written = observation_space(&spec);
        let goal = json!({"type": "Box", "dtype": "float64", "shape": [2],
            "low": ["-Infinity", "-Infinity"], "high": ["Infinity", "Infinity"]});
        assert_eq!(written["subspaces"]["desired_goal"], goal);
        let keys: Vec<_> = written["subspaces"]
            .as_object()
            .expect("parts")
            .keys()
            .collect();
        assert_eq!(keys, ["desired_goal", "observation"]);
        let action =
            json!({"type": "Box", "dtype": "float32", "shape": [1], "low": [-1.0], "high": [1.0]});
        assert_eq!(action_space(&spec), action);
    }
}
