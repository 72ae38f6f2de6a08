//! GLB (glTF 2.0), valid by the rules of the Khronos validator.
//!
//! One primitive per material that faces use, in the order of materials; within it the faces keep
//! their order. Each accessor has a buffer view of its own, in the order indices, positions,
//! attributes; images follow (`appearance`). What glTF demands is put right on the way: normals and
//! tangents are brought to length 1, colours into 0..=1, texture-coordinate and colour sets are
//! numbered without gaps. Custom layers of up to four values are written as `_CUSTOM_n`.

use glam::{DVec3, Vec3};
use serde_json::{Value, json};

use super::{IoError, appearance::Appearance, check, points::Points};
use crate::{
    io::weld::{area_normals, unit_or_z},
    mesh::{AttributeLayer, FaceId, Mesh, Semantic},
};

const ARRAY_BUFFER: u32 = 34_962;
const ELEMENT_ARRAY_BUFFER: u32 = 34_963;
const UNSIGNED_SHORT: u32 = 5_123;
const UNSIGNED_INT: u32 = 5_125;
const FLOAT: u32 = 5_126;
/// How far from 1 a squared length may be and still count as unit (single precision rounds).
const UNIT_TOLERANCE: f32 = 1e-5;

/// Writes the mesh as one node with one mesh.
///
/// # Errors
/// [`IoError::Unwritable`] for a mesh without triangles, one that breaks its invariants, or one
/// over the 4 GiB of the format.
pub fn write_glb(mesh: &Mesh) -> Result<Vec<u8>, IoError> {
    check("GLB", mesh)?;
    let mut file = Builder::default();
    let mut faces_of_material = vec![Vec::new(); mesh.materials.len().max(1)];
    for face in 0..mesh.faces.len() as u32 {
        faces_of_material[mesh.material_of(FaceId(face)) as usize].push(face);
    }
    let used = faces_of_material.iter().enumerate().filter(|(_, faces)| !faces.is_empty());
    let primitives: Vec<Value> =
        used.map(|(material, faces)| file.primitive(mesh, material, faces)).collect();
    let appearance = Appearance::of(mesh, &mut |bytes| file.view(bytes, None));
    let document = file.document(&primitives, appearance);
    pack(document.to_string().into_bytes(), &file.bin)
}

