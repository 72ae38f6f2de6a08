//! Pictures of the model, and the evaluator that tells what a local edit does to them.
//!
//! Knows nothing of edge queues, jobs or files.

mod choose;
#[cfg(test)]
mod contract;
mod device;
mod evaluator;
mod fragments;
mod gpu;
mod kernel;
#[cfg(target_arch = "x86_64")]
mod kernel_avx2;
#[cfg(target_arch = "x86_64")]
mod kernel_avx2_paint;
pub mod lattice;
mod moves;
mod nearest;
mod paint;
mod raster;
mod scene;
mod taped;
mod tiles;
mod twin;
pub mod view;

pub use choose::{Choice, choose, make_evaluator};
pub use device::{AdapterInfo, adapters};
pub use evaluator::{Evaluator, FULL_WEIGHT, Reference, RenderError};
pub use moves::{AddedFace, MAX_MOVE_VERTICES, Move};
pub use nearest::{NOTHING, Nearest};
pub use paint::{Alpha, Paint, PaintSlope, Painted, Sieve, Texels};
pub use raster::{energy, picture, reference, reference_and_seen};
pub use scene::{RenderParams, Scene, SceneFace, Shading, Surface};
pub use taped::{Maker, Taped};
pub use twin::Twin;
