//! Every environment keeps the promises of the trait.
#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use ksim_envs::conformance::check_environment;
use ksim_envs::registry::{self, EnvironmentRequest};

fn check(id: &str) {
    let request = EnvironmentRequest {
        id: id.to_owned(),
        max_episode_steps: Some(12),
        ..EnvironmentRequest::default()
    };
    check_environment(&|| registry::make(&request).unwrap());
}

#[test]
fn point_mass() {
    check("PointMass-v0");
}

#[cfg(feature = "mujoco")]
#[test]
fn robots() {
    for robot in ["HalfCheetah", "Hopper", "Walker2d", "Ant"] {
        check(&format!("{robot}-v4"));
        check(&format!("{robot}-v5"));
    }
}
