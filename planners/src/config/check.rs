//! Which configurations are possible.

use std::fmt::Display;

use super::{ConfidenceConfig, Config, CuriosityConfig, PlanningConfig};
use crate::error::PlannerError;

impl Config {
    /// Checks every value and how they go together.
    ///
    /// # Errors
    /// The first value that is not possible.
    pub fn check(&self) -> Result<(), PlannerError> {
        self.check_data()?;
        self.check_networks()?;
        let diffusion = &self.diffusion;
        at_least("diffusion.n_timesteps", diffusion.n_timesteps, 2)?;
        at_least("diffusion.n_updates", diffusion.n_updates, 1)?;
        at_least("diffusion.batch_size", diffusion.batch_size, 1)?;
        positive("diffusion.learning_rate", diffusion.learning_rate)?;
        not_negative("diffusion.weight_decay", diffusion.weight_decay)?;
        share("diffusion.ema_rate", diffusion.ema_rate)?;
        not_negative("diffusion.action_loss_weight", diffusion.action_loss_weight)?;
        at_least("reward.interval", self.reward.interval, 1)?;
        positive("reward.learning_rate", self.reward.learning_rate)?;
        not_negative("reward.weight_decay", self.reward.weight_decay)?;
        share("reward.ema_rate", self.reward.ema_rate)?;
        if let Some(curiosity) = &self.curiosity {
            curiosity.check()?;
        }
        if let Some(confidence) = &self.confidence {
            confidence.check()?;
        }
        self.planning.check()?;
        at_least("checkpoint_interval", self.checkpoint_interval, 1)
    }

    fn check_data(&self) -> Result<(), PlannerError> {
        let data = &self.data;
        if !data.horizon.is_power_of_two() || data.horizon < 4 {
            return Err(setting(
                "data.horizon",
                "a power of two, at least 4",
                data.horizon,
            ));
        }
        at_least("data.max_path_length", data.max_path_length, data.horizon)?;
        share("data.discount", data.discount)?;
        for (name, value) in [
            ("data.terminal_penalty", data.terminal_penalty),
            ("data.goal_bonus", data.goal_bonus),
            ("data.reward_offset", data.reward_offset),
        ] {
            if !value.is_finite() {
                return Err(setting(name, "a finite number", value));
            }
        }
        Ok(())
    }

    fn check_networks(&self) -> Result<(), PlannerError> {
        let networks = &self.networks;
        // The target of the curiosity is half as wide and must keep a group of four channels at its narrowest.
        if networks.model_dim < 16 || !networks.model_dim.is_multiple_of(16) {
            return Err(setting(
                "networks.model_dim",
                "a multiple of 16, at least 16",
                networks.model_dim,
            ));
        }
        if networks.embedding_dim < 2 || !networks.embedding_dim.is_multiple_of(2) {
            return Err(setting(
                "networks.embedding_dim",
                "even, at least 2",
                networks.embedding_dim,
            ));
        }
        let levels = networks.dim_mult.len();
        let halvings = self.data.horizon.trailing_zeros() as usize;
        if levels == 0 || levels > halvings + 1 || networks.dim_mult.contains(&0) {
            return Err(setting(
                "networks.dim_mult",
                &format!("1 to {} positive factors (data.horizon)", halvings + 1),
                format!("{:?}", networks.dim_mult),
            ));
        }
        for (name, size) in [
            ("networks.kernel_size", networks.kernel_size),
            (
                "networks.classifier_kernel_size",
                networks.classifier_kernel_size,
            ),
        ] {
            if size % 2 == 0 {
                return Err(setting(name, "odd", size));
            }
        }
        Ok(())
    }
}

impl CuriosityConfig {
    fn check(&self) -> Result<(), PlannerError> {
        at_least("curiosity.n_updates", self.n_updates, 1)?;
        at_least("curiosity.batch_size", self.batch_size, 1)?;
        positive("curiosity.learning_rate", self.learning_rate)?;
        share("curiosity.ema_rate", self.ema_rate)?;
        at_least("curiosity.out_dim", self.out_dim, 1)
    }
}

impl ConfidenceConfig {
    fn check(&self) -> Result<(), PlannerError> {
        at_least("confidence.n_updates", self.n_updates, 1)?;
        at_least("confidence.batch_size", self.batch_size, 1)?;
        positive("confidence.learning_rate", self.learning_rate)?;
        at_least("confidence.out_dim", self.out_dim, 1)?;
        at_least("confidence.n_plans", self.n_plans, 1)?;
        at_least("confidence.top_candidates", self.top_candidates, 1)?;
        not_negative("confidence.scaling", self.scaling)?;
        for (name, hidden) in [
            ("confidence.hidden", &self.hidden),
            ("confidence.target_hidden", &self.target_hidden),
        ] {
            if hidden.is_empty() || hidden.contains(&0) {
                return Err(setting(
                    name,
                    "one or more positive sizes",
                    format!("{hidden:?}"),
                ));
            }
        }
        Ok(())
    }
}

impl PlanningConfig {
    /// Checks the values, which the options of loading may have replaced.
    ///
    /// # Errors
    /// The first value that is not possible.
    pub fn check(&self) -> Result<(), PlannerError> {
        at_least("planning.sampling_steps", self.sampling_steps, 1)?;
        at_least("planning.n_candidates", self.n_candidates, 1)?;
        not_negative("planning.temperature", self.temperature)?;
        not_negative("planning.guidance_weight", self.guidance_weight)?;
        not_negative("planning.curiosity_weight", self.curiosity_weight)
    }
}

fn setting(name: &str, expected: &str, found: impl Display) -> PlannerError {
    PlannerError::Setting {
        name: name.to_owned(),
        expected: expected.to_owned(),
        found: found.to_string(),
    }
}

fn at_least<T: PartialOrd + Display>(name: &str, value: T, least: T) -> Result<(), PlannerError> {
    if value < least {
        return Err(setting(name, &format!("at least {least}"), value));
    }
    Ok(())
}

fn positive(name: &str, value: f64) -> Result<(), PlannerError> {
    if !(value.is_finite() && value > 0.0) {
        return Err(setting(name, "a positive number", value));
    }
    Ok(())
}

fn not_negative(name: &str, value: f64) -> Result<(), PlannerError> {
    if !(value.is_finite() && value >= 0.0) {
        return Err(setting(name, "a number ≥ 0", value));
    }
    Ok(())
}

fn share(name: &str, value: f64) -> Result<(), PlannerError> {
    if !(0.0..=1.0).contains(&value) {
        return Err(setting(name, "a number between 0 and 1", value));
    }
    Ok(())
}
