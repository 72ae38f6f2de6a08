//! The texture coordinates and vertex colours that pictures show, as unknowns: each value once, however many corners
//! have it.
//!
//! Invariants:
//! 1. corners of a vertex that have the same value have one unknown, whatever their triangles, materials and wedges
//!    are: what hangs together on the texture does not tear. Corners of different values have different ones: a seam
//!    stays a seam;
//! 2. a texture coordinate has bounds: the range at the corners of the triangles around that have it. So coordinates
//!    stay within the range that those of the original had, and near their chart;
//! 3. colours stay within 0 and 1 (those beyond do not go further), and alpha is no unknown. Pictures of luminance say
//!    nothing of hues: a colour gets lighter or darker there, in the proportions that it has;
//! 4. unknowns are numbered by vertex, then by triangle: the order depends on the mesh alone.
//!
//! Normal maps and tangents that use the same coordinates are carried along, and not looked at.
//!
//! Measured at effort fast, 3% of the triangles, unseen d2 with textures by the independent evaluator, without and with
//! these unknowns: spot 15.69 and 15.04, fish 5.69 and 5.60, corset 7.44 and 7.22, torus 5.73 and 5.61, helmet 4.19 and
//! 4.04, frog (vertex colours) 3.26 and 3.06; one run each. The geometric mean is .966, for 1 to 16% more seconds. Where
//! a budget allows few descents it can be the other way: of 8 levels taken both ways fish at 10% gets worse (3.21 and
//! 3.30: the joint descents did not help and were taken back; steps of a tenth on the texture help those, not the end).

use std::sync::Arc;

use glam::DVec3;

use crate::{
    mesh::{AttributeLayer, Corner, EditMesh, FaceId, Semantic, VertexId, WedgeId},
    render::Scene,
};

use super::{
    appearance::Appearance,
    palette::Palette,
    slopes::{Drag, Slopes},
};

/// Linear colours none of whose numbers is greater have no hue that is seen.
const BLACK: f64 = 1.0 / 255.0;

/// A value that some corners of a vertex share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unknown {
    /// One of the corners.
    pub corner: Corner,
    /// The vertex.
    pub vertex: VertexId,
    /// The layer.
    pub semantic: Semantic,
    /// The value: u and v, or red, green and blue.
    pub at: DVec3,
    /// Least and greatest.
    pub bounds: [DVec3; 2],
    /// The direction, of length 1, in which alone it may move.
    pub way: Option<DVec3>,
    /// How far apart values are: on the texture, the mean length of its triangles' sides.
    pub reach: f64,
}

/// See the module.
#[derive(Clone, Debug)]
pub struct Attributes {
    appearance: Appearance,
    coordinates: Vec<Unknown>,
    colours: Vec<Unknown>,
    /// By triangle slot.
    faces: Vec<Dressed>,
}

/// What is unknown of a triangle: numbers of its corners' unknowns.
#[derive(Clone, Copy, Debug, Default)]
struct Dressed {
    material: u32,
    coordinates: Option<[u32; 3]>,
    colours: Option<[u32; 3]>,
}

impl Attributes {
    /// Those of a mesh that is shown with these textures.
    pub fn of(mesh: &EditMesh, palette: &Arc<Palette>) -> Self {
        let appearance = Appearance::of(mesh.mesh(), palette);
        let layers = &mesh.mesh().layers;
        let coordinates = |face: FaceId| {
            let at = appearance.painting(mesh.mesh(), face)?.1?;
            (layers[at].width == 2).then_some(at)
        };
        let at = layers.iter().position(|l| l.semantic == Semantic::Color(0) && l.width >= 3);
        let (coordinates, on_textures) = gather(mesh, coordinates);
        let (mut colours, of_colours) = gather(mesh, |_| at);
        if palette.metric().n_channels() == 1 {
            colours.iter_mut().for_each(Unknown::keep_hue);
        }
        let faces = (0..mesh.n_face_slots()).map(|f| Dressed {
            material: mesh.mesh().material_of(FaceId(f as u32)),
            coordinates: on_textures[f],
            colours: of_colours[f],
        });
        Self { faces: faces.collect(), appearance, coordinates, colours }
    }

