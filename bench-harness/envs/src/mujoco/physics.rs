//! A MuJoCo simulation.

use std::sync::Arc;

use mujoco_rs::wrappers::mj_data::{MjData, MjtWarning};
use mujoco_rs::wrappers::mj_model::MjModel;

use super::MujocoModel;
use crate::error::EnvironmentError;
use crate::simulation::Physics;

/// A model with its state.
///
/// What is derived from the state is stale after a step, as in the published environments: [`MujocoPhysics::xpos`]
/// and [`MujocoPhysics::cfrc_ext`] belong to the last point at which the integrator evaluated the dynamics, not to
/// the `qpos` it arrived at. [`MujocoPhysics::forward`] refreshes them.
pub struct MujocoPhysics {
    data: MjData<Arc<MjModel>>,
    frame_skip: usize,
    contact_forces: bool,
}

impl std::fmt::Debug for MujocoPhysics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("MujocoPhysics")
            .field("qpos", &self.qpos())
            .field("qvel", &self.qvel())
            .field("frame_skip", &self.frame_skip)
            .finish_non_exhaustive()
    }
}

impl MujocoPhysics {
    /// A simulation in the model's initial state, which takes `frame_skip` engine steps for a control step.
    /// `contact_forces` says whether [`MujocoPhysics::cfrc_ext`] is wanted after each; it costs time and changes no
    /// state.
    ///
    /// # Errors
    /// A model whose state is too large to allocate.
    pub fn new(
        model: &MujocoModel,
        frame_skip: usize,
        contact_forces: bool,
    ) -> Result<Self, EnvironmentError> {
        let data = MjData::try_new(Arc::clone(model.compiled())).map_err(|error| {
            EnvironmentError::Model {
                model: model.name().to_owned(),
                message: error.to_string(),
            }
        })?;
        Ok(Self {
            data,
            frame_skip,
            contact_forces,
        })
    }

    /// Generalized positions, of `nq` numbers.
    pub fn qpos(&self) -> &[f64] {
        self.data.qpos()
    }

    /// Generalized positions, to be set before [`MujocoPhysics::forward`].
    pub fn qpos_mut(&mut self) -> &mut [f64] {
        self.data.qpos_mut()
    }

    /// Generalized velocities, of `nv` numbers.
    pub fn qvel(&self) -> &[f64] {
        self.data.qvel()
    }

    /// Generalized velocities, to be set before [`MujocoPhysics::forward`].
    pub fn qvel_mut(&mut self) -> &mut [f64] {
        self.data.qvel_mut()
    }

    /// Where the constraint solver starts, of `nv` accelerations: part of what decides the last digits of a step.
    pub fn qacc_warmstart(&self) -> &[f64] {
        self.data.qacc_warmstart()
    }

    /// Where the constraint solver starts, to be set before a step.
    pub fn qacc_warmstart_mut(&mut self) -> &mut [f64] {
        self.data.qacc_warmstart_mut()
    }

    /// Positions of the bodies in the world, in m; stale after a step.
    pub fn xpos(&self) -> &[[f64; 3]] {
        self.data.xpos()
    }

    /// Positions of the bodies, to be set to stale values of a recording; the next step computes them anew.
    pub fn xpos_mut(&mut self) -> &mut [[f64; 3]] {
        self.data.xpos_mut()
    }

    /// External forces on the bodies, torque (Nm) before force (N); stale after a step, zero after a reset, and never
    /// anything else unless contact forces were asked for.
    pub fn cfrc_ext(&self) -> &[[f64; 6]] {
        self.data.cfrc_ext()
    }

    /// The model.
    pub fn model(&self) -> &MjModel {
        self.data.model()
    }

    /// Control step, in seconds.
    pub fn dt_s(&self) -> f64 {
        self.data.model_opt().timestep * self.frame_skip as f64
    }

    /// Returns everything, the solver's memory included, to the model's initial state. What is derived from it is
    /// not computed yet.
    pub fn reset_data(&mut self) {
        self.data.reset();
    }

