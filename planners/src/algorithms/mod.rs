//! The diffusion planners, a file each.
//!
//! All three plan alike: from the current observation they denoise `n_candidates` windows, guided by log p,
//! and execute one of them. They differ in what guides and in how one is chosen.

mod curiosity_diffuser;
mod diffuser;
mod loaded;
mod plan;
mod rediffuser;

pub use curiosity_diffuser::CuriosityDiffuser;
pub use diffuser::Diffuser;
pub use rediffuser::{
    ReDiffuser, confidence_probabilities, confidence_uncertainties, top_candidates,
};
