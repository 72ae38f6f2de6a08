//! Lookalike: levels of detail that look alike.
//!
//! # Layout
//!
//! Two pillars that meet only in [`worker`]. Geometry, which is pure (no async, clock,
//! environment or network):
//!
//! - [`mesh`]: triangles, wedges, local edits that return their undo
//! - [`io`]: files in, files out
//! - [`progressive`]: the record of every edit, and any level extracted from it
//! - [`memoryless`]: geometric simplification (Lindstrom & Turk 1998)
//! - [`cluster`]: vertex clustering, crude and fast
//! - [`render`]: views, rasters and the move evaluator, in WGSL and in Rust
//! - [`metric`]: image differences and surface distance
//! - [`simplify`]: image-driven simplification (Lindstrom & Turk 2000)
//! - [`optimize`]: image-driven optimization at a fixed number of vertices (the same)
//! - [`compare`]: off-line evaluation, pictures and plots
//!
//! And jobs, which know nothing of geometry: [`jobs`] (specification, states, leases, events,
//! stores) and [`service`] (gRPC adapters).
//!
//! [`tape`], below the geometry, remembers answers that were costly, so that a run can be resumed.
//! `intrinsics`, below all of them, has what is `unsafe`, and nothing else has.
//!
//! `tests/layers.rs` holds the table of who may import whom.

pub mod cluster;
pub mod compare;
mod intrinsics;
pub mod io;
pub mod jobs;
pub mod memoryless;
pub mod mesh;
pub mod metric;
pub mod optimize;
pub mod progressive;
pub mod render;
pub mod service;
pub mod simplify;
pub mod tape;
pub mod telemetry;
pub mod worker;
