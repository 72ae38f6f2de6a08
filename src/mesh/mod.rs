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
mod marks;
mod model;
mod parts;
mod refine;
mod repeat;
mod revise;
pub mod shapes;
mod sheets;
pub mod skin;
mod snapshot;
mod source;
mod step;
#[cfg(test)]
mod tests;
mod wedges;

pub use edges::{EdgeChange, EdgeTable};
pub use edit::{
    Collapse, Displacement, Edit, EditRecord, RemovedFace, Revalue, Rewedged, Split, SplitFace,
    Swap,
};
pub use edit_mesh::EditMesh;
pub use error::{MAX_FACES, MeshError, Violation};
pub use legality::{Legality, Topology};
pub use marks::{Feature, MAX_WEIGHT, Marks};
pub use model::{
    AttributeLayer, Corner, Coverage, EdgeId, FaceId, Image, Material, Mesh, Pixels, Semantic,
    Texture, TextureUse, VertexId, WedgeId, Wrap,
};
pub use parts::{Node, Part, Skin, Tree};
pub use repeat::Names;
pub use snapshot::Snapshot;
pub use source::{Emission, Glow, Glowing};
pub use step::{MoveCount, Sample, Stage, Step};
