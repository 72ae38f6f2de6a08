//! Indexed triangle mesh with wedge attributes: what files are read into and written from.
//!
//! A *vertex* is a position in space. A *wedge* is one attribute vector (normal, texture
//! coordinates, colour, …) attached to a vertex; corners of faces that share both vertex and
//! attributes share the wedge (Hoppe 1996). A mesh without attribute layers has no wedges.
//!
//! Invariants of a [`Mesh`]:
//! 1. every index in `faces` is below `positions.len()`, all positions are finite;
//! 2. the three vertices of a face are distinct;
//! 3. `face_wedges` is empty when `layers` is empty, else as long as `faces`, and every index
//!    is below `n_wedges()`;
//! 4. every layer holds `n_wedges() * width` values;
//! 5. `face_materials` is empty (all faces use material 0) or as long as `faces`;
//! 6. textures of materials and images of textures that are out of range count as absent;
//! 7. `face_parts` is empty (all faces are of part 0) or as long as `faces`, and every index is
//!    below `n_parts()`; nodes that are out of range count as nameless, at the top.

use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{
    error::{MAX_FACES, MeshError},
    parts::Tree,
};

/// Index of a vertex. Ids are stable: an edit never renumbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct VertexId(pub u32);

/// Index of a triangle. Ids are stable: an edit never renumbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct FaceId(pub u32);

/// Index of a wedge (an attribute vector that belongs to one vertex).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct WedgeId(pub u32);

/// Index of an undirected edge in an edge table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct EdgeId(pub u32);

/// One corner of one triangle: `3 * face + k`, k in 0..3.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Corner(pub u32);

impl VertexId {
    /// As an index into per-vertex arrays.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}
impl FaceId {
    /// As an index into per-face arrays.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}
impl WedgeId {
    /// As an index into per-wedge arrays.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}
impl EdgeId {
    /// As an index into per-edge arrays.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}
impl Corner {
    /// The corner `k` (0..3) of `face`.
    pub fn new(face: FaceId, k: usize) -> Self {
        Self(face.0 * 3 + k as u32)
    }
    /// The triangle it belongs to.
    pub fn face(self) -> FaceId {
        FaceId(self.0 / 3)
    }
    /// Which of the triangle's three corners it is.
    pub fn k(self) -> usize {
        (self.0 % 3) as usize
    }
}

/// What an attribute layer means, as glTF names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Semantic {
    /// Unit normal, 3 values.
    Normal,
    /// Tangent with handedness, 4 values.
    Tangent,
    /// Texture coordinates of the given set, 2 values.
    TexCoord(u32),
    /// Linear colour of the given set, 4 values (RGBA).
    Color(u32),
    /// What moves a vertex in a skin ([`super::skin`]), 8 values.
    Skin,
    /// An application-specific scalar or vector, kept and interpolated.
    Custom(u32),
}

/// One attribute of every wedge, `width` values each, wedge after wedge.
#[derive(Clone, Debug, PartialEq)]
pub struct AttributeLayer {
    /// What the values mean.
    pub semantic: Semantic,
    /// Values per wedge.
    pub width: usize,
    /// `n_wedges * width` values.
    pub values: Vec<f32>,
}

impl AttributeLayer {
    /// The `width` values of one wedge.
    pub fn get(&self, wedge: WedgeId) -> &[f32] {
        let at = wedge.index() * self.width;
        &self.values[at..at + self.width]
    }
}

/// How a texture goes on beyond its edges.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Wrap {
    /// Again and again.
    #[default]
    Repeat,
    /// Again and again, every other time reversed.
    Mirror,
    /// The edge's colour.
    Clamp,
}

/// A picture, as the file has it and as it is drawn.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Image {
    /// Name in the source file, may be empty.
    pub name: String,
    /// Media type, such as `image/png`.
    pub mime: String,
    /// The encoded bytes, untouched.
    pub bytes: Arc<[u8]>,
    /// Decoded, where the image is seen in pictures.
    pub pixels: Option<Arc<Pixels>>,
}

/// A decoded image.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Pixels {
    /// Columns, at least 1.
    pub width: u32,
    /// Rows, at least 1.
    pub height: u32,
    /// `4 * width * height` bytes, row by row from the top: red, green, blue, alpha, as encoded
    /// (not linear).
    pub rgba: Vec<u8>,
}

/// An image and how it is sampled.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Texture {
    /// Name in the source file, may be empty.
    pub name: String,
    /// Index into [`Mesh::images`]; `None` where an extension names an image that is not read.
    pub image: Option<u32>,
    /// The image for programs that cannot read the other one (WebP, KTX2), not drawn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fallback: Option<u32>,
    /// Beyond the edges, rightwards and downwards.
    pub wrap: [Wrap; 2],
    /// glTF's magnification and minification filters, which pictures ignore.
    pub filters: [Option<u32>; 2],
}

/// A texture on a surface.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TextureUse {
    /// Index into [`Mesh::textures`].
    pub texture: u32,
    /// Which set of coordinates ([`Semantic::TexCoord`]).
    pub tex_coord: u32,
    /// Where coordinates (u, v) look: rows `a u + b v + c` (KHR_texture_transform).
    pub transform: [[f32; 3]; 2],
}

impl TextureUse {
    /// No transform.
    pub const IDENTITY: [[f32; 3]; 2] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
}

/// How much of a surface is there.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Coverage {
    /// All of it, whatever alpha says.
    #[default]
    Opaque,
    /// Where alpha (factor × texture) is at least this.
    Mask(f32),
    /// As large a share as alpha says.
    Blend,
}

