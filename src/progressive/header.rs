//! What the file says about itself.
//!
//! ```text
//! 8 bytes   89 4C 4B 50 4D 0D 0A 1A: 0x89 "LKPM" CR LF ^Z (text-mode copies damage it)
//! u32       version of the format, 2
//! u32       length of the header
//! header    JSON, UTF-8: the struct Header
//! u32       CRC-32 of all bytes before
//! body      images; sections: the parts, the coarsest mesh, blocks of records from coarse to fine, blocks of
//!           edits level by level
//! ```
//!
//! Integers are little endian. JSON, so that any program can list levels; the tables of blocks
//! say which parts of the body a level needs. Version 1 had no edits of levels, only a flag
//! `by_records_alone`. Textures, images and what materials say of them came within version 2, and so did parts: the
//! fields are optional, and a reader that does not know them finds the levels without.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::{
    error::ProgressiveError,
    images::{Blob, ImageEntry},
    reader::{ReadLimits, check_limit},
    replay::Replay,
    section::{IS_FUZZING, Section},
};
use crate::mesh::{Material, Mesh, Semantic, Texture, TextureUse};

const MAGIC: [u8; 8] = *b"\x89LKPM\r\n\x1a";
const VERSION: u32 = 2;
const MAX_HEADER_BYTES: u64 = 64 << 20;
/// What materials and textures may take of it.
const MAX_APPEARANCE_BYTES: usize = 32 << 20;

/// The header of a file. Counts without "base" are those of the original mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// Program and version that wrote the file.
    pub producer: String,
    /// Vertices of the original mesh.
    pub n_vertices: u32,
    /// Triangles of the original mesh.
    pub n_faces: u32,
    /// Wedges of the original mesh.
    pub n_wedges: u32,
    /// Wedges of the original mesh and those that records append.
    pub n_all_wedges: u32,
    /// Whether each triangle has a material of its own.
    pub has_face_materials: bool,
    /// Attribute layers.
    pub layers: Vec<Layer>,
    /// Materials.
    pub(super) materials: Vec<MaterialEntry>,
    /// What materials refer to.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) textures: Vec<Texture>,
    /// What textures refer to.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) images: Vec<ImageEntry>,
    /// The bytes of images.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) blobs: Vec<Blob>,
    /// Parts of triangles and their tree.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) parts: Option<Section>,
    /// Levels with names, fine to coarse.
    pub levels: Vec<Level>,
    /// Collapses.
    pub n_records: u32,
    /// Vertices of the coarsest level (those without triangles too).
    pub n_base_vertices: u32,
    /// Triangles of the coarsest level.
    pub n_base_faces: u32,
    /// Wedges stored with the coarsest level.
    pub n_base_wedges: u32,
    /// The coarsest mesh.
    pub base: Section,
    /// The records, coarse to fine.
    pub blocks: Vec<Block>,
}

/// An attribute layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layer {
    /// What the values mean.
    pub semantic: Semantic,
    /// Values per wedge.
    pub width: u32,
}

/// A level that the job was asked for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Level {
    /// For example `lod-0`.
    pub name: String,
    /// Triangles before edits.
    pub faces: u32,
    /// Vertices that triangles use, before edits.
    pub vertices: u32,
    /// Collapses applied to the original mesh.
    pub record: u32,
    /// Edits that follow the collapses in this level alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub edits: Option<LevelEdits>,
}

impl Level {
    /// Whether the collapses alone make the level; if not, their mesh is only where edits begin.
    pub fn is_by_records_alone(&self) -> bool {
        self.edits.is_none()
    }

    /// Triangles after all edits.
    pub fn n_final_faces(&self) -> u32 {
        self.edits.as_ref().map_or(self.faces, |edits| edits.faces)
    }

    /// Vertices that triangles use after all edits.
    pub fn n_final_vertices(&self) -> u32 {
        self.edits.as_ref().map_or(self.vertices, |edits| edits.vertices)
    }

    /// Edits after the collapses.
    pub fn n_edits(&self) -> u32 {
        self.edits.as_ref().map_or(0, |edits| edits.n_edits)
    }
}

