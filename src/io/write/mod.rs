//! Writers. The same mesh gives the same bytes.
//!
//! Files know no wedges: each distinct (vertex, wedge) pair that a face uses becomes one vertex
//! of the file, in the order of wedges and vertices, and the reader joins them again. Positions
//! are rounded to single precision (PLY can keep double, GLB may quantize them).

mod appearance;
mod columns;
mod glb;
mod nodes;
mod obj;
mod ply;
mod points;
mod skins;
mod store;

pub use glb::{GlbLevel, GlbOptions, write_glb, write_glb_with, write_lods};
pub use obj::write_obj;
pub use ply::{PlyPositions, write_ply};

use super::{IoError, ply::srgb_from_linear};
use crate::mesh::Mesh;

/// `Err` where the mesh breaks an invariant that a writer relies on.
fn check(format: &'static str, mesh: &Mesh) -> Result<(), IoError> {
    let bad = |problem: &str| IoError::Unwritable { format, problem: problem.to_owned() };
    let in_range = |list: &[[u32; 3]], n: usize| list.iter().flatten().all(|i| (*i as usize) < n);
    if mesh.faces.is_empty() {
        return Err(bad("the mesh has no triangles"));
    }
    if !in_range(&mesh.faces, mesh.positions.len()) {
        return Err(bad("a triangle names a vertex that is not there"));
    }
    if mesh.positions.iter().any(|p| !p.as_vec3().is_finite()) {
        return Err(bad("a position is beyond single precision; scale the model down"));
    }
    let n_wedges = mesh.n_wedges();
    if mesh.layers.iter().any(|l| l.width == 0 || l.values.len() != n_wedges * l.width) {
        return Err(bad("an attribute layer has the wrong length"));
    }
    let n_face_wedges = if mesh.layers.is_empty() { 0 } else { mesh.faces.len() };
    if mesh.face_wedges.len() != n_face_wedges || !in_range(&mesh.face_wedges, n_wedges) {
        return Err(bad("a triangle names a wedge that is not there"));
    }
    let n_materials = mesh.materials.len().max(1);
    if mesh.face_materials.iter().any(|m| *m as usize >= n_materials) {
        return Err(bad("a triangle names a material that is not there"));
    }
    if !mesh.face_materials.is_empty() && mesh.face_materials.len() != mesh.faces.len() {
        return Err(bad("not every triangle has a material"));
    }
    if !mesh.face_parts.is_empty() && mesh.face_parts.len() != mesh.faces.len() {
        return Err(bad("not every triangle has a part"));
    }
    if mesh.face_parts.iter().any(|part| *part as usize >= mesh.n_parts()) {
        return Err(bad("a triangle names a part that is not there"));
    }
    Ok(())
}
