//! Whole jobs in one process: files in, files out.

mod bad_input;
mod determinism;
mod quality;
mod support;
