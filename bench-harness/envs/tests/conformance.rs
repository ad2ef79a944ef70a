//! Every registered environment of this build keeps the promises of the trait.

use ksim_envs::conformance::check_environment;
use ksim_envs::registry::{self, EnvironmentRequest};

#[test]
fn every_environment_conforms() {
    let has_mujoco = cfg!(feature = "mujoco");
    let mut n_checked = 0;
    for info in registry::all().filter(|info| has_mujoco || !info.needs_mujoco) {
        let request = EnvironmentRequest {
            max_episode_steps: Some(12),
            ..EnvironmentRequest::of_id(&info.id)
        };
        println!("{}", info.id);
        check_environment(&|| registry::make(&request).unwrap());
        n_checked += 1;
    }
    assert_eq!(n_checked > 1, has_mujoco);
}
