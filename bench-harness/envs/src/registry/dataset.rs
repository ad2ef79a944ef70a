//! The environment that a dataset was made in, and the one on which its policies are judged.

use ksim_datasets::DatasetInfo;
use ksim_datasets::registry::{self as published, Known, Store};
use serde_json::{Map, Value};

use super::EnvironmentRequest;
use super::gymnasium::entry_point;
use super::ids::find;
use crate::error::EnvironmentError;

/// What is known of a dataset's environment.
#[derive(Debug, Clone, PartialEq)]
pub struct DatasetEnvironment {
    /// The environment of the recorded episodes.
    pub request: EnvironmentRequest,
    /// The environment on which policies are judged; it may have another maze.
    pub evaluation: EnvironmentRequest,
    /// Returns that count as 0 and 1 in normalized scores, where recorded or published.
    pub reference: Option<(f64, f64)>,
    /// What to know before numbers are compared.
    pub note: Option<&'static str>,
}

const OLD_ENGINE: &str = "recorded in an older environment and engine: version 4 has the same rules, but actions do \
    not replay, and D4RL's reference scores are a convention";
const OLD_ANT: &str = "recorded in an older environment and engine, where the 84 contact forces of an observation are \
    practically zero: version 4 has the same rules, but real forces; actions do not replay, and D4RL's reference \
    scores are a convention";
const OTHER_MAZE: &str = "D4RL's AntMaze is an environment of its own (29 numbers without the goal, steps of 0.1 s, \
    origin at the start, the episode ends within 0.5 m of the goal), and its policies do not transfer";

/// The environment of a D4RL dataset, such as `hopper-medium-v2`: version 4 of the robot's, with contact forces for
/// Ant, whose 111 observed numbers include them.
///
/// # Errors
/// A name that D4RL does not have, or a dataset whose environment is not among ours.
pub fn for_d4rl(name: &str) -> Result<DatasetEnvironment, EnvironmentError> {
    let known = published::find(name).filter(|known| known.store == Store::D4rl);
    let known = known.ok_or_else(|| none(name, "D4RL has no dataset of this name"))?;
    let (id, note) = match name.split_once('-').map(|(family, _)| family) {
        Some("halfcheetah") => ("HalfCheetah-v4", OLD_ENGINE),
        Some("hopper") => ("Hopper-v4", OLD_ENGINE),
        Some("walker2d") => ("Walker2d-v4", OLD_ENGINE),
        Some("ant") => ("Ant-v4", OLD_ANT),
        Some("antmaze") => return Err(none(name, &format!("{OTHER_MAZE}{}", counterpart(name)))),
        _ => return Err(none(name, "its environment is not among ours")),
    };
    let mut request = EnvironmentRequest::of_id(id);
    if id == "Ant-v4" {
        let contact = "use_contact_forces".to_owned();
        request.kwargs.insert(contact, true.into());
    }
    Ok(DatasetEnvironment {
        evaluation: request.clone(),
        request,
        reference: reference(known),
        note: Some(note),
    })
}

/// `; use …`, where Minari has the dataset too.
fn counterpart(name: &str) -> String {
    let others = published::alternatives(name);
    let minari = others.iter().find(|id| id.starts_with("D4RL/"));
    minari.map_or(String::new(), |id| {
        format!("; `{id}` of Minari has an environment here")
    })
}

/// The environment of a specification that Gymnasium wrote: `env_spec` or `eval_env_spec` of Minari's metadata, as JSON
/// or as text that holds it. Without a time limit in it, the id's counts. `dataset` is what errors call it.
///
/// # Errors
/// Text that is no specification, an id or class that is not among ours, or wrappers, which could change anything.
pub fn for_minari_spec(
    dataset: &str,
    spec: &Value,
) -> Result<EnvironmentRequest, EnvironmentError> {
    let refuse = |reason: String| EnvironmentError::NoEnvironment {
        dataset: dataset.to_owned(),
        reason,
    };
    let parsed: Value;
    let spec = match spec {
        Value::String(text) => {
            parsed = serde_json::from_str(text)
                .map_err(|e| refuse(format!("its environment specification is no JSON: {e}")))?;
            &parsed
        }
        spec => spec,
    };
    let Some(id) = spec["id"].as_str() else {
        return Err(refuse("its environment specification has no id".to_owned()));
    };
    let info = find(id).map_err(|error| refuse(error.to_string()))?;
    if info.id != id {
        return Err(refuse(format!("its environment `{id}` is not among ours")));
    }
    let expected = entry_point(&info);
    let found = spec["entry_point"].as_str();
    if found.is_some() && found != expected.as_deref() {
        let (found, expected) = (found.unwrap_or_default(), expected.unwrap_or_default());
        return Err(refuse(format!(
            "its environment `{id}` is made by `{found}`, expected `{expected}`"
        )));
    }
    match &spec["additional_wrappers"] {
        Value::Null => {}
        Value::Array(wrappers) if wrappers.is_empty() => {}
        wrappers => {
            return Err(refuse(format!(
                "its environment is wrapped, and wrappers are not known here: {wrappers}"
            )));
        }
    }
    let limit = spec["max_episode_steps"].as_u64();
    Ok(EnvironmentRequest {
        id: info.id,
        kwargs: arguments(&spec["kwargs"]),
        max_episode_steps: limit.and_then(|limit| usize::try_from(limit).ok()),
    })
}

/// Keyword arguments without those that only draw.
fn arguments(kwargs: &Value) -> Map<String, Value> {
    let mut kwargs = kwargs.as_object().cloned().unwrap_or_default();
    kwargs.retain(|name, _| name != "render_mode");
    kwargs
}

