//! What a triangle's light falls on: material colour times vertex colour as the albedo of its corners, in 8 bits
//! of luminance (or of red, green and blue), and the texture, which has in it what the material gives off.
//!
//! A model of one single colour is drawn white, as the papers do: then only its shape counts, and
//! it stands out against the grey background whatever its paint. Luminance of a vertex colour times that of a
//! texture stands for the luminance of their product, which is exact where one of them is grey.

use std::sync::Arc;

use glam::DVec3;

use crate::{
    mesh::{AttributeLayer, Collapse, Coverage, EditMesh, FaceId, Material, Mesh, Semantic},
    render::{Paint, Surface},
};

use super::{
    channels::Metric,
    palette::{Painting, Palette},
};

/// See the module.
#[derive(Clone, Debug, Default)]
pub struct Appearance {
    /// By wedge: channels of the vertex colour; empty when there are no colours.
    wedges: Vec<[f32; 3]>,
    /// By material; empty when the whole model is white.
    materials: Vec<[f32; 3]>,
    palette: Arc<Palette>,
}

impl Appearance {
    /// Of a mesh with its textures; all white when it has one plain material and no vertex colours.
    pub fn of(mesh: &Mesh, palette: &Arc<Palette>) -> Self {
        let mut this = Self { palette: palette.clone(), ..Self::default() };
        this.extend(mesh);
        if !is_white(mesh) {
            // A texture has the factor in it.
            let of_material = |(k, m): (u32, &Material)| match palette.painting(k) {
                Some(_) => [1.0; 3],
                None => this.channels(&m.base_color).map(|c| c.clamp(0.0, 1.0)),
            };
            let materials = (0..).zip(&mesh.materials).map(of_material).collect();
            this.materials = materials;
        }
        this
    }

    /// Takes in wedges that were appended since, and forgets those that an undo removed.
    pub fn extend(&mut self, mesh: &Mesh) {
        self.wedges.truncate(mesh.n_wedges());
        if let Some(layer) = mesh.layer(Semantic::Color(0)) {
            let known = self.wedges.len() * layer.width;
            let rest = layer.values.get(known..).unwrap_or_default();
            let metric = self.palette.metric();
            self.wedges.extend(rest.chunks_exact(layer.width.max(1)).map(|c| metric.channels(c)));
        }
    }

    /// Of an RGB(A) vector; white when it is too short to be one.
    fn channels(&self, colour: &[f32]) -> [f32; 3] {
        self.palette.metric().channels(colour)
    }

    /// The surface of a triangle.
    pub fn of_face(&self, mesh: &Mesh, face: FaceId) -> Surface {
        let material = mesh.materials.get(mesh.material_of(face) as usize);
        let is_unlit = material.is_some_and(|m| m.unlit);
        let is_single_sided = material.is_some_and(|m| !m.double_sided);
        let Some(wedges) = mesh.face_wedges.get(face.index()) else {
            let plain = self.painting(mesh, face).filter(|(_, at)| at.is_none());
            let paint = plain.map(|(painting, _)| Paint { map: painting.map, uv: [[0.0; 2]; 3] });
            let albedo = [self.bytes([1.0; 3], mesh.material_of(face)); 3];
            return Surface { albedo, paint, is_unlit, is_single_sided };
        };
        let colour = |w: u32| self.wedges.get(w as usize).copied().unwrap_or([1.0; 3]);
        let albedo = wedges.map(|w| self.bytes(colour(w), mesh.material_of(face)));
        let paint = self.painting(mesh, face).map(|(painting, at)| {
            let place = |w: u32| {
                let Some(layer) = at.map(|at| &mesh.layers[at]) else { return [0.0; 2] };
                let start = w as usize * layer.width;
                painting.place(layer.values.get(start..start + layer.width).unwrap_or_default())
            };
            Paint { map: painting.map, uv: wedges.map(place) }
        });
        Surface { albedo, paint, is_unlit, is_single_sided }
    }

