//! Records as they happen, fine to coarse, into a file that reads coarse to fine.
//!
//! The writer keeps the mesh at its present level and the records so far as bytes, about 50 bytes
//! per original triangle each. At the end it walks back from the coarsest mesh to the original and
//! codes each record against the mesh that it refines. (The edits of levels: `writer_edits`.)

use super::{
    ProgressiveError,
    base::{code_mesh, code_wedges},
    error::Damage,
    header::{Block, Header, Layer, Level, MaterialEntry},
    images::put_images,
    linked,
    log::RecordLog,
    parts::put_parts,
    replay::Replay,
    section::{Section, Streams},
    writer_edits::{EditedLevels, fingerprint},
};
use crate::mesh::{Collapse, Mesh};

/// Records in a block: enough to compress well, few enough that a level wastes little.
pub(super) const BLOCK_RECORDS: u32 = 4096;
/// A block ends at this size too (long rings).
pub(super) const BLOCK_BYTES: usize = 1 << 20;

/// Makes a progressive mesh.
#[derive(Clone, Debug)]
pub struct Writer {
    replay: Replay,
    log: RecordLog,
    pub(super) levels: Vec<Level>,
    materials: Vec<MaterialEntry>,
    pub(super) edited: EditedLevels,
}

impl Writer {
    /// Starts at the original mesh.
    ///
    /// # Errors
    /// [`ProgressiveError::Mesh`] for a mesh that breaks its invariants.
    pub fn new(mesh: &Mesh) -> Result<Self, ProgressiveError> {
        Ok(Self {
            replay: Replay::from_mesh(mesh)?,
            log: RecordLog::default(),
            levels: Vec::new(),
            materials: MaterialEntry::all_of(mesh)?,
            edited: EditedLevels::default(),
        })
    }

    /// Takes the next collapse.
    ///
    /// # Errors
    /// [`ProgressiveError::Misfit`] when it does not describe the mesh at its present level; the
    /// writer is then as before.
    pub fn push(&mut self, collapse: &Collapse) -> Result<(), ProgressiveError> {
        self.replay.apply(collapse)?;
        self.log.push(collapse);
        Ok(())
    }

    /// Gives the present level a name. Its edits may be recorded from now on
    /// ([`Self::begin_edits`]), whatever collapses follow.
    pub fn mark_level(&mut self, name: &str) {
        self.edited.fingerprints.push(fingerprint(&self.replay.to_mesh()));
        self.levels.push(Level {
            name: name.to_owned(),
            faces: self.replay.n_faces(),
            vertices: self.replay.n_vertices(),
            record: self.n_records(),
            edits: None,
        });
    }

    /// Collapses taken.
    pub fn n_records(&self) -> u32 {
        self.log.len() as u32
    }

    /// The mesh at its present level.
    pub fn replay(&self) -> &Replay {
        &self.replay
    }

    /// The file. The present level becomes the coarsest; edits of a level that were not ended end
    /// here.
    ///
    /// # Errors
    /// [`ProgressiveError::Compression`] when a part is over 4 GiB or the compressor fails.
    pub fn finish(mut self) -> Result<Vec<u8>, ProgressiveError> {
        self.end_edits()?;
        let mut header = self.header();
        let mut base = Streams::default();
        self.put_base_mesh(&mut base)?;
        let is_in_base = self.wedges_in_use();
        let mut is_known = is_in_base.clone();
        let (blocks, records) = self.put_records(&mut is_known)?;
        // Wedges that no face of any level uses go with the coarsest mesh.
        let is_stored = |w: &u32| is_in_base[*w as usize] || !is_known[*w as usize];
        let mut wedges: Vec<u32> = (0..header.n_all_wedges).filter(is_stored).collect();
        code_wedges(&mut base, &mut self.replay, &mut wedges).map_err(at_base)?;
        let mut body = Vec::new();
        (header.images, header.blobs) = put_images(&self.replay.images, &mut body);
        header.parts = put_parts(&self.replay, &mut body)?;
        header.n_base_wedges = wedges.len() as u32;
        header.base = base.pack(&mut body)?;
        header.blocks = blocks;
        for block in &mut header.blocks {
            block.section.offset += body.len() as u64;
        }
        body.extend(records);
        let edits = header.levels.iter_mut().filter_map(|level| level.edits.as_mut());
        for block in edits.flat_map(|edits| &mut edits.blocks) {
            block.section.offset += body.len() as u64;
        }
        body.append(&mut self.edited.body);
        let mut file = header.to_bytes()?;
        file.append(&mut body);
        Ok(file)
    }

