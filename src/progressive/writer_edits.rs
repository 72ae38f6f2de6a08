//! Edits of levels on their way into a file.
//!
//! Invariants:
//! 1. the edits of a level begin at the very mesh that the collapses left, and each describes the
//!    mesh before it: both are checked as they come;
//! 2. they are packed as they come; only the block at hand is in memory as it is.

use super::{
    ProgressiveError,
    error::Damage,
    header::{Block, LevelEdits},
    linked_edits,
    reader::find_level,
    replay::Replay,
    section::Streams,
    writer::{BLOCK_BYTES, BLOCK_RECORDS, Writer},
};
use crate::mesh::{Edit, Mesh};

/// What a writer knows of its levels' edits.
#[derive(Clone, Debug, Default)]
pub(super) struct EditedLevels {
    /// Of each level, its mesh before edits.
    pub(super) fingerprints: Vec<u32>,
    /// Packed blocks; their offsets count from here.
    pub(super) body: Vec<u8>,
    open: Option<Branch>,
}

/// The edits of one level, while they come.
#[derive(Clone, Debug)]
struct Branch {
    level: usize,
    replay: Replay,
    streams: Streams,
    /// What `streams` holds, but for the section.
    block: Block,
    blocks: Vec<Block>,
}

impl Writer {
    /// Begins the edits of a level that was marked; `mesh` is its mesh, which the ids of the edits
    /// refer to. Edits begun before end here.
    ///
    /// # Errors
    /// [`ProgressiveError::UnknownLevel`], or [`ProgressiveError::Edits`] when it is another mesh
    /// or the level has edits already; the writer is then as before.
    pub fn begin_edits(&mut self, level_name: &str, mesh: &Mesh) -> Result<(), ProgressiveError> {
        let level = find_level(&self.levels, level_name)?;
        let fault = |problem| ProgressiveError::Edits { level: level_name.to_owned(), problem };
        let is_open = self.edited.open.as_ref().is_some_and(|branch| branch.level == level);
        if is_open || self.levels[level].edits.is_some() {
            return Err(fault("it has edits already"));
        }
        if self.edited.fingerprints.get(level) != Some(&fingerprint(mesh)) {
            return Err(fault("they begin at another mesh than the level's"));
        }
        let replay = Replay::from_mesh(mesh)?;
        self.end_edits()?;
        let block = Block { n_faces: replay.n_faces(), ..Block::default() };
        let (streams, blocks) = (Streams::default(), Vec::new());
        self.edited.open = Some(Branch { level, replay, streams, block, blocks });
        Ok(())
    }

    /// Takes the next edit of the level whose edits have begun.
    ///
    /// # Errors
    /// [`ProgressiveError::Misfit`] when it does not describe the level's mesh as the edits before
    /// left it, [`ProgressiveError::Edits`] when none have begun; the writer is then as before.
    pub fn push_edit<'a>(&mut self, edit: impl Into<Edit<'a>>) -> Result<(), ProgressiveError> {
        let Some(branch) = &mut self.edited.open else {
            let problem = "no level's edits have begun";
            return Err(ProgressiveError::Edits { level: String::new(), problem });
        };
        branch.push(edit.into(), &mut self.edited.body)
    }

    /// Ends the edits of the level whose edits have begun, if one's have. A level without any is
    /// as if none had begun.
    ///
    /// # Errors
    /// [`ProgressiveError::Compression`] when the compressor fails.
    pub fn end_edits(&mut self) -> Result<(), ProgressiveError> {
        let Some(mut branch) = self.edited.open.take() else { return Ok(()) };
        branch.pack(&mut self.edited.body)?;
        if !branch.blocks.is_empty() {
            self.levels[branch.level].edits = Some(LevelEdits {
                n_edits: branch.blocks.iter().map(|block| block.n_records).sum(),
                faces: branch.replay.n_faces(),
                vertices: branch.replay.n_vertices(),
                blocks: branch.blocks,
            });
        }
        Ok(())
    }

    /// The mesh that the edits of a level have led to, while they come.
    pub fn edit_replay(&self) -> Option<&Replay> {
        self.edited.open.as_ref().map(|branch| &branch.replay)
    }
}

impl Branch {
    fn push(&mut self, edit: Edit<'_>, body: &mut Vec<u8>) -> Result<(), ProgressiveError> {
        let misfit = |Damage(problem)| ProgressiveError::Misfit { problem };
        // The codec leaves out what the mesh tells.
        self.replay.check_edit(edit).map_err(misfit)?;
        linked_edits::encode(&mut self.streams, &self.replay, edit).map_err(misfit)?;
        self.replay.apply_edit(edit)?;
        self.block.n_records += 1;
        if self.block.n_records >= BLOCK_RECORDS || self.streams.len() >= BLOCK_BYTES {
            self.pack(body)?;
        }
        Ok(())
    }

    fn pack(&mut self, body: &mut Vec<u8>) -> Result<(), ProgressiveError> {
        if self.block.n_records > 0 {
            self.block.section = std::mem::take(&mut self.streams).pack(body)?;
            self.blocks.push(self.block);
        }
        self.block = Block { n_faces: self.replay.n_faces(), ..Block::default() };
        Ok(())
    }
}

/// A checksum of everything in a mesh, bit by bit.
pub(super) fn fingerprint(mesh: &Mesh) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    let mut put = |bytes: &[u8]| hasher.update(bytes);
    let lists = [mesh.faces.as_flattened(), mesh.face_wedges.as_flattened(), &mesh.face_materials];
    for list in lists {
        put(&(list.len() as u64).to_le_bytes());
        list.iter().for_each(|id| put(&id.to_le_bytes()));
    }
    put(&(mesh.positions.len() as u64).to_le_bytes());
    let places = mesh.positions.iter().flat_map(glam::DVec3::to_array);
    places.for_each(|x| put(&x.to_bits().to_le_bytes()));
    for layer in &mesh.layers {
        put(format!("{:?} {}", layer.semantic, layer.width).as_bytes());
        layer.values.iter().for_each(|x| put(&x.to_bits().to_le_bytes()));
    }
    put(format!("{:?}", mesh.materials).as_bytes());
    hasher.finalize()
}
