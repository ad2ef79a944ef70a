//! Channels, lengths and group counts of the U-Nets: what follows from a configuration.

use super::architecture::{Architecture, HalfJannerConfig, JannerConfig, MlpConfig};
use crate::error::PlannerError;

/// Groups of the group norm over `channels`: min(8, channels div 4).
pub fn n_groups(channels: usize) -> usize {
    8.min(channels / 4)
}

/// Channels of every level: cumulative products.
fn channels(model_dim: usize, dim_mult: &[usize]) -> Vec<usize> {
    dim_mult
        .iter()
        .scan(model_dim, |dim, mult| {
            *dim = dim.saturating_mul(*mult);
            Some(*dim)
        })
        .collect()
}

/// The most numbers in all tensors of a network: a gigabyte, of which a training holds several.
const MOST_PARAMETERS: usize = 1 << 28;

/// The most channels, window steps or numbers that a network may have in one place: enough for any that can be
/// trained, and little enough that no product of two overflows.
const LARGEST: usize = 1 << 20;

fn check(
    holds: bool,
    what: &'static str,
    expected: &'static str,
    found: impl std::fmt::Debug,
) -> Result<(), PlannerError> {
    if holds {
        return Ok(());
    }
    Err(PlannerError::Architecture {
        what,
        expected,
        found: format!("{found:?}"),
    })
}

fn check_size(what: &'static str, size: usize) -> Result<(), PlannerError> {
    let holds = (1..=LARGEST).contains(&size);
    check(holds, what, "between 1 and 1048576", size)
}

fn check_channels(what: &'static str, channels: usize) -> Result<(), PlannerError> {
    let groups = n_groups(channels);
    check(
        groups > 0,
        what,
        "at least 4 channels, one group of the group norm",
        channels,
    )?;
    check(
        channels.is_multiple_of(groups),
        what,
        "a multiple of the groups min(8, channels / 4)",
        channels,
    )
}

/// The settings that both U-Nets have.
struct Common<'a> {
    horizon: usize,
    width: usize,
    model_dim: usize,
    embedding_dim: usize,
    dim_mult: &'a [usize],
    kernel_size: usize,
}

impl Common<'_> {
    fn check(&self) -> Result<(), PlannerError> {
        check_size("horizon", self.horizon)?;
        check(
            self.horizon.is_power_of_two(),
            "horizon",
            "a power of two",
            self.horizon,
        )?;
        check_size("width of a step", self.width)?;
        check_size("model_dim", self.model_dim)?;
        check_size("embedding_dim", self.embedding_dim)?;
        check(
            self.embedding_dim.is_multiple_of(2),
            "embedding_dim",
            "even",
            self.embedding_dim,
        )?;
        check(
            self.kernel_size % 2 == 1 && self.kernel_size < 64,
            "kernel_size",
            "odd and below 64",
            self.kernel_size,
        )?;
        check(
            !self.dim_mult.is_empty() && self.dim_mult.len() <= 16,
            "dim_mult",
            "one to 16 levels",
            self.dim_mult,
        )?;
        for channels in channels(self.model_dim, self.dim_mult) {
            check_size("channels of a level", channels)?;
            check_channels("channels of a level", channels)?;
        }
        Ok(())
    }
}

impl JannerConfig {
    /// Channels of every level.
    pub fn channels(&self) -> Vec<usize> {
        channels(self.model_dim, &self.dim_mult)
    }

    /// Refuses settings with which there is no such network.
    ///
    /// # Errors
    /// Names the setting.
    pub fn validate(&self) -> Result<(), PlannerError> {
        self.common().check()?;
        check(
            self.horizon >> (self.dim_mult.len() - 1) > 0,
            "horizon",
            "halved once per level after the first, at least 1",
            self.horizon,
        )
    }

    fn common(&self) -> Common<'_> {
        Common {
            horizon: self.horizon,
            width: self.width,
            model_dim: self.model_dim,
            embedding_dim: self.embedding_dim,
            dim_mult: &self.dim_mult,
            kernel_size: self.kernel_size,
        }
    }
}

impl HalfJannerConfig {
    /// Channels of every level.
    pub fn channels(&self) -> Vec<usize> {
        channels(self.model_dim, &self.dim_mult)
    }

    /// Channels after the two blocks of the middle.
    pub fn middle_channels(&self) -> [usize; 2] {
        let last = self.channels().last().copied().unwrap_or(0);
        [last / 2, last / 4]
    }

    /// Steps that are left after the levels and the middle; a step is never halved below one.
    pub fn final_length(&self) -> usize {
        (self.horizon >> (self.dim_mult.len() + 1)).max(1)
    }

    /// Numbers that the last block takes of the window.
    pub fn flat_len(&self) -> usize {
        self.middle_channels()[1] * self.final_length()
    }

    /// Refuses settings with which there is no such network.
    ///
    /// # Errors
    /// Names the setting.
    pub fn validate(&self) -> Result<(), PlannerError> {
        self.common().check()?;
        check_size("out_dim", self.out_dim)?;
        for channels in self.middle_channels() {
            check_channels("channels of the middle", channels)?;
        }
        Ok(())
    }

    fn common(&self) -> Common<'_> {
        Common {
            horizon: self.horizon,
            width: self.width,
            model_dim: self.model_dim,
            embedding_dim: self.embedding_dim,
            dim_mult: &self.dim_mult,
            kernel_size: self.kernel_size,
        }
    }
}

impl MlpConfig {
    /// Inputs and outputs of every linear layer.
    pub fn layers(&self) -> Vec<(usize, usize)> {
        let inputs = std::iter::once(self.in_dim).chain(self.hidden.iter().copied());
        let outputs = self.hidden.iter().copied().chain([self.out_dim]);
        inputs.zip(outputs).collect()
    }

    /// Refuses settings with which there is no such network.
    ///
    /// # Errors
    /// Names the setting.
    pub fn validate(&self) -> Result<(), PlannerError> {
        for (inputs, outputs) in self.layers() {
            check_size("in_dim or a hidden layer", inputs)?;
            check_size("a hidden layer or out_dim", outputs)?;
        }
        Ok(())
    }
}

impl Architecture {
    /// Refuses settings with which there is no such network.
    ///
    /// # Errors
    /// Names the setting.
    pub fn validate(&self) -> Result<(), PlannerError> {
        match self {
            Self::Janner(config) => config.validate()?,
            Self::HalfJanner(config) => config.validate()?,
            Self::Mlp(config) => config.validate()?,
        }
        let numbers = |shape: &[usize]| {
            shape
                .iter()
                .fold(1, |n: usize, size| n.saturating_mul(*size))
        };
        let specs = self.specs();
        let total = specs
            .iter()
            .fold(0, |n: usize, spec| n.saturating_add(numbers(&spec.shape)));
        check(
            total <= MOST_PARAMETERS,
            "the number of parameters of a network",
            "at most 268435456",
            total,
        )
    }
}
