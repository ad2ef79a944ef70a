//! The diffusion process: its schedule, its losses, and the sampler with guidance.

mod guide;
mod losses;
mod noise;
mod sampler;
mod schedule;

pub use guide::{Guide, GuideScore};
pub use losses::{DiffusionLoss, Noised, novelty_loss, paired_loss, value_loss};
pub use noise::{Noise, RecordedNoise, SeededNoise};
pub use sampler::{Denoising, Prior, Sample, Sampler};
pub use schedule::{SamplingStep, SamplingTable, Schedule};
