//! The triangle mesh: data model, connectivity for local edits, and their undo.
//!
//! Knows nothing of files, pictures or jobs. Geometry is f64 throughout.

mod edit;
mod model;
mod step;

pub use edit::{Collapse, RemovedFace, Rewedged};
pub use model::{
    AttributeLayer, Corner, EdgeId, FaceId, Material, Mesh, Semantic, VertexId, WedgeId,
};
pub use step::{Sample, Stage, Step};
