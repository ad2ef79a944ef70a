//! K-Sim engine.
