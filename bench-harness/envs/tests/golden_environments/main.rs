//! The environments against what the published ones computed: compiled models, seeded resets, and recorded episodes.
#![cfg(feature = "mujoco")]
#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

mod model_facts;
mod recording;
mod replay;
mod resets;
