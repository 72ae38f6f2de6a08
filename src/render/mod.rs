//! Pictures of the model, and the evaluator that tells what a local edit does to them.
//!
//! Knows nothing of edge queues, jobs or files.

pub mod view;
