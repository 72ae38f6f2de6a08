//! The `lookalike` binary: reads the command line and runs one role.
fn main() {}
