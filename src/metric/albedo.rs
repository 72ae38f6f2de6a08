//! Albedo luminance of corners: material colour times vertex colour, in 8 bits.
//!
//! A model of one single colour is drawn white, as the papers do: then only its shape counts, and
//! it stands out against the grey background whatever its paint. Colours are linear (glTF).

use crate::mesh::{AttributeLayer, Collapse, EditMesh, FaceId, Material, Mesh, Semantic};

use super::image;

/// Luminance of an RGB(A) vector; white when it is too short to be one.
fn luminance(colour: &[f32]) -> f32 {
    match colour {
        [r, g, b, ..] => image::luminance([*r, *g, *b]),
        _ => 1.0,
    }
}

/// Albedo tables of a mesh.
#[derive(Clone, Debug, Default)]
pub struct Albedo {
    /// By wedge: luminance of the vertex colour; empty when there are no colours.
    wedges: Vec<f32>,
    /// By material; empty when the whole model is white.
    materials: Vec<f32>,
}

impl Albedo {
    /// Tables of a mesh; all white when it has one material and no vertex colours.
    pub fn of(mesh: &Mesh) -> Self {
        let mut albedo = Self::default();
        albedo.extend(mesh);
        let first = mesh.materials.first().map(|m| m.base_color);
        let is_uniform = mesh.materials.iter().all(|m| Some(m.base_color) == first);
        if !is_uniform || !albedo.wedges.is_empty() {
            let of_material = |m: &Material| luminance(&m.base_color).clamp(0.0, 1.0);
            albedo.materials = mesh.materials.iter().map(of_material).collect();
        }
        albedo
    }

    /// Whether the whole model is white.
    pub fn is_white(&self) -> bool {
        self.materials.is_empty() && self.wedges.is_empty()
    }

    /// Takes in wedges that were appended since, and forgets those that an undo removed.
    pub fn extend(&mut self, mesh: &Mesh) {
        self.wedges.truncate(mesh.n_wedges());
        if let Some(layer) = mesh.layer(Semantic::Color(0)) {
            let known = self.wedges.len() * layer.width;
            let rest = layer.values.get(known..).unwrap_or_default();
            self.wedges.extend(rest.chunks_exact(layer.width.max(1)).map(luminance));
        }
    }

    /// Corner albedos of a triangle.
    pub fn of_face(&self, mesh: &Mesh, face: FaceId) -> [u8; 3] {
        let Some(wedges) = mesh.face_wedges.get(face.index()) else {
            return [self.byte(1.0, mesh, face); 3];
        };
        wedges.map(|w| self.byte(self.wedges.get(w as usize).copied().unwrap_or(1.0), mesh, face))
    }

    /// Corner albedos of a surviving triangle after a planned collapse.
    pub fn of_face_after(&self, mesh: &EditMesh, plan: &Collapse, face: FaceId) -> [u8; 3] {
        let mut albedo = self.of_face(mesh.mesh(), face);
        if self.wedges.is_empty() {
            return albedo;
        }
        for r in plan.rewedged.iter().filter(|r| r.corner.face() == face) {
            let nth = (r.to.0 - plan.first_new_wedge.0) as usize;
            if let Some(byte) = self.of_new_wedge(mesh, &plan.new_wedges, nth, face) {
                albedo[r.corner.k()] = byte;
            }
        }
        albedo
    }

    /// Albedo at a corner of `face` whose wedge is the `nth` of `values`, the wedges that a
    /// planned edit appends; `None` when the mesh has no colours.
    pub fn of_new_wedge(
        &self,
        mesh: &EditMesh,
        values: &[f32],
        nth: usize,
        face: FaceId,
    ) -> Option<u8> {
        let colour = new_wedge_colour(&mesh.mesh().layers, values, nth)?;
        Some(self.byte(luminance(colour), mesh.mesh(), face))
    }

    fn byte(&self, vertex_luminance: f32, mesh: &Mesh, face: FaceId) -> u8 {
        let material = mesh.material_of(face) as usize;
        let material = self.materials.get(material).copied().unwrap_or(1.0);
        ((vertex_luminance * material).clamp(0.0, 1.0) * 255.0 + 0.5) as u8
    }
}

/// The colour values of the `nth` wedge that a collapse appends.
fn new_wedge_colour<'a>(
    layers: &[AttributeLayer],
    values: &'a [f32],
    nth: usize,
) -> Option<&'a [f32]> {
    let stride: usize = layers.iter().map(|l| l.width).sum();
    let at = layers.iter().position(|l| l.semantic == Semantic::Color(0))?;
    let offset: usize = layers[..at].iter().map(|l| l.width).sum();
    let start = nth * stride + offset;
    values.get(start..start + layers[at].width)
}