    /// The surface of a surviving triangle after a planned collapse.
    pub fn of_face_after(&self, mesh: &EditMesh, plan: &Collapse, face: FaceId) -> Surface {
        let mut surface = self.of_face(mesh.mesh(), face);
        for r in plan.rewedged.iter().filter(|r| r.corner.face() == face) {
            let nth = (r.to.0 - plan.first_new_wedge.0) as usize;
            self.set_corner(&mut surface, r.corner.k(), (mesh, face), (&plan.new_wedges, nth));
        }
        surface
    }

    /// Gives corner `k` of the surface of `face` the `nth` of the wedges that a planned edit appends.
    pub fn set_corner(
        &self,
        surface: &mut Surface,
        k: usize,
        (mesh, face): (&EditMesh, FaceId),
        (values, nth): (&[f32], usize),
    ) {
        let layers = &mesh.mesh().layers;
        if !self.wedges.is_empty() {
            let at = layers.iter().position(|l| l.semantic == Semantic::Color(0));
            if let Some(colour) = at.and_then(|at| new_wedge_value(layers, values, (nth, at))) {
                surface.albedo[k] = self.albedo(colour, mesh.mesh().material_of(face));
            }
        }
        let painting = self.painting(mesh.mesh(), face);
        if let (Some((painting, Some(at))), Some(paint)) = (painting, &mut surface.paint)
            && let Some(uv) = new_wedge_value(layers, values, (nth, at))
        {
            paint.uv[k] = painting.place(uv);
        }
    }

    /// What a triangle is painted with, and the layer of the coordinates where it needs some.
    pub(super) fn painting(&self, mesh: &Mesh, face: FaceId) -> Option<(&Painting, Option<usize>)> {
        let painting = self.palette.painting(mesh.material_of(face))?;
        let Some(set) = painting.tex_coord else { return Some((painting, None)) };
        let semantic = Semantic::TexCoord(set);
        Some((painting, Some(mesh.layers.iter().position(|l| l.semantic == semantic)?)))
    }

    /// What a material is painted with, wherever its coordinates are from.
    pub(super) fn paint_of(&self, material: u32) -> Option<&Painting> {
        self.palette.painting(material)
    }

    /// The albedo of a corner with a vertex colour.
    pub(super) fn albedo(&self, colour: &[f32], material: u32) -> [u8; 3] {
        self.bytes(self.channels(colour), material)
    }

    /// How the albedo of a channel changes with red, green and blue of the vertex colour.
    pub(super) fn tint(&self, material: u32, channel: u8) -> DVec3 {
        let channel = usize::from(channel);
        let weights = self.palette.metric().weights().get(channel).copied().unwrap_or_default();
        DVec3::from_array(weights) * f64::from(255.0 * self.channels_of(material)[channel.min(2)])
    }

    fn channels_of(&self, material: u32) -> [f32; 3] {
        self.materials.get(material as usize).copied().unwrap_or([1.0; 3])
    }

    fn bytes(&self, vertex: [f32; 3], material: u32) -> [u8; 3] {
        let material = self.channels_of(material);
        let byte = |c: usize| ((vertex[c] * material[c]).clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        match self.palette.metric() {
            Metric::Luminance | Metric::Perceptual => [byte(0); 3],
            Metric::Rgb => [0, 1, 2].map(byte),
        }
    }
}

/// Whether a mesh is drawn white: it has one colour, no vertex colours and no texture, lets nothing
/// through, is lit, and gives nothing off.
pub fn is_white(mesh: &Mesh) -> bool {
    let first = mesh.materials.first().map(|m| m.base_color);
    let is_plain = |m: &Material| {
        Some(m.base_color) == first
            && m.base_texture.is_none()
            && m.coverage() == Coverage::Opaque
            && !m.unlit
            && m.emission().is_none()
    };
    mesh.materials.iter().all(is_plain) && mesh.layer(Semantic::Color(0)).is_none()
}

/// The values of layer `at` of the `nth` wedge that an edit appends.
fn new_wedge_value<'a>(
    layers: &[AttributeLayer],
    values: &'a [f32],
    (nth, at): (usize, usize),
) -> Option<&'a [f32]> {
    let stride: usize = layers.iter().map(|l| l.width).sum();
    let offset: usize = layers[..at].iter().map(|l| l.width).sum();
    let start = nth * stride + offset;
    values.get(start..start + layers[at].width)
}