    /// Texture coordinates, of those that pictures use.
    pub fn coordinates(&self) -> &[Unknown] {
        &self.coordinates
    }

    /// Vertex colours.
    pub fn colours(&self) -> &[Unknown] {
        &self.colours
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.coordinates.is_empty() && self.colours.is_empty()
    }

    /// Whether a triangle has texture coordinates that are unknown.
    pub(super) fn has_coordinates(&self, face: u32) -> bool {
        self.faces.get(face as usize).is_some_and(|f| f.coordinates.is_some())
    }

    /// Whether a triangle has vertex colours that are unknown.
    pub(super) fn has_colours(&self, face: u32) -> bool {
        self.faces.get(face as usize).is_some_and(|f| f.colours.is_some())
    }

    /// Shows other values in a scene of the mesh, one for each unknown.
    pub fn dress(&self, scene: &mut Scene, coordinates: &[DVec3], colours: &[DVec3]) {
        for (face, dressed) in scene.faces.iter_mut().zip(&self.faces) {
            let Some(surface) = face.as_mut().map(|face| &mut face.surface) else { continue };
            let painting = self.appearance.paint_of(dressed.material);
            if let (Some(paint), Some(painting), Some(numbers)) =
                (&mut surface.paint, painting, dressed.coordinates)
            {
                let value = |i: u32| coordinates[i as usize].as_vec3().to_array();
                paint.uv = numbers.map(|i| painting.place(&value(i)));
            }
            if let Some(numbers) = dressed.colours {
                let value = |i: u32| colours[i as usize].as_vec3().to_array();
                surface.albedo =
                    numbers.map(|i| self.appearance.albedo(&value(i), dressed.material));
            }
        }
    }

    /// Puts coordinates back round triangles that have turned over on their texture, until there are none: normal maps
    /// on the same coordinates would be seen inside out there.
    pub fn unfold(&self, coordinates: &mut [DVec3]) {
        let mut has_folds = true;
        while has_folds {
            has_folds = false;
            for numbers in self.faces.iter().filter_map(|f| f.coordinates) {
                let before = area(numbers.map(|i| self.coordinates[i as usize].at));
                let after = area(numbers.map(|i| coordinates[i as usize]));
                if before != 0.0 && (after == 0.0 || (before > 0.0) != (after > 0.0)) {
                    numbers.iter().for_each(|i| {
                        coordinates[*i as usize] = self.coordinates[*i as usize].at;
                    });
                    has_folds = true;
                }
            }
        }
    }

    /// Adds what the pixels of a triangle say in a view of a channel: what changes as its corners move on the texture,
    /// the other way, and slopes and bends by its corners' albedos.
    pub(super) fn add_up(
        &self,
        (face, channel): (u32, u8),
        turns: &[Drag; 3],
        by_albedo: [(f64, f64); 3],
        sum: &mut Slopes,
    ) {
        let Some(dressed) = self.faces.get(face as usize) else { return };
        let painting = self.appearance.paint_of(dressed.material);
        if let (Some(painting), Some(numbers)) = (painting, dressed.coordinates) {
            let axes = painting.turns().map(|axis| -axis);
            for (i, turn) in numbers.into_iter().zip(turns) {
                turn.add_to(&mut sum.coordinates[i as usize], axes);
            }
        }
        if let Some(numbers) = dressed.colours {
            let tint = self.appearance.tint(dressed.material, channel);
            for (i, (slope, bend)) in numbers.into_iter().zip(by_albedo) {
                sum.colours[i as usize].add(slope, bend, tint);
            }
        }
    }
}

/// Twice the area of a triangle on its texture, less than 0 where it is turned over.
fn area([a, b, c]: [DVec3; 3]) -> f64 {
    (b - a).truncate().perp_dot((c - a).truncate())
}

