//! MuJoCo.
