//! HalfCheetah, Hopper and Walker2d: to run forward in a plane.
//!
//! The rules are those of Gymnasium's environments of these names, version 4 and 5. Position 0 is the way gone along
//! x, 1 the height, 2 the pitch.

use super::{Rules, Version, forward_terms, sum_of_squares};
use crate::environment::{Part, ResetOptions};
use crate::error::EnvironmentError;
use crate::mujoco::arguments::Arguments;
use crate::mujoco::{MujocoModel, MujocoPhysics};
use crate::numpy_rng::Generator;
use crate::simulation::{Judgement, Task};

/// Which of the three.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Robot {
    HalfCheetah,
    Hopper,
    Walker2d,
}

/// What must hold of a robot that stands. All bounds are exclusive.
#[derive(Debug, Clone, Copy)]
struct Health {
    height: [f64; 2],
    pitch: [f64; 2],
    /// Bounds of every position but the first two, and of every velocity.
    state: [f64; 2],
}

impl Health {
    fn holds(&self, physics: &MujocoPhysics) -> bool {
        let within = |[low, high]: [f64; 2], value: f64| low < value && value < high;
        let (qpos, qvel) = (physics.qpos(), physics.qvel());
        within(self.height, qpos[1])
            && within(self.pitch, qpos[2])
            && qpos[2..]
                .iter()
                .chain(qvel)
                .all(|&value| within(self.state, value))
    }
}

/// The task.
#[derive(Debug)]
pub(super) struct Planar {
    id: String,
    forward_reward_weight: f64,
    ctrl_cost_weight: f64,
    /// `None` for the robot that cannot fall.
    health: Option<Health>,
    healthy_reward: f64,
    terminate_when_unhealthy: bool,
    /// Version 4 pays a robot that is about to be stopped as well.
    pays_the_fallen: bool,
    reset_noise_scale: f64,
    has_normal_noise: bool,
    /// Positions that the observation leaves out.
    n_hidden: usize,
    max_velocity: f64,
    dt_s: f64,
    x_before: f64,
}

impl Robot {
    fn file(self, version: Version) -> &'static str {
        match (self, version) {
            (Self::HalfCheetah, _) => "half_cheetah.xml",
            (Self::Hopper, _) => "hopper.xml",
            (Self::Walker2d, Version::V4) => "walker2d.xml",
            (Self::Walker2d, Version::V5) => "walker2d_v5.xml",
        }
    }

    /// Reads the arguments, makes the simulation and the task.
    pub(super) fn make(
        self,
        version: Version,
        id: &str,
        arguments: &mut Arguments<'_>,
    ) -> Result<Rules<Planar>, EnvironmentError> {
        let model = super::model(version == Version::V5, arguments, self.file(version))?;
        let frame_skip = super::frame_skip(
            version,
            arguments,
            if self == Self::HalfCheetah { 5 } else { 4 },
        )?;
        let physics = MujocoPhysics::new(&model, frame_skip, false)?;
        check_shape(&model, &physics)?;
        let task = self.task(version, id, arguments, &physics)?;
        let width = physics.qpos().len() - task.n_hidden + physics.qvel().len();
        Ok(Rules {
            observation: vec![Part { name: "", width }],
            physics,
            task,
        })
    }

    fn task(
        self,
        version: Version,
        id: &str,
        arguments: &mut Arguments<'_>,
        physics: &MujocoPhysics,
    ) -> Result<Planar, EnvironmentError> {
        let is_cheetah = self == Self::HalfCheetah;
        let ctrl_cost_weight = if is_cheetah { 0.1 } else { 1e-3 };
        let reset_noise_scale = if is_cheetah { 0.1 } else { 5e-3 };
        let mut task = Planar {
            id: id.to_owned(),
            forward_reward_weight: arguments.number("forward_reward_weight", 1.0)?,
            ctrl_cost_weight: arguments.number("ctrl_cost_weight", ctrl_cost_weight)?,
            health: self.health(arguments)?,
            healthy_reward: 0.0,
            terminate_when_unhealthy: false,
            pays_the_fallen: version == Version::V4,
            reset_noise_scale: arguments.number("reset_noise_scale", reset_noise_scale)?,
            has_normal_noise: is_cheetah,
            n_hidden: super::n_hidden(arguments, 1)?,
            max_velocity: if is_cheetah { f64::INFINITY } else { 10.0 },
            dt_s: physics.dt_s(),
            x_before: 0.0,
        };
        if !is_cheetah {
            task.healthy_reward = arguments.number("healthy_reward", 1.0)?;
            task.terminate_when_unhealthy = arguments.flag("terminate_when_unhealthy", true)?;
        }
        Ok(task)
    }

    fn health(self, arguments: &mut Arguments<'_>) -> Result<Option<Health>, EnvironmentError> {
        let (state, height, pitch) = match self {
            Self::HalfCheetah => return Ok(None),
            Self::Hopper => (
                arguments.range("healthy_state_range", [-100.0, 100.0])?,
                [0.7, f64::INFINITY],
                [-0.2, 0.2],
            ),
            Self::Walker2d => ([f64::NEG_INFINITY, f64::INFINITY], [0.8, 2.0], [-1.0, 1.0]),
        };
        Ok(Some(Health {
            state,
            height: arguments.range("healthy_z_range", height)?,
            pitch: arguments.range("healthy_angle_range", pitch)?,
        }))
    }
}

