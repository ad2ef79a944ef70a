//! Ant: to walk forward on four legs.
//!
//! The rules are those of Gymnasium's `Ant-v4` and `Ant-v5`. The way gone is that of the torso's stale
//! [`MujocoPhysics::xpos`], not of `qpos`; contact forces are torque before force, one row per body.

use mujoco_rs::wrappers::mj_model::MjtObjBase;
use serde_json::Value;

use super::{Rules, Version, forward_terms, sum_of_squares};
use crate::environment::{Part, ResetOptions};
use crate::error::EnvironmentError;
use crate::mujoco::arguments::Arguments;
use crate::mujoco::{MujocoModel, MujocoPhysics};
use crate::numpy_rng::Generator;
use crate::simulation::{Judgement, Task};

/// Numbers of a body's contact force.
const N_FORCE: usize = 6;

/// What the ant's constructor takes, and the rules that follow from it.
#[derive(Debug)]
pub(crate) struct AntParams {
    version: Version,
    forward_reward_weight: f64,
    ctrl_cost_weight: f64,
    /// `None` where contact forces play no part.
    contact_cost_weight: Option<f64>,
    contact_force_range: [f64; 2],
    /// First body whose contact force is observed; `None` observes none.
    first_observed_body: Option<usize>,
    healthy_reward: f64,
    healthy_z_range: [f64; 2],
    terminate_when_unhealthy: bool,
    reset_noise_scale: f64,
    n_hidden: usize,
    /// The body whose way is paid for: a name or a number.
    main_body: Value,
}

impl AntParams {
    /// Reads the arguments that `Ant` takes in this version, without `xml_file` and `frame_skip`.
    pub(crate) fn read(
        version: Version,
        arguments: &mut Arguments<'_>,
    ) -> Result<Self, EnvironmentError> {
        let is_v5 = version == Version::V5;
        let has_contact = is_v5 || arguments.flag("use_contact_forces", false)?;
        let contact_cost_weight = arguments.number("contact_cost_weight", 5e-4)?;
        let mut params = Self {
            version,
            forward_reward_weight: 1.0,
            ctrl_cost_weight: arguments.number("ctrl_cost_weight", 0.5)?,
            contact_cost_weight: has_contact.then_some(contact_cost_weight),
            contact_force_range: arguments.range("contact_force_range", [-1.0, 1.0])?,
            // Version 4 observes the world's force too, which version 5 leaves out.
            first_observed_body: has_contact.then_some(usize::from(is_v5)),
            healthy_reward: arguments.number("healthy_reward", 1.0)?,
            healthy_z_range: arguments.range("healthy_z_range", [0.2, 1.0])?,
            terminate_when_unhealthy: arguments.flag("terminate_when_unhealthy", true)?,
            reset_noise_scale: arguments.number("reset_noise_scale", 0.1)?,
            n_hidden: super::n_hidden(arguments, 2)?,
            main_body: Value::from("torso"),
        };
        if is_v5 {
            params.forward_reward_weight = arguments.number("forward_reward_weight", 1.0)?;
            if !arguments.flag("include_cfrc_ext_in_observation", true)? {
                params.first_observed_body = None;
            }
            let kinds = "a body's name or number";
            params.main_body = arguments.take("main_body", Value::from(1), kinds, |value| {
                (value.is_string() || value.is_u64()).then(|| value.clone())
            })?;
        }
        Ok(params)
    }

    /// Whether contact forces are observed.
    pub(crate) fn observes_contact_forces(&self) -> bool {
        self.first_observed_body.is_some()
    }

    /// Whether the simulation has to compute contact forces.
    pub(crate) fn needs_contact_forces(&self) -> bool {
        self.contact_cost_weight.is_some()
    }
}

/// The task.
#[derive(Debug)]
pub(crate) struct Ant {
    id: String,
    params: AntParams,
    main_body: usize,
    dt_s: f64,
    x_before: f64,
}

/// Reads the arguments, makes the simulation and the task.
pub(super) fn make(
    version: Version,
    id: &str,
    arguments: &mut Arguments<'_>,
) -> Result<Rules<Ant>, EnvironmentError> {
    let model = super::model(true, arguments, "ant.xml")?;
    let frame_skip = super::frame_skip(version, arguments, 5)?;
    let params = AntParams::read(version, arguments)?;
    let physics = MujocoPhysics::new(&model, frame_skip, params.needs_contact_forces())?;
    let task = Ant::new(id, params, &model, &physics)?;
    let width = task.observation_dim(&physics);
    Ok(Rules {
        observation: vec![Part { name: "", width }],
        physics,
        task,
    })
}

