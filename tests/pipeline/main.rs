//! Whole jobs in one process: files in, files out.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fails by panicking"
)]

mod agreement;
mod assemblies;
mod bad_input;
mod budgets;
mod determinism;
mod evaluating;
mod large;
mod locks;
mod looks;
mod metrics;
mod optimizing;
mod quality;
mod resuming;
mod skins;
mod support;
mod topology;
