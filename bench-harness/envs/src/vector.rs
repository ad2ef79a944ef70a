//! Many environments stepped at once.

/// Environments of one kind, stepped together on the current rayon pool.
#[derive(Debug)]
pub struct VectorEnvironment {}
