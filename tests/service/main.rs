//! The service as its users meet it: real processes, real sockets, real signals.
//!
//! Every test starts its own server on a free port with a data directory of its own.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fails by panicking"
)]

mod api;
mod auth;
mod bad_input;
mod command_line;
mod files;
mod lint;
mod optimize;
mod panics;
mod processes;
mod support;
mod tls;
mod torture;
mod workers;
