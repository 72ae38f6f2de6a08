//! The `lookalike` binary: reads the command line and runs one role.

use std::process::ExitCode;

mod cli;
mod config;

#[tokio::main]
async fn main() -> ExitCode {
    cli::run().await
}