    /// The header without what is known only after coding.
    fn header(&mut self) -> Header {
        let replay = &self.replay;
        let layers = replay.layers.iter();
        Header {
            producer: concat!("Lookalike ", env!("CARGO_PKG_VERSION")).to_owned(),
            n_vertices: replay.positions.len() as u32,
            n_faces: replay.faces.len() as u32,
            n_wedges: replay.n_original_wedges,
            n_all_wedges: replay.n_wedges,
            has_face_materials: !replay.face_materials.is_empty(),
            layers: layers.map(|&(semantic, w)| Layer { semantic, width: w as u32 }).collect(),
            materials: std::mem::take(&mut self.materials),
            textures: replay.textures.clone(),
            images: Vec::new(),
            blobs: Vec::new(),
            parts: None,
            levels: std::mem::take(&mut self.levels),
            n_records: self.log.len() as u32,
            n_base_vertices: replay.n_alive_vertices,
            n_base_faces: replay.n_alive_faces,
            n_base_wedges: 0,
            base: Section::default(),
            blocks: Vec::new(),
        }
    }

    fn put_base_mesh(&mut self, streams: &mut Streams) -> Result<(), ProgressiveError> {
        let mut vertices = ids_of(&self.replay.is_vertex_alive);
        let mut faces = ids_of(&self.replay.is_face_alive);
        code_mesh(streams, &mut self.replay, &mut vertices, &mut faces).map_err(at_base)
    }

    /// Which wedges the faces of the present level use.
    fn wedges_in_use(&self) -> Vec<bool> {
        let mut in_use = vec![false; self.replay.n_wedges as usize];
        for (wedges, alive) in self.replay.face_wedges.iter().zip(&self.replay.is_face_alive) {
            for wedge in wedges.iter().filter(|_| *alive) {
                in_use[*wedge as usize] = true;
            }
        }
        in_use
    }

    /// Walks back to the original mesh; returns the blocks and their bytes.
    fn put_records(
        &mut self,
        is_known: &mut [bool],
    ) -> Result<(Vec<Block>, Vec<u8>), ProgressiveError> {
        let (mut blocks, mut body) = (Vec::new(), Vec::new());
        let mut streams = Streams::default();
        let (mut n_records, mut n_faces) = (0, self.replay.n_alive_faces);
        while let Some(collapse) = self.log.pop()? {
            linked::encode(&mut streams, &mut self.replay, is_known, &collapse)
                .map_err(|damage| damage.at("record"))?;
            self.replay.undo(&collapse)?;
            n_records += 1;
            let is_full = n_records == BLOCK_RECORDS || streams.len() >= BLOCK_BYTES;
            if is_full || self.log.len() == 0 {
                let section = std::mem::take(&mut streams).pack(&mut body)?;
                blocks.push(Block { n_records, n_faces, section });
                (n_records, n_faces) = (0, self.replay.n_alive_faces);
            }
        }
        Ok((blocks, body))
    }
}

fn at_base(damage: Damage) -> ProgressiveError {
    damage.at("coarsest mesh")
}

fn ids_of(flags: &[bool]) -> Vec<u32> {
    (0..flags.len() as u32).filter(|i| flags[*i as usize]).collect()
}
