//! temporary
use crate::mesh::{EditMesh, VertexId};
/// .
#[derive(Clone, Debug, Default)]
pub struct Params { /// .
 pub lambda: f64, /// .
 pub seed: u64 }
/// .
#[derive(Default)]
pub struct Scratch;
/// .
pub struct Placement { /// .
 pub to: glam::DVec3 }
/// .
pub fn placement(mesh: &EditMesh, a: VertexId, b: VertexId, _p: &Params, _s: &mut Scratch) -> Option<Placement> {
    Some(Placement { to: (mesh.position(a) + mesh.position(b)) * 0.5 })
}