/// The binary chunk and the tables that describe it.
#[derive(Default)]
struct Builder {
    bin: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Builder {
    fn primitive(&mut self, mesh: &Mesh, material: usize, faces: &[u32]) -> Value {
        let points = Points::of(mesh, faces);
        let indices = self.indices(&points);
        let mut attributes = serde_json::Map::new();
        attributes.insert("POSITION".to_owned(), self.positions(mesh, &points).into());
        let mut sets = [0, 0];
        for layer in sorted_layers(mesh) {
            let name = match layer.semantic {
                Semantic::Normal => "NORMAL".to_owned(),
                Semantic::Tangent => "TANGENT".to_owned(),
                Semantic::TexCoord(_) => numbered("TEXCOORD", &mut sets[0]),
                Semantic::Color(_) => numbered("COLOR", &mut sets[1]),
                Semantic::Custom(id) => format!("_CUSTOM_{id}"),
            };
            let values = file_values(layer, mesh, &points);
            if let Some(accessor) = self.attribute(&values, layer.width, points.len()) {
                attributes.insert(name, accessor.into());
            }
        }
        let mut primitive = json!({ "attributes": attributes, "indices": indices, "mode": 4 });
        if !mesh.materials.is_empty() {
            primitive["material"] = material.into();
        }
        primitive
    }

    /// 16-bit indices where they suffice; 65,535 is reserved for restarts.
    fn indices(&mut self, points: &Points) -> usize {
        let flat = points.triangles.iter().flatten();
        let (component, bytes): (u32, Vec<u8>) = if u16::try_from(points.len()).is_ok() {
            (UNSIGNED_SHORT, flat.flat_map(|i| (*i as u16).to_le_bytes()).collect())
        } else {
            (UNSIGNED_INT, flat.flat_map(|i| i.to_le_bytes()).collect())
        };
        let accessor = json!({
            "bufferView": self.view(&bytes, Some(ELEMENT_ARRAY_BUFFER)),
            "componentType": component,
            "count": points.triangles.len() * 3,
            "type": "SCALAR",
        });
        self.push_accessor(accessor)
    }

    fn positions(&mut self, mesh: &Mesh, points: &Points) -> usize {
        let positions: Vec<Vec3> = points.positions(mesh).map(|p: DVec3| p.as_vec3()).collect();
        let first = positions.first().copied().unwrap_or(Vec3::ZERO);
        let (min, max) =
            positions.iter().fold((first, first), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
        let values: Vec<f32> = positions.iter().flat_map(Vec3::to_array).collect();
        let accessor = json!({
            "bufferView": self.view(bytemuck::cast_slice(&values), Some(ARRAY_BUFFER)),
            "componentType": FLOAT,
            "count": points.len(),
            "type": "VEC3",
            "min": min.to_array(),
            "max": max.to_array(),
        });
        self.push_accessor(accessor)
    }

    /// `None` for a width that glTF has no type for.
    fn attribute(&mut self, values: &[f32], width: usize, count: usize) -> Option<usize> {
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"].get(width.checked_sub(1)?)?;
        let accessor = json!({
            "bufferView": self.view(bytemuck::cast_slice(values), Some(ARRAY_BUFFER)),
            "componentType": FLOAT,
            "count": count,
            "type": kind,
        });
        Some(self.push_accessor(accessor))
    }

    /// Images have no target.
    fn view(&mut self, bytes: &[u8], target: Option<u32>) -> usize {
        let offset = self.bin.len();
        self.bin.extend_from_slice(bytes);
        // Views begin at multiples of four; the padding belongs to no view.
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let mut view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.views.push(view);
        self.views.len() - 1
    }

    fn push_accessor(&mut self, accessor: Value) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn document(&self, primitives: &[Value], appearance: Appearance) -> Value {
        let generator = concat!("Lookalike ", env!("CARGO_PKG_VERSION"));
        let mut document = json!({
            "asset": { "version": "2.0", "generator": generator },
            "scene": 0,
            "scenes": [{ "nodes": [0] }],
            "nodes": [{ "mesh": 0 }],
            "meshes": [{ "primitives": primitives }],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{ "byteLength": self.bin.len() }],
        });
        appearance.put_into(&mut document);
        document
    }
}

/// Layers in ascending order of their sets, so that numbering without gaps keeps the order.
fn sorted_layers(mesh: &Mesh) -> Vec<&AttributeLayer> {
    let mut layers: Vec<_> = mesh.layers.iter().collect();
    layers.sort_by_key(|l| match l.semantic {
        Semantic::TexCoord(set) | Semantic::Color(set) => set,
        _ => 0,
    });
    layers
}

fn numbered(stem: &str, next: &mut u32) -> String {
    *next += 1;
    format!("{stem}_{}", *next - 1)
}

/// The values of a layer at each point, as glTF allows them.
fn file_values(layer: &AttributeLayer, mesh: &Mesh, points: &Points) -> Vec<f32> {
    let mut values: Vec<f32> = points.values(layer).flatten().copied().collect();
    match (layer.semantic, layer.width) {
        (Semantic::Normal, 3) => {
            let instead = point_normals(mesh, points, &values);
            make_unit(&mut values, &instead);
        }
        (Semantic::Tangent, 4) => {
            for t in values.as_chunks_mut::<4>().0 {
                let [x, y, z, w] = *t;
                let [x, y, z] = unit([x, y, z]).unwrap_or([1.0, 0.0, 0.0]);
                *t = [x, y, z, if w < 0.0 { -1.0 } else { 1.0 }];
            }
        }
        (Semantic::Color(_), _) => values.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0)),
        _ => {}
    }
    values
}

/// Area-weighted normals of the points, computed only where a stored one has no direction.
fn point_normals(mesh: &Mesh, points: &Points, normals: &[f32]) -> Vec<DVec3> {
    if normals.as_chunks().0.iter().all(|n| unit(*n).is_some()) {
        return Vec::new();
    }
    let positions: Vec<DVec3> = points.positions(mesh).collect();
    area_normals(&positions, &points.triangles)
}

fn make_unit(normals: &mut [f32], instead: &[DVec3]) {
    for (i, n) in normals.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        *n = unit(*n)
            .unwrap_or_else(|| unit_or_z(instead.get(i).copied().unwrap_or(DVec3::Z)).to_array());
    }
}

/// `v` at length 1; unchanged where it is that already, so that reading and writing again changes
/// nothing.
fn unit(v: [f32; 3]) -> Option<[f32; 3]> {
    let vector = Vec3::from_array(v);
    if (vector.length_squared() - 1.0).abs() < UNIT_TOLERANCE {
        return Some(v);
    }
    vector.as_dvec3().try_normalize().map(|u| u.as_vec3().to_array())
}

/// Header, JSON chunk padded with spaces, binary chunk padded with zeros.
fn pack(mut json: Vec<u8>, bin: &[u8]) -> Result<Vec<u8>, IoError> {
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + json.len() + 8 + bin.len();
    let word = |n: usize| {
        u32::try_from(n).map(u32::to_le_bytes).map_err(|_| IoError::Unwritable {
            format: "GLB",
            problem: format!("{total} bytes are over the 4 GiB of the format"),
        })
    };
    let mut file = Vec::with_capacity(total);
    file.extend_from_slice(b"glTF\x02\0\0\0");
    file.extend_from_slice(&word(total)?);
    file.extend_from_slice(&word(json.len())?);
    file.extend_from_slice(b"JSON");
    file.append(&mut json);
    file.extend_from_slice(&word(bin.len())?);
    file.extend_from_slice(b"BIN\0");
    file.extend_from_slice(bin);
    Ok(file)
}
