//! Wavefront OBJ: positions in full precision, normals, the first texture-coordinate set, and the
//! names of materials. Vertices stay joined: corners name position, coordinates and normal apart.

use std::fmt::Write;

use super::{IoError, check};
use crate::mesh::{FaceId, Mesh, Semantic};

/// Writes the mesh as text.
///
/// # Errors
/// [`IoError::Unwritable`] for a mesh without triangles or one that breaks its invariants.
pub fn write_obj(mesh: &Mesh) -> Result<Vec<u8>, IoError> {
    check("OBJ", mesh)?;
    let unwritable =
        |e: std::fmt::Error| IoError::Unwritable { format: "OBJ", problem: e.to_string() };
    let mut text = String::new();
    write_vertices(&mut text, mesh).map_err(unwritable)?;
    write_faces(&mut text, mesh).map_err(unwritable)?;
    Ok(text.into_bytes())
}

fn write_vertices(text: &mut String, mesh: &Mesh) -> std::fmt::Result {
    writeln!(text, "# Lookalike {}", env!("CARGO_PKG_VERSION"))?;
    for p in &mesh.positions {
        writeln!(text, "v {} {} {}", p.x, p.y, p.z)?;
    }
    for uv in mesh.layer(Semantic::TexCoord(0)).iter().flat_map(|l| l.values.as_chunks::<2>().0) {
        writeln!(text, "vt {} {}", uv[0], 1.0 - uv[1])?;
    }
    for n in mesh.layer(Semantic::Normal).iter().flat_map(|l| l.values.as_chunks::<3>().0) {
        writeln!(text, "vn {} {} {}", n[0], n[1], n[2])?;
    }
    Ok(())
}

fn write_faces(text: &mut String, mesh: &Mesh) -> std::fmt::Result {
    let has_uv = mesh.layer(Semantic::TexCoord(0)).is_some();
    let has_normal = mesh.layer(Semantic::Normal).is_some();
    let mut current = None;
    for (face, vertices) in mesh.faces.iter().enumerate() {
        let material = mesh.material_of(FaceId(face as u32));
        if current != Some(material) && !mesh.materials.is_empty() {
            current = Some(material);
            writeln!(text, "usemtl {}", material_name(mesh, material))?;
        }
        text.push('f');
        for (k, vertex) in vertices.iter().enumerate() {
            let wedge = mesh.face_wedges.get(face).map_or(0, |w| w[k]) + 1;
            match (has_uv, has_normal) {
                (false, false) => write!(text, " {}", vertex + 1)?,
                (true, false) => write!(text, " {}/{wedge}", vertex + 1)?,
                (false, true) => write!(text, " {}//{wedge}", vertex + 1)?,
                (true, true) => write!(text, " {}/{wedge}/{wedge}", vertex + 1)?,
            }
        }
        text.push('\n');
    }
    Ok(())
}

/// The material's name, which a line break would cut, or a made-up one.
fn material_name(mesh: &Mesh, material: u32) -> String {
    match mesh.materials.get(material as usize) {
        Some(m) if !m.name.trim().is_empty() => m.name.replace(['\n', '\r', '#'], " "),
        _ => format!("material_{material}"),
    }
}