/// The edits of one level.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LevelEdits {
    /// How many there are.
    pub n_edits: u32,
    /// Triangles after them.
    pub faces: u32,
    /// Vertices that triangles use after them.
    pub vertices: u32,
    /// The edits, in order.
    pub blocks: Vec<Block>,
}

/// Records or edits that are compressed together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Block {
    /// Number of records.
    pub n_records: u32,
    /// Triangles before the first of them is undone, or the first edit applied.
    pub n_faces: u32,
    /// Where they are.
    pub section: Section,
}

/// A material; the colour in double precision, whose decimal form rounds back to the same single.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct MaterialEntry {
    name: String,
    base_color: [f64; 4],
    double_sided: bool,
    unlit: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    base_texture: Option<TextureUse>,
    /// The glTF material, word for word.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    source: Option<serde_json::Value>,
}

impl MaterialEntry {
    /// `None` for numbers that are not finite, which JSON cannot hold.
    fn of(material: &Material) -> Option<Self> {
        let transform = material.base_texture.iter().flat_map(|t| t.transform.as_flattened());
        material.base_color.iter().chain(transform).all(|c| c.is_finite()).then(|| Self {
            name: material.name.clone(),
            base_color: material.base_color.map(f64::from),
            double_sided: material.double_sided,
            unlit: material.unlit,
            base_texture: material.base_texture,
            source: material.source.clone(),
        })
    }

    fn material(&self) -> Material {
        Material {
            name: self.name.clone(),
            base_color: self.base_color.map(|c| c as f32),
            base_texture: self.base_texture,
            double_sided: self.double_sided,
            unlit: self.unlit,
            source: self.source.clone(),
        }
    }

    /// The entries of a mesh's materials, which a reader can read again: the JSON of materials may
    /// come from anywhere.
    pub(super) fn all_of(mesh: &Mesh) -> Result<Vec<Self>, ProgressiveError> {
        let fault = |problem| ProgressiveError::Mesh { problem };
        let entries: Option<Vec<_>> = mesh.materials.iter().map(Self::of).collect();
        let entries = entries.ok_or(fault("a number of a material is not finite"))?;
        let json = json!({ "materials": entries, "textures": mesh.textures }).to_string();
        if json.len() > MAX_APPEARANCE_BYTES {
            return Err(fault("its materials and textures are over 32 MiB of JSON"));
        }
        match serde_json::from_str::<serde_json::Value>(&json) {
            Ok(_) => Ok(entries),
            Err(_) => Err(fault("the JSON of a material is nested too deep")),
        }
    }
}

impl Header {
    /// Signature, version, header and checksum.
    pub(super) fn to_bytes(&self) -> Result<Vec<u8>, ProgressiveError> {
        let failed = |problem: String| ProgressiveError::Compression { problem };
        let json = serde_json::to_vec(self).map_err(|e| failed(e.to_string()))?;
        let length = u32::try_from(json.len()).map_err(|e| failed(e.to_string()))?;
        let mut bytes = MAGIC.to_vec();
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend(length.to_le_bytes());
        bytes.extend(json);
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        Ok(bytes)
    }