    /// Computes what is derived from the state.
    pub fn forward(&mut self) {
        self.data.forward();
    }

    /// Starts over from `state`, positions before velocities, with everything else as after a reset.
    ///
    /// # Panics
    /// If the slice is not `nq + nv` wide.
    pub fn restart(&mut self, state: &[f64]) {
        let (qpos, qvel) = state.split_at(self.qpos().len());
        self.reset_data();
        self.qpos_mut().copy_from_slice(qpos);
        self.qvel_mut().copy_from_slice(qvel);
        self.forward();
    }

    /// Writes positions, then velocities.
    ///
    /// # Panics
    /// If the slice is not `nq + nv` wide.
    pub fn read_state(&self, state: &mut [f64]) {
        let (qpos, qvel) = state.split_at_mut(self.qpos().len());
        qpos.copy_from_slice(self.qpos());
        qvel.copy_from_slice(self.qvel());
    }

    /// Lowest and highest control of every actuator.
    pub fn control_ranges(&self) -> (Vec<f64>, Vec<f64>) {
        let ranges = self.model().actuator_ctrlrange();
        ranges.iter().map(|&[low, high]| (low, high)).unzip()
    }

    /// The engine's complaint, if it met numbers it cannot go on with since the last reset. It then has put the state
    /// back to the initial one.
    fn divergence(&self) -> Option<String> {
        let warnings = self.data.warning();
        [
            (MjtWarning::mjWARN_BADQPOS, "position"),
            (MjtWarning::mjWARN_BADQVEL, "velocity"),
            (MjtWarning::mjWARN_BADQACC, "acceleration"),
        ]
        .into_iter()
        .find_map(|(warning, what)| {
            let stat = &warnings[warning as usize];
            let which = stat.lastinfo;
            (stat.number > 0)
                .then(|| format!("{what} {which} is not finite or exceeds the engine's limit"))
        })
    }
}

impl Physics for MujocoPhysics {
    fn step(&mut self, control: &[f64]) -> Result<(), String> {
        self.data.ctrl_mut().copy_from_slice(control);
        for _ in 0..self.frame_skip {
            self.data.step();
        }
        if self.contact_forces {
            self.data.rne_post_constraint();
        }
        self.divergence().map_or(Ok(()), Err)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mujoco::models;

    #[test]
    fn a_diverged_simulation_is_an_error_not_a_silent_restart() {
        let model =
            MujocoModel::from_xml("hopper", &models::published("hopper.xml").unwrap()).unwrap();
        assert_eq!(model.warnings(), &[] as &[String]);
        let mut physics = MujocoPhysics::new(&model, 4, false).unwrap();
        physics.step(&[0.0; 3]).unwrap();
        physics.qvel_mut()[3] = 1e300;
        let message = physics.step(&[0.0; 3]).unwrap_err();
        assert!(message.starts_with("velocity 3 "), "{message}");
        physics.reset_data();
        physics.step(&[0.0; 3]).unwrap();
    }

    #[test]
    fn a_broken_model_says_what_and_where_and_writes_no_log() {
        let error = MujocoModel::from_xml(
            "mine",
            "<mujoco>\n<worldbody><geom size='x'/></worldbody></mujoco>",
        )
        .unwrap_err()
        .to_string();
        assert!(
            error.starts_with("model mine: ") && error.contains("line 2"),
            "{error}"
        );
        let missing = MujocoModel::from_file("no/such.xml".as_ref()).unwrap_err();
        assert!(missing.to_string().contains("no/such.xml"), "{missing}");
        let deprecated = "<mujoco><compiler settotalmass='2'/><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>";
        let model = MujocoModel::from_xml("old", deprecated).unwrap();
        assert!(
            model.warnings()[0].contains("settotalmass"),
            "{:?}",
            model.warnings()
        );
        assert!(!std::path::Path::new("MUJOCO_LOG.TXT").exists());
    }
}
