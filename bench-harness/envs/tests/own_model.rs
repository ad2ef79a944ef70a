//! `xml_file`: a model of the user's own in a published task.
#![cfg(feature = "mujoco")]
#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use std::path::PathBuf;

use ksim_envs::mujoco::{self, MujocoEnvironment};
use ksim_envs::{EnvironmentError, ResetOptions};
use serde_json::json;

/// A plate on three joints, pushed along by one motor.
const PLATE: &str = r#"<mujoco>
  <worldbody>
    <body pos="0 0 1">
      <joint name="way" type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1" ref="1" stiffness="100" springref="1"/>
      <joint type="hinge" axis="0 1 0"/>
      <geom type="box" size="0.1 0.1 0.1" contype="0"/>
    </body>
  </worldbody>
  <actuator><motor joint="way" gear="100" ctrllimited="true" ctrlrange="-2 2"/></actuator>
</mujoco>
"#;

fn make(name: &str, xml: &str) -> Result<Box<dyn MujocoEnvironment>, EnvironmentError> {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, xml).unwrap();
    let kwargs = json!({"xml_file": path, "healthy_reward": 0.0, "frame_skip": 1});
    mujoco::make("Walker2d-v5", kwargs.as_object().unwrap(), None)
}

#[test]
fn a_model_of_ones_own_is_stepped_by_the_tasks_rules() {
    let mut environment = make("plate.xml", PLATE).unwrap();
    let spec = environment.spec();
    assert_eq!((spec.observation_dim(), spec.info_dim()), (5, 6));
    assert_eq!(
        (&spec.action_low[..], &spec.action_high[..]),
        (&[-2.0][..], &[2.0][..])
    );
    let mut observation = [0.0; 5];
    let options = ResetOptions::default();
    environment
        .reset(Some(0), &options, &mut observation)
        .unwrap();
    let outcome = environment.step(&[2.0], &mut observation).unwrap();
    assert!(
        outcome.terms.forward > 0.0 && !outcome.terminated,
        "{outcome:?}"
    );
}

#[test]
fn a_broken_model_is_named_with_what_is_wrong_and_where() {
    let refuse = |name: &str, xml: &str| match make(name, xml) {
        Ok(_) => panic!("{name} was taken"),
        Err(error) => error.to_string(),
    };
    let misspelled = refuse("misspelled.xml", &PLATE.replace("stiffness", "stifness"));
    for part in ["misspelled.xml", "stifness", "line 5"] {
        assert!(misspelled.contains(part), "{misspelled}");
    }
    let cut = refuse("cut.xml", &PLATE[..200]);
    assert!(cut.contains("cut.xml"), "{cut}");
    let hinge = "      <joint type=\"hinge\" axis=\"0 1 0\"/>\n";
    let stiff = refuse("stiff.xml", &PLATE.replace(hinge, ""));
    assert!(
        stiff.contains("2 positions, expected at least 3"),
        "{stiff}"
    );
    let motor = r#"<motor joint="way" gear="100" ctrllimited="true" ctrlrange="-2 2"/>"#;
    let lame = refuse("lame.xml", &PLATE.replace(motor, ""));
    assert!(lame.contains("no actuators"), "{lame}");
    let limits = r#" ctrllimited="true" ctrlrange="-2 2""#;
    let endless = refuse("endless.xml", &PLATE.replace(limits, ""));
    let range = "actuator 0 has the control range [0, 0], expected a `ctrlrange`";
    assert!(endless.contains(range), "{endless}");
}

#[test]
fn a_robot_of_ones_own_walks_in_the_maze() {
    let ball = r#"<mujoco>
  <worldbody>
    <geom type="plane" size="40 40 40" condim="1"/>
    <body pos="0 0 0.5"><joint name="root" type="free"/><geom size="0.3" condim="1"/></body>
  </worldbody>
  <actuator><motor joint="root" gear="1000 0 0 0 0 0" ctrlrange="-1 1"/></actuator>
</mujoco>"#;
    let make = |name: &str, xml: &str| {
        let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
        std::fs::write(&path, xml).unwrap();
        let kwargs = json!({"xml_file": path, "include_cfrc_ext_in_observation": false});
        mujoco::make("AntMaze_UMaze-v5", kwargs.as_object().unwrap(), None)
    };
    let mut environment = make("ball.xml", ball).unwrap();
    let mut observation = vec![0.0; 2 + (5 + 6) + 2];
    let options = ResetOptions {
        goal_cell: Some((3, 1)),
        reset_cell: Some((1, 1)),
    };
    environment
        .reset(Some(0), &options, &mut observation)
        .unwrap();
    for _ in 0..200 {
        environment.step(&[1.0], &mut observation).unwrap();
    }
    // The wall of cell (1, 4) begins at x = 6.
    assert!((5.5..6.0).contains(&observation[0]), "{observation:?}");
    let Err(error) = make("empty.xml", "<mujoco/>") else {
        panic!("no maze can be put into an empty model");
    };
    assert!(error.to_string().contains("worldbody"), "{error}");
}
