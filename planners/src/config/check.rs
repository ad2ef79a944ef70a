//! Which configurations are possible.

use std::fmt::Display;
use std::ops::RangeInclusive;

use super::{ConfidenceConfig, Config, CuriosityConfig, PlanningConfig};
use crate::error::PlannerError;

/// The most updates of a phase, and the most updates between two of something.
const MOST_UPDATES: u64 = 1_000_000_000_000;
/// The most windows in a batch, candidates of a plan (each has a stream of random numbers of its own), timesteps, and
/// outputs of a network.
pub(crate) const MOST: usize = 1 << 16;
/// The most plans to generate, and steps of an episode.
const MOST_ROWS: usize = 1 << 24;

impl Config {
    /// Checks every value and how they go together.
    ///
    /// # Errors
    /// The first value that is not possible.
    pub fn check(&self) -> Result<(), PlannerError> {
        self.check_data()?;
        self.check_networks()?;
        let diffusion = &self.diffusion;
        between("diffusion.n_timesteps", diffusion.n_timesteps, 2..=MOST)?;
        between("diffusion.n_updates", diffusion.n_updates, 1..=MOST_UPDATES)?;
        between("diffusion.batch_size", diffusion.batch_size, 1..=MOST)?;
        positive("diffusion.learning_rate", diffusion.learning_rate)?;
        not_negative("diffusion.weight_decay", diffusion.weight_decay)?;
        share("diffusion.ema_rate", diffusion.ema_rate)?;
        not_negative("diffusion.action_loss_weight", diffusion.action_loss_weight)?;
        between("reward.interval", self.reward.interval, 1..=MOST_UPDATES)?;
        positive("reward.learning_rate", self.reward.learning_rate)?;
        not_negative("reward.weight_decay", self.reward.weight_decay)?;
        share("reward.ema_rate", self.reward.ema_rate)?;
        if let Some(curiosity) = &self.curiosity {
            curiosity.check()?;
        }
        if let Some(confidence) = &self.confidence {
            confidence.check()?;
        }
        self.planning.check(diffusion.n_timesteps)?;
        between(
            "checkpoint_interval",
            self.checkpoint_interval,
            1..=MOST_UPDATES,
        )
    }

    fn check_data(&self) -> Result<(), PlannerError> {
        let data = &self.data;
        if !data.horizon.is_power_of_two() || !(4..=MOST).contains(&data.horizon) {
            return Err(setting(
                "data.horizon",
                &format!("a power of two, 4 to {MOST}"),
                data.horizon,
            ));
        }
        let lengths = data.horizon..=MOST_ROWS;
        between("data.max_path_length", data.max_path_length, lengths)?;
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
        if !(16..=MOST).contains(&networks.model_dim) || !networks.model_dim.is_multiple_of(16) {
            return Err(setting(
                "networks.model_dim",
                &format!("a multiple of 16, 16 to {MOST}"),
                networks.model_dim,
            ));
        }
        if !(2..=MOST).contains(&networks.embedding_dim)
            || !networks.embedding_dim.is_multiple_of(2)
        {
            return Err(setting(
                "networks.embedding_dim",
                &format!("even, 2 to {MOST}"),
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
        between("curiosity.n_updates", self.n_updates, 1..=MOST_UPDATES)?;
        between("curiosity.batch_size", self.batch_size, 1..=MOST)?;
        positive("curiosity.learning_rate", self.learning_rate)?;
        share("curiosity.ema_rate", self.ema_rate)?;
        between("curiosity.out_dim", self.out_dim, 1..=MOST)
    }
}

impl ConfidenceConfig {
    fn check(&self) -> Result<(), PlannerError> {
        between("confidence.n_updates", self.n_updates, 1..=MOST_UPDATES)?;
        between("confidence.batch_size", self.batch_size, 1..=MOST)?;
        positive("confidence.learning_rate", self.learning_rate)?;
        between("confidence.out_dim", self.out_dim, 1..=MOST)?;
        between("confidence.n_plans", self.n_plans, 1..=MOST_ROWS)?;
        between("confidence.top_candidates", self.top_candidates, 1..=MOST)?;
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
    /// Checks the values, which the options of loading may have replaced. A diffusion process of `n_timesteps` cannot be
    /// gone through in more steps.
    ///
    /// # Errors
    /// The first value that is not possible.
    pub fn check(&self, n_timesteps: usize) -> Result<(), PlannerError> {
        let (name, steps) = ("planning.sampling_steps", self.sampling_steps);
        if !(1..=n_timesteps).contains(&steps) {
            let expected = format!("1 to {n_timesteps} (diffusion.n_timesteps)");
            return Err(setting(name, &expected, steps));
        }
        between("planning.n_candidates", self.n_candidates, 1..=MOST)?;
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

fn between<T: PartialOrd + Display>(
    name: &str,
    value: T,
    range: RangeInclusive<T>,
) -> Result<(), PlannerError> {
    if !range.contains(&value) {
        let expected = format!("{} to {}", range.start(), range.end());
        return Err(setting(name, &expected, value));
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

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::config::{Config, Mode, RewardRule};
    use crate::presets::{base, confidence};

    fn smoke() -> Config {
        base("smoke").unwrap()
    }

    #[test]
    fn counts_that_no_machine_holds_are_refused() {
        let mut config = smoke();
        config.confidence = Some(confidence("smoke"));
        let huge = u64::MAX;
        for (table, key) in [
            ("diffusion", "n_timesteps"),
            ("diffusion", "n_updates"),
            ("diffusion", "batch_size"),
            ("reward", "interval"),
            ("networks", "model_dim"),
            ("networks", "embedding_dim"),
            ("confidence", "n_plans"),
            ("confidence", "out_dim"),
            ("planning", "sampling_steps"),
            ("planning", "n_candidates"),
        ] {
            let overrides = json!({table: {key: huge - huge % 16}});
            let error = config.with_overrides(overrides.as_object().unwrap());
            let error = error.unwrap_err().to_string();
            let expected = format!("\"{table}.{key}\" is 1844674407370955160");
            assert!(
                error.contains(&expected) && error.contains(" to "),
                "{error}"
            );
        }
    }

    #[test]
    fn values_broadcast_where_the_reference_lets_them() {
        for (mode, rule, expected) in [
            (Mode::Reference, RewardRule::Goal, true),
            (Mode::Reference, RewardRule::Locomotion, false),
            (Mode::Corrected, RewardRule::Goal, false),
        ] {
            let mut config = smoke();
            (config.mode, config.data.rule) = (mode, rule);
            assert_eq!(config.broadcasts_values(), expected, "{mode:?} {rule:?}");
        }
    }
}
