//! What every environment must pass.