/// Surface appearance of a set of faces.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Material {
    /// Name in the source file, may be empty.
    pub name: String,
    /// Linear RGBA factor.
    pub base_color: [f32; 4],
    /// Multiplies the factor.
    pub base_texture: Option<TextureUse>,
    /// Whether back faces are drawn.
    pub double_sided: bool,
    /// Drawn without lighting.
    pub unlit: bool,
    /// The glTF material that this was read from, word for word: what is not modelled here is
    /// written as it was read. Its texture indices are those of [`Mesh::textures`].
    pub source: Option<serde_json::Value>,
}

impl Default for Material {
    fn default() -> Self {
        Self {
            name: String::new(),
            base_color: [1.0; 4],
            base_texture: None,
            double_sided: true,
            unlit: false,
            source: None,
        }
    }
}

/// Indexed triangle mesh with wedge attributes. See the module's invariants.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Vertex positions, model space.
    pub positions: Vec<DVec3>,
    /// Vertex indices of each triangle, counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
    /// Wedge indices of each triangle's corners; empty when there are no layers.
    pub face_wedges: Vec<[u32; 3]>,
    /// Material of each triangle; empty when all use material 0.
    pub face_materials: Vec<u32>,
    /// Attribute layers, all of the same number of wedges.
    pub layers: Vec<AttributeLayer>,
    /// Materials; may be empty (then faces are drawn white).
    pub materials: Vec<Material>,
    /// What materials refer to.
    pub textures: Vec<Texture>,
    /// What textures refer to.
    pub images: Vec<Image>,
    /// Part of each triangle; empty when all are of part 0. A triangle never changes its part.
    pub face_parts: Vec<u32>,
    /// Names and places of the parts.
    pub tree: Arc<Tree>,
}

impl Mesh {
    /// A mesh of positions and triangles alone.
    pub fn from_parts(positions: Vec<DVec3>, faces: Vec<[u32; 3]>) -> Self {
        Self { positions, faces, ..Self::default() }
    }

    /// Number of wedges (0 without attribute layers).
    pub fn n_wedges(&self) -> usize {
        self.layers.first().map_or(0, |l| l.values.len() / l.width.max(1))
    }

    /// Material index of a face.
    pub fn material_of(&self, face: FaceId) -> u32 {
        self.face_materials.get(face.index()).copied().unwrap_or(0)
    }

    /// Index of a face's part.
    pub fn part_of(&self, face: FaceId) -> u32 {
        self.face_parts.get(face.index()).copied().unwrap_or(0)
    }

    /// Number of parts; 1 without a tree.
    pub fn n_parts(&self) -> usize {
        self.tree.parts.len().max(1)
    }

    /// Triangles of each part.
    pub fn part_sizes(&self) -> Vec<u32> {
        let mut sizes = vec![0; self.n_parts()];
        (0..self.faces.len() as u32).for_each(|f| sizes[self.part_of(FaceId(f)) as usize] += 1);
        sizes
    }

    /// The layer of the given meaning, if the mesh has it.
    pub fn layer(&self, semantic: Semantic) -> Option<&AttributeLayer> {
        self.layers.iter().find(|l| l.semantic == semantic)
    }

    /// Checks invariants 1 to 5 and 7; O(triangles).
    pub fn check(&self) -> Result<(), MeshError> {
        let (faces, vertices) = (self.faces.len(), self.positions.len());
        if faces > MAX_FACES || vertices > MAX_FACES {
            return Err(MeshError::TooLarge { faces, vertices });
        }
        if let Some(vertex) = self.positions.iter().position(|p| !p.is_finite()) {
            return Err(MeshError::NotFinite { vertex });
        }
        for (face, corners) in self.faces.iter().enumerate() {
            check_face(face, *corners, vertices)?;
        }
        self.check_attributes()
    }

    fn check_attributes(&self) -> Result<(), MeshError> {
        let n_wedges = self.n_wedges();
        let n_corners = if self.layers.is_empty() { 0 } else { self.faces.len() };
        check_length("the wedge list", self.face_wedges.len(), n_corners)?;
        if !self.face_materials.is_empty() {
            check_length("the material list", self.face_materials.len(), self.faces.len())?;
        }
        if !self.face_parts.is_empty() {
            check_length("the part list", self.face_parts.len(), self.faces.len())?;
        }
        let n_parts = self.n_parts();
        let mut parts = self.face_parts.iter().copied().enumerate();
        if let Some((face, part)) = parts.find(|(_, part)| *part as usize >= n_parts) {
            return Err(MeshError::PartOutOfRange { face, part, n_parts });
        }
        for layer in &self.layers {
            check_length("an attribute layer", layer.values.len(), n_wedges * layer.width)?;
        }
        for (face, wedges) in self.face_wedges.iter().enumerate() {
            if let Some(&wedge) = wedges.iter().find(|&&w| w as usize >= n_wedges) {
                return Err(MeshError::WedgeOutOfRange { face, wedge, n_wedges });
            }
        }
        Ok(())
    }
}

fn check_face(face: usize, corners: [u32; 3], n_vertices: usize) -> Result<(), MeshError> {
    if let Some(&vertex) = corners.iter().find(|&&v| v as usize >= n_vertices) {
        return Err(MeshError::VertexOutOfRange { face, vertex, n_vertices });
    }
    let [a, b, c] = corners;
    match (a == b || a == c, b == c) {
        (false, false) => Ok(()),
        (a_twice, _) => {
            Err(MeshError::RepeatedVertex { face, vertex: if a_twice { a } else { b } })
        }
    }
}

fn check_length(what: &'static str, len: usize, expected: usize) -> Result<(), MeshError> {
    if len == expected { Ok(()) } else { Err(MeshError::WrongLength { what, len, expected }) }
}
