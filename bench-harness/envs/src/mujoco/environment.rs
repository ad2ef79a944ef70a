//! Environments whose simulation can be looked into and set.

use super::MujocoPhysics;
use crate::environment::Environment;
use crate::error::EnvironmentError;
use crate::simulation::{SimEnvironment, Task};

/// An environment on MuJoCo, whose state can be set: to replay what was recorded.
pub trait MujocoEnvironment: Environment {
    /// Starts an episode as [`SimEnvironment::restore`].
    ///
    /// # Errors
    /// A slice of another width than [`EnvironmentSpec::info_dim`](crate::EnvironmentSpec::info_dim).
    fn restore(&mut self, info: &[f64]) -> Result<(), EnvironmentError>;

    /// Writes the observation of the state as it is now.
    ///
    /// # Errors
    /// A slice of another width than
    /// [`EnvironmentSpec::observation_dim`](crate::EnvironmentSpec::observation_dim).
    fn observe(&self, observation: &mut [f64]) -> Result<(), EnvironmentError>;

    /// The simulation.
    fn physics(&self) -> &MujocoPhysics;

    /// The simulation, to be changed between steps.
    fn physics_mut(&mut self) -> &mut MujocoPhysics;
}

impl<T: Task<MujocoPhysics>> MujocoEnvironment for SimEnvironment<MujocoPhysics, T> {
    fn restore(&mut self, info: &[f64]) -> Result<(), EnvironmentError> {
        Self::restore(self, info)
    }

    fn observe(&self, observation: &mut [f64]) -> Result<(), EnvironmentError> {
        Self::observe(self, observation)
    }

    fn physics(&self) -> &MujocoPhysics {
        Self::physics(self)
    }

    fn physics_mut(&mut self) -> &mut MujocoPhysics {
        Self::physics_mut(self)
    }
}