impl Ant {
    /// The task in a model.
    ///
    /// # Errors
    /// A model without a torso that moves freely, or without the main body.
    pub(crate) fn new(
        id: &str,
        params: AntParams,
        model: &MujocoModel,
        physics: &MujocoPhysics,
    ) -> Result<Self, EnvironmentError> {
        let refuse = |message: String| EnvironmentError::Model {
            model: model.name().to_owned(),
            message,
        };
        if physics.qpos().len() < 7 {
            return Err(refuse("expected a torso with a free joint".to_owned()));
        }
        let n_bodies = physics.xpos().len();
        let main_body = match &params.main_body {
            Value::String(name) => physics.model().name_to_id(MjtObjBase::mjOBJ_BODY, name),
            number => number.as_u64().and_then(|id| usize::try_from(id).ok()),
        };
        let main_body = main_body
            .filter(|&body| body < n_bodies)
            .ok_or_else(|| refuse(format!("no body {}", params.main_body)))?;
        Ok(Self {
            id: id.to_owned(),
            params,
            main_body,
            dt_s: physics.dt_s(),
            x_before: 0.0,
        })
    }

    /// Numbers in the ant's observation.
    pub(crate) fn observation_dim(&self, physics: &MujocoPhysics) -> usize {
        let n_observed_bodies = self
            .params
            .first_observed_body
            .map_or(0, |first| physics.cfrc_ext().len() - first);
        physics.qpos().len() - self.params.n_hidden
            + physics.qvel().len()
            + N_FORCE * n_observed_bodies
    }

    fn is_healthy(&self, physics: &MujocoPhysics) -> bool {
        let [low, high] = self.params.healthy_z_range;
        let height = physics.qpos()[2];
        let mut state = physics.qpos().iter().chain(physics.qvel());
        state.all(|value| value.is_finite()) && low <= height && height <= high
    }

    fn contact_cost(&self, physics: &MujocoPhysics) -> f64 {
        let [low, high] = self.params.contact_force_range;
        let forces = physics.cfrc_ext().as_flattened().iter();
        self.params.contact_cost_weight.map_or(0.0, |weight| {
            weight * sum_of_squares(forces.map(|force| force.clamp(low, high)))
        })
    }
}

impl Task<MujocoPhysics> for Ant {
    fn initialize(
        &mut self,
        physics: &mut MujocoPhysics,
        generator: &mut Generator,
        options: &ResetOptions,
    ) -> Result<Option<bool>, EnvironmentError> {
        options.refuse_cells(&self.id)?;
        super::reset_with_normal_velocities(physics, generator, self.params.reset_noise_scale);
        Ok(None)
    }

    fn before_step(&mut self, physics: &MujocoPhysics) {
        self.x_before = physics.xpos()[self.main_body][0];
    }

    fn observe(&self, physics: &MujocoPhysics, observation: &mut [f64]) {
        let positions = &physics.qpos()[self.params.n_hidden..];
        let velocities = physics.qvel();
        let (head, tail) = observation.split_at_mut(positions.len());
        head.copy_from_slice(positions);
        let (middle, contact) = tail.split_at_mut(velocities.len());
        middle.copy_from_slice(velocities);
        if let Some(first) = self.params.first_observed_body {
            let [low, high] = self.params.contact_force_range;
            let forces = physics.cfrc_ext()[first..].as_flattened();
            for (observed, force) in contact.iter_mut().zip(forces) {
                *observed = force.clamp(low, high);
            }
        }
    }

    fn judge(&mut self, physics: &MujocoPhysics, action: &[f64], _: &mut Generator) -> Judgement {
        let params = &self.params;
        let velocity = (physics.xpos()[self.main_body][0] - self.x_before) / self.dt_s;
        let is_healthy = self.is_healthy(physics);
        let is_paid =
            is_healthy || (params.version == Version::V4 && params.terminate_when_unhealthy);
        forward_terms(
            params.forward_reward_weight * velocity,
            if is_paid { params.healthy_reward } else { 0.0 },
            params.ctrl_cost_weight * sum_of_squares(action.iter().copied()),
            self.contact_cost(physics),
            params.terminate_when_unhealthy && !is_healthy,
        )
    }

    fn read_info(&self, physics: &MujocoPhysics, info: &mut [f64]) {
        physics.read_state(info);
    }

    fn restore(&mut self, physics: &mut MujocoPhysics, info: &[f64]) {
        physics.restart(info);
    }
}
