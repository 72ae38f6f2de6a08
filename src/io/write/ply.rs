//! PLY, binary little endian.
//!
//! Positions, normals, the first texture-coordinate set (`s`, `t`, counted upwards) and the first
//! colour set (8 bits per channel, sRGB, as every viewer expects: colours are rounded). Materials,
//! tangents and further sets have no place in the format and are left out.

use super::{IoError, check, points::Points, srgb_from_linear};
use crate::mesh::{AttributeLayer, Mesh, Semantic};

/// Precision of the positions in a PLY file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PlyPositions {
    /// `float`, which every program reads.
    #[default]
    Single,
    /// `double`, bit-equal to the mesh; some programs refuse it.
    Double,
}

/// Writes the mesh.
///
/// # Errors
/// [`IoError::Unwritable`] for a mesh without triangles or one that breaks its invariants.
pub fn write_ply(mesh: &Mesh, precision: PlyPositions) -> Result<Vec<u8>, IoError> {
    check("PLY", mesh)?;
    let faces: Vec<u32> = (0..mesh.faces.len() as u32).collect();
    let points = Points::of(mesh, &faces);
    let layers: Vec<&AttributeLayer> = COLUMNS
        .iter()
        .filter_map(|c| mesh.layer(c.semantic).filter(|l| l.width == c.width))
        .collect();
    let mut file = header(&points, &layers, precision).into_bytes();
    let mut values: Vec<_> = layers.iter().map(|l| points.values(l)).collect();
    for position in points.positions(mesh) {
        for x in position.to_array() {
            match precision {
                PlyPositions::Single => file.extend_from_slice(&(x as f32).to_le_bytes()),
                PlyPositions::Double => file.extend_from_slice(&x.to_le_bytes()),
            }
        }
        for (layer, values) in layers.iter().zip(&mut values) {
            push_values(&mut file, layer.semantic, values.next().unwrap_or(&[]));
        }
    }
    for triangle in &points.triangles {
        file.push(3);
        file.extend(triangle.iter().flat_map(|i| i.to_le_bytes()));
    }
    Ok(file)
}

/// A layer that the format has properties for.
struct Column {
    semantic: Semantic,
    width: usize,
    properties: &'static str,
}

const COLUMNS: [Column; 3] = [
    Column {
        semantic: Semantic::Normal,
        width: 3,
        properties: "property float nx\nproperty float ny\nproperty float nz\n",
    },
    Column {
        semantic: Semantic::TexCoord(0),
        width: 2,
        properties: "property float s\nproperty float t\n",
    },
    Column {
        semantic: Semantic::Color(0),
        width: 4,
        properties: "property uchar red\nproperty uchar green\nproperty uchar blue\n\
                     property uchar alpha\n",
    },
];

fn header(points: &Points, layers: &[&AttributeLayer], precision: PlyPositions) -> String {
    let real = match precision {
        PlyPositions::Single => "float",
        PlyPositions::Double => "double",
    };
    let mut text = format!(
        "ply\nformat binary_little_endian 1.0\ncomment Lookalike {}\nelement vertex {}\n\
         property {real} x\nproperty {real} y\nproperty {real} z\n",
        env!("CARGO_PKG_VERSION"),
        points.len(),
    );
    for column in COLUMNS.iter().filter(|c| layers.iter().any(|l| l.semantic == c.semantic)) {
        text.push_str(column.properties);
    }
    let n_faces = points.triangles.len();
    text + &format!(
        "element face {n_faces}
property list uchar uint vertex_indices
end_header
"
    )
}

fn push_values(file: &mut Vec<u8>, semantic: Semantic, values: &[f32]) {
    let byte = |c: f32| (c.clamp(0.0, 1.0) * 255.0).round() as u8;
    match (semantic, values) {
        (Semantic::Color(_), [r, g, b, a]) => {
            file.extend([*r, *g, *b].map(|c| byte(srgb_from_linear(c))));
            file.push(byte(*a));
        }
        (Semantic::TexCoord(_), [u, v]) => {
            file.extend_from_slice(&u.to_le_bytes());
            file.extend_from_slice(&(1.0 - v).to_le_bytes());
        }
        _ => file.extend(values.iter().flat_map(|v| v.to_le_bytes())),
    }
}
