//! Memoryless simplification: edge collapses that keep volume, judged by local geometry alone
//! (Lindstrom & Turk, Fast and Memory Efficient Polygonal Simplification, 1998; Evaluation of
//! Memoryless Simplification, 1999, whose numbers the comments cite).
//!
//! Invariants:
//! 1. a placement is a function of the mesh, the edge and the parameters; nothing of the original
//!    is remembered;
//! 2. results depend on nothing else either: no clock, no hashing order, no threads; equal costs
//!    go by edge id;
//! 3. every edit that a run makes is legal under the topology switch and told to the sink.
//!
//! Knows nothing of attributes (the mesh carries them along), files, pictures or jobs.

mod ahead;
mod constraints;
mod driver;
mod gather;
mod params;
mod placement;
mod quadratic;
mod queue;
#[cfg(test)]
mod tests;

pub use driver::{Outcome, Simplifier, StoppedBy, may_collapse, simplify};
pub use params::{Params, Scheme, Start};
pub use placement::{Placement, Scratch, placement, turns_too_far};