    /// The header and the body of a file.
    pub(super) fn parse<'a>(
        bytes: &'a [u8],
        limits: &ReadLimits,
    ) -> Result<(Self, &'a [u8]), ProgressiveError> {
        if !bytes.starts_with(&MAGIC) {
            return Err(ProgressiveError::NotProgressive);
        }
        let truncated = |need: u64| ProgressiveError::Truncated {
            place: "header".to_owned(),
            need,
            have: bytes.len() as u64,
        };
        let word = |at: usize| {
            let four = bytes.get(at..at + 4).and_then(|b| b.try_into().ok());
            four.map(u32::from_le_bytes).ok_or_else(|| truncated(at as u64 + 4))
        };
        let version = word(8)?;
        if version != VERSION {
            return Err(ProgressiveError::Version { found: version, known: VERSION });
        }
        let length = word(12)?;
        check_limit("bytes of header", length.into(), MAX_HEADER_BYTES)?;
        let end = 16 + length as usize;
        let crc32 = word(end)?;
        let (head, body) = (&bytes[..end], &bytes[end + 4..]);
        if crc32fast::hash(head) != crc32 && !IS_FUZZING {
            return Err(ProgressiveError::Checksum { place: "header".to_owned() });
        }
        let header: Self = serde_json::from_slice(&head[16..]).map_err(|e| {
            ProgressiveError::Damaged { place: "header".to_owned(), problem: e.to_string() }
        })?;
        header.check(limits)?;
        Ok((header, body))
    }

    fn check(&self, limits: &ReadLimits) -> Result<(), ProgressiveError> {
        check_limit("triangles", self.n_faces.into(), limits.max_faces.into())?;
        check_limit("vertices", self.n_vertices.into(), limits.max_vertices.into())?;
        let width = self.layers.iter().map(|l| u64::from(l.width)).sum::<u64>();
        let n_values = width.saturating_mul(self.n_all_wedges.into());
        check_limit("attribute values", n_values, limits.max_attribute_values)?;
        let edits = || self.levels.iter().filter_map(|level| level.edits.as_ref());
        let blocks = self.blocks.iter().chain(edits().flat_map(|edits| &edits.blocks));
        for section in blocks.clone().map(|b| &b.section).chain([&self.base]).chain(&self.parts) {
            check_limit("bytes of a section", section.n_raw(), limits.max_section_bytes)?;
        }
        for edits in edits() {
            check_limit("edits of a level", edits.n_edits.into(), limits.max_edits.into())?;
        }
        let n_in = |blocks: &[Block]| blocks.iter().map(|b| u64::from(b.n_records)).sum::<u64>();
        let rules = [
            (self.layers.iter().all(|l| l.width > 0), "an attribute layer without values"),
            (self.layers.is_empty() == (self.n_all_wedges == 0), "wedges and layers disagree"),
            (self.n_base_faces <= self.n_faces, "the coarsest level has more triangles"),
            (self.n_base_vertices <= self.n_vertices, "the coarsest level has more vertices"),
            (self.n_base_wedges <= self.n_all_wedges, "the coarsest level has more wedges"),
            (self.n_wedges <= self.n_all_wedges, "the original mesh has more wedges than all"),
            (blocks.clone().all(|b| b.n_records > 0), "a block without records"),
            (n_in(&self.blocks) == u64::from(self.n_records), "the blocks hold other records"),
            (
                edits().all(|edits| n_in(&edits.blocks) == u64::from(edits.n_edits)),
                "the blocks of a level hold other edits",
            ),
        ];
        match rules.iter().find(|(holds, _)| !holds) {
            None => Ok(()),
            Some((_, problem)) => Err(ProgressiveError::Damaged {
                place: "header".to_owned(),
                problem: (*problem).to_owned(),
            }),
        }
    }

    /// A replay of the file's size with nothing in it but materials and textures.
    pub(super) fn blank_replay(&self) -> Replay {
        let (n_vertices, n_faces) = (self.n_vertices as usize, self.n_faces as usize);
        let width: usize = self.layers.iter().map(|l| l.width as usize).sum();
        let per_face = |wanted: bool| if wanted { n_faces } else { 0 };
        Replay {
            positions: vec![[0.0; 3]; n_vertices],
            is_vertex_alive: vec![false; n_vertices],
            faces: vec![[0; 3]; n_faces],
            face_wedges: vec![[0; 3]; per_face(!self.layers.is_empty())],
            is_face_alive: vec![false; n_faces],
            face_materials: vec![0; per_face(self.has_face_materials)],
            rings: super::rings::Rings::new(n_vertices, n_faces),
            wedge_values: vec![0.0; self.n_all_wedges as usize * width],
            n_wedges: self.n_all_wedges,
            n_original_wedges: self.n_wedges,
            layers: self.layers.iter().map(|l| (l.semantic, l.width as usize)).collect(),
            materials: self.materials.iter().map(MaterialEntry::material).collect(),
            textures: self.textures.clone(),
            images: Vec::new(),
            face_parts: Vec::new(),
            tree: Arc::default(),
            n_alive_faces: 0,
            n_alive_vertices: 0,
            n_edits: 0,
        }
    }
}