/// The values of the layers that triangles have, each once a vertex; and by triangle slot the numbers of its corners'.
fn gather(
    mesh: &EditMesh,
    layer_of: impl Fn(FaceId) -> Option<usize>,
) -> (Vec<Unknown>, Vec<Option<[u32; 3]>>) {
    let layers = &mesh.mesh().layers;
    let mut unknowns: Vec<Unknown> = Vec::new();
    let mut faces: Vec<Option<[u32; 3]>> = vec![None; mesh.n_face_slots()];
    for v in (0..mesh.n_vertex_slots() as u32).map(VertexId) {
        let first = unknowns.len();
        for &face in mesh.faces_around(v) {
            let Some(layer) = layer_of(face).map(|at| &layers[at]) else { continue };
            let Some(k) = mesh.vertices_of(face).iter().position(|w| *w == v) else { continue };
            let corner = Corner::new(face, k);
            let is_same = |u: &Unknown| {
                u.semantic == layer.semantic
                    && bits(layer, wedge(mesh, u.corner)).eq(bits(layer, wedge(mesh, corner)))
            };
            let known = unknowns[first..].iter().position(is_same);
            let number = known.map_or(unknowns.len(), |nth| first + nth);
            if known.is_none() {
                unknowns.push(Unknown::new(mesh, corner, layer));
            }
            faces[face.index()].get_or_insert([0; 3])[k] = number as u32;
        }
    }
    if unknowns.iter().any(|u| matches!(u.semantic, Semantic::TexCoord(_))) {
        confine(&mut unknowns, &faces);
    }
    (unknowns, faces)
}

fn wedge(mesh: &EditMesh, corner: Corner) -> WedgeId {
    mesh.wedges_of(corner.face())[corner.k()]
}

fn bits(layer: &AttributeLayer, wedge: WedgeId) -> impl Iterator<Item = u32> + '_ {
    layer.get(wedge).iter().map(|x| x.to_bits())
}

impl Unknown {
    fn new(mesh: &EditMesh, corner: Corner, layer: &AttributeLayer) -> Self {
        let mut at = DVec3::ZERO;
        let value = layer.get(wedge(mesh, corner));
        (at.as_mut().iter_mut()).zip(value).for_each(|(to, from)| *to = f64::from(*from));
        let vertex = mesh.vertices_of(corner.face())[corner.k()];
        let bounds = [at.min(DVec3::ZERO), at.max(DVec3::ONE)];
        Self { corner, vertex, semantic: layer.semantic, at, bounds, way: None, reach: 1.0 }
    }

    /// A colour keeps its hue; what is all but black has none, and gets grey.
    fn keep_hue(&mut self) {
        let hue = self.at.max(DVec3::ZERO);
        let way = if hue.max_element() < BLACK { DVec3::ONE } else { hue }.normalize_or_zero();
        let [low, high] = self.bounds;
        // So far down and up the first of its numbers comes to its bound.
        let reach = |to: DVec3| {
            let steps = (0..3).filter(|&k| way[k] > 0.0).map(|k| (to[k] - self.at[k]) / way[k]);
            steps.reduce(|a, b| if a.abs() < b.abs() { a } else { b }).unwrap_or_default()
        };
        self.bounds = [self.at + way * reach(low), self.at + way * reach(high)];
        self.way = Some(way);
    }
}

/// Sets the bounds of texture coordinates, and how far apart they are.
fn confine(unknowns: &mut [Unknown], faces: &[Option<[u32; 3]>]) {
    let places: Vec<DVec3> = unknowns.iter().map(|u| u.at).collect();
    let mut sides = vec![(0.0, 0.0); unknowns.len()];
    unknowns.iter_mut().for_each(|u| u.bounds = [u.at; 2]);
    for numbers in faces.iter().flatten() {
        for (own, other) in (0..3).flat_map(|k| [(k, (k + 1) % 3), (k, (k + 2) % 3)]) {
            let [own, other] = [numbers[own] as usize, numbers[other] as usize];
            let [low, high] = &mut unknowns[own].bounds;
            (*low, *high) = (low.min(places[other]), high.max(places[other]));
            sides[own].0 += places[own].distance(places[other]);
            sides[own].1 += 1.0;
        }
    }
    for (unknown, (sum, n)) in unknowns.iter_mut().zip(sides) {
        unknown.reach = sum / n;
    }
}