/// The environment of a dataset: by the specification it carries, else by its published name.
///
/// # Errors
/// As [`for_minari_spec`] and [`for_d4rl`]; a dataset that says nothing of its environment.
pub fn for_dataset(info: &DatasetInfo) -> Result<DatasetEnvironment, EnvironmentError> {
    let Some(spec) = &info.env_spec else {
        return match d4rl_name(info) {
            Some(name) => for_d4rl(name),
            None => Err(none(
                &info.id,
                "it does not say in which environment it was made",
            )),
        };
    };
    let request = for_minari_spec(&info.id, spec)?;
    let evaluation = match info.metadata.get("eval_env_spec") {
        None | Some(Value::Null) => request.clone(),
        Some(spec) => for_minari_spec(&info.id, spec)?,
    };
    Ok(DatasetEnvironment {
        request,
        evaluation,
        reference: info.ref_min_score.zip(info.ref_max_score),
        note: None,
    })
}

/// The D4RL dataset that a file holds, by its name.
fn d4rl_name(info: &DatasetInfo) -> Option<&'static str> {
    let as_file = || published::find_file(&format!("{}.hdf5", info.id));
    let known = published::find(&info.id).or_else(as_file)?;
    (known.store == Store::D4rl).then_some(known.id)
}

fn reference(known: &Known) -> Option<(f64, f64)> {
    known.ref_min_score.zip(known.ref_max_score)
}

fn none(dataset: &str, reason: &str) -> EnvironmentError {
    EnvironmentError::NoEnvironment {
        dataset: dataset.to_owned(),
        reason: reason.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn refused<T: std::fmt::Debug>(result: Result<T, EnvironmentError>) -> String {
        result.expect_err("refused").to_string()
    }

    #[test]
    fn d4rls_robots_have_version_4_rules_and_published_scores() {
        let hopper = for_d4rl("hopper-medium-replay-v2").expect("one of ours");
        assert_eq!(hopper.request, EnvironmentRequest::of_id("Hopper-v4"));
        assert_eq!(hopper.evaluation, hopper.request);
        assert_eq!(hopper.reference, Some((-20.272305, 3234.3)));
        let ant = for_d4rl("ant-expert-v2").expect("one of ours");
        assert_eq!(ant.request.kwargs["use_contact_forces"], true);
        assert!(
            ant.note
                .is_some_and(|note| note.contains("84 contact forces"))
        );
    }

    #[test]
    fn every_d4rl_dataset_has_an_environment_or_a_reason() {
        for known in published::all().filter(|known| known.store == Store::D4rl) {
            let robot = ["halfcheetah-", "hopper-", "walker2d-", "ant-"];
            let ours = robot.iter().any(|robot| known.id.starts_with(robot));
            match for_d4rl(known.id) {
                Ok(found) => assert!(ours && super::super::find(&found.request.id).is_ok()),
                Err(error) => assert!(!ours, "{error}"),
            }
        }
    }

    #[test]
    fn d4rls_mazes_say_why_not_and_what_else() {
        let message = refused(for_d4rl("antmaze-large-play-v2"));
        assert!(
            message.starts_with("antmaze-large-play-v2: D4RL's AntMaze is"),
            "{message}"
        );
        assert!(
            message.contains("`D4RL/antmaze/large-play-v1` of Minari"),
            "{message}"
        );
        assert!(refused(for_d4rl("pen-human-v1")).contains("not among ours"));
        assert!(refused(for_d4rl("hopper-medium-v9")).contains("D4RL has no dataset"));
        assert!(refused(for_d4rl("D4RL/antmaze/large-play-v1")).contains("D4RL has no dataset"));
    }

    #[test]
    fn a_specification_gives_id_arguments_and_limit() {
        let spec = json!({
            "id": "AntMaze_UMaze-v4",
            "entry_point": "gymnasium_robotics.envs.maze.ant_maze_v4:AntMazeEnv",
            "max_episode_steps": 300,
            "kwargs": {"continuing_task": true, "render_mode": "rgb_array"},
            "additional_wrappers": [],
        });
        let request = for_minari_spec("mine", &spec).expect("one of ours");
        assert_eq!(
            for_minari_spec("mine", &spec.to_string().into()),
            Ok(request.clone())
        );
        assert_eq!(request.id, "AntMaze_UMaze-v4");
        assert_eq!(
            Value::Object(request.kwargs),
            json!({"continuing_task": true})
        );
        assert_eq!(request.max_episode_steps, Some(300));
    }

    #[test]
    fn specifications_of_other_environments_are_refused() {
        for (spec, reason) in [
            (json!("{"), "no JSON"),
            (json!({"kwargs": {}}), "has no id"),
            (json!({"id": "CartPole-v1"}), "unknown environment"),
            (json!({"id": "hopper"}), "`hopper` is not among ours"),
            (json!({"id": "AntMaze_UMaze-v3"}), "not offered"),
            (
                json!({"id": "Hopper-v5", "entry_point": "mine:HopperEnv"}),
                "made by `mine:HopperEnv`, expected `gymnasium.envs.mujoco.hopper_v5:HopperEnv`",
            ),
            (
                json!({"id": "Hopper-v5", "additional_wrappers": [{"name": "ClipReward"}]}),
                "ClipReward",
            ),
        ] {
            let message = refused(for_minari_spec("mine", &spec));
            assert!(
                message.starts_with("mine: ") && message.contains(reason),
                "{message}"
            );
        }
    }
}
