//! Image-driven simplification (Lindstrom & Turk 2000, section 6): every edge collapse in the order
//! of what it does to the pictures.
//!
//! Knows nothing of files, devices or jobs: an [`Objective`](crate::metric::Objective) judges.

mod candidates;
mod driver;
mod queue;
#[cfg(test)]
mod tests;

pub use candidates::Rules;
pub use driver::{BATCH, Outcome, Params, Policy, Simplifier, SimplifyError, StoppedBy};
