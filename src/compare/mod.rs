//! Off-line evaluation: does the simplified mesh look like the original, by figures and pictures.
//!
//! Knows nothing of how a mesh was simplified, and nothing of files: meshes in, figures, PNG bytes
//! and SVG text out.

mod canvas;
mod evaluate;
mod mismatch;
pub mod plot;
pub mod raster;
pub mod sample;
mod scan;
pub mod sheet;
mod skin;
mod texture;
mod torus;

pub use evaluate::{
    Comparison, Params, Part, Reference, Tick, compare, json, report_text, summary,
};
pub use mismatch::mismatches;
pub use plot::{CurvePoint, PlotParams, PlotX, energy_plot};
pub use raster::{Appearance, Look, Shading};
pub use sample::sample_mesh;
pub use sheet::{
    Axis, SheetParams, SheetView, all_round_views, sheet, sheet_multi, sheets, try_sheet,
};
pub use torus::textured_torus;
