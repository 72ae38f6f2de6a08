//! The triangle mesh: data model, connectivity for local edits, and their undo.
//!
//! Knows nothing of files, pictures or jobs. Geometry is f64 throughout.

mod collapse;
mod edges;
mod edit;
mod edit_mesh;
mod error;
mod legality;
mod lists;
mod model;
mod refine;
pub mod shapes;
mod snapshot;
mod step;
#[cfg(test)]
mod tests;
mod wedges;

pub use edit::{Collapse, RemovedFace, Rewedged};
pub use model::{
    AttributeLayer, Corner, EdgeId, FaceId, Material, Mesh, Semantic, VertexId, WedgeId,
};
pub use step::{Sample, Stage, Step};
