//! The ksim command.
fn main() {}