fn check_shape(model: &MujocoModel, physics: &MujocoPhysics) -> Result<(), EnvironmentError> {
    let n_positions = physics.qpos().len();
    if n_positions >= 3 {
        return Ok(());
    }
    Err(EnvironmentError::Model {
        model: model.name().to_owned(),
        message: format!(
            "{n_positions} positions, expected at least 3: way, height and pitch of the torso"
        ),
    })
}

impl Task<MujocoPhysics> for Planar {
    fn initialize(
        &mut self,
        physics: &mut MujocoPhysics,
        generator: &mut Generator,
        options: &ResetOptions,
    ) -> Result<Option<bool>, EnvironmentError> {
        options.refuse_cells(&self.id)?;
        if self.has_normal_noise {
            super::reset_with_normal_velocities(physics, generator, self.reset_noise_scale);
            return Ok(None);
        }
        physics.reset_data();
        let scale = self.reset_noise_scale;
        for value in physics.qpos_mut() {
            *value += generator.uniform(-scale, scale);
        }
        for value in physics.qvel_mut() {
            *value += generator.uniform(-scale, scale);
        }
        physics.forward();
        Ok(None)
    }

    fn before_step(&mut self, physics: &MujocoPhysics) {
        self.x_before = physics.qpos()[0];
    }

    fn observe(&self, physics: &MujocoPhysics, observation: &mut [f64]) {
        let positions = &physics.qpos()[self.n_hidden..];
        let (head, tail) = observation.split_at_mut(positions.len());
        head.copy_from_slice(positions);
        for (observed, velocity) in tail.iter_mut().zip(physics.qvel()) {
            *observed = velocity.clamp(-self.max_velocity, self.max_velocity);
        }
    }

    fn judge(&mut self, physics: &MujocoPhysics, action: &[f64], _: &mut Generator) -> Judgement {
        let velocity = (physics.qpos()[0] - self.x_before) / self.dt_s;
        let is_healthy = self.health.is_none_or(|health| health.holds(physics));
        let is_paid = is_healthy || (self.pays_the_fallen && self.terminate_when_unhealthy);
        forward_terms(
            self.forward_reward_weight * velocity,
            if is_paid { self.healthy_reward } else { 0.0 },
            self.ctrl_cost_weight * sum_of_squares(action.iter().copied()),
            0.0,
            self.terminate_when_unhealthy && !is_healthy,
        )
    }

    fn read_info(&self, physics: &MujocoPhysics, info: &mut [f64]) {
        physics.read_state(info);
    }

    fn restore(&mut self, physics: &mut MujocoPhysics, info: &[f64]) {
        physics.restart(info);
    }
}
