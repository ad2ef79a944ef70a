//! What can go wrong.

/// A planner or one of its networks cannot do what was asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlannerError {
    /// A slice has another length than its shape says.
    #[error("{what} has {found} numbers, expected {expected}")]
    Length {
        /// Which array.
        what: &'static str,
        /// Numbers that its shape asks for.
        expected: usize,
        /// Numbers that it has.
        found: usize,
    },
    /// A tensor is missing from a set of weights.
    #[error("tensor \"{name}\" is missing")]
    MissingTensor {
        /// Its name.
        name: String,
    },
    /// A tensor has another shape than the network asks for.
    #[error("tensor \"{name}\" has the shape {found:?}, expected {expected:?}")]
    TensorShape {
        /// Its name.
        name: String,
        /// Shape of the network.
        expected: Vec<usize>,
        /// Shape that was found.
        found: Vec<usize>,
    },
    /// A network that cannot be built.
    #[error("{what} is {found}, expected {expected}")]
    Architecture {
        /// Which setting.
        what: &'static str,
        /// What is possible.
        expected: &'static str,
        /// What was asked for.
        found: String,
    },
}
