//! NumPy's default generator, draw for draw.

/// NumPy's `default_rng(seed)`.
#[derive(Debug, Clone)]
pub struct Generator {}
