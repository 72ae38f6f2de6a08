//! The service as its users meet it: real processes, real sockets, real signals.
//!
//! Every test starts its own servers on free ports with data directories of their own.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fails by panicking"
)]

mod abuse;
mod api;
mod auth;
mod bad_input;
mod chaos;
mod command_line;
mod evaluate;
mod farm;
mod files;
mod lint;
mod metrics;
mod optimize;
mod panics;
#[path = "../stores/postgres.rs"]
mod postgres;
mod processes;
mod queue;
mod resuming;
#[path = "../stores/s3.rs"]
mod s3;
mod settings;
mod support;
mod tls;
mod torture;
mod traces;
mod web;
mod webhooks;
mod workers;
