//! Image-driven optimization (Lindstrom & Turk 2000, section 7): at a fixed number of vertices,
//! places, connectivity and attributes are changed wherever that brings the pictures closer to
//! the original's.
//!
//! Invariants:
//! 1. every edit of an [`Optimizer`] lowers the energy, judged exactly on the mesh as it is when the
//!    edit is made (a teleport: its split and its collapse together; the one exception is
//!    `allows_uphill`); what [`alternate`] does besides is kept if it lowers the energy as a whole;
//! 2. results depend on the mesh, the pictures and the parameters alone: not on clocks, threads,
//!    devices or batch timing;
//! 3. collapses satisfy the link condition, so the topology stays; a border may move.
//!
//! Ids are never reused: a teleport takes one vertex slot and two triangle slots for good, some
//! 0.6 kB with the evaluator's tables for 20 views.
//!
//! Knows nothing of files, devices or jobs.

mod alternate;
mod cycle;
mod descent;
mod driver;
mod edges;
mod held;
mod operations;
mod oracle;
mod params;
mod patches;
mod prices;
mod quadratic;
mod rng;
mod run;
mod simplex;
mod statistics;
mod sweeps;
mod teleport;
#[cfg(test)]
mod tests;
mod trial;

pub use alternate::{Listener, Shower, Turns, alternate};
pub use driver::{OptimizeError, Optimizer, Outcome};
pub use params::{Params, Solver, StoppedBy};
pub use run::Memory;
