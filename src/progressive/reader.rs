//! Levels out of a file, and its records both ways. (The edits of levels: `reader_edits`.)
//!
//! A coarse level needs the header, the coarsest mesh and the blocks up to it; later bytes are not
//! looked at, so a prefix of the file serves. Each checksum is checked when its part is read.

use super::{
    base::{code_mesh, code_wedges},
    error::{Damage, ProgressiveError},
    header::{Header, Level},
    images::take_images,
    linked,
    log::RecordLog,
    parts::take_parts,
    replay::Replay,
    section::{Reading, Streams},
};
use crate::mesh::{Collapse, FaceId, Mesh, RemovedFace, VertexId, WedgeId};

/// What a reader refuses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadLimits {
    /// Triangles of the original mesh, and of a level with all that its edits append.
    pub max_faces: u32,
    /// Vertices, likewise.
    pub max_vertices: u32,
    /// Values of attributes of all wedges, those of records included; of a level likewise.
    pub max_attribute_values: u64,
    /// Edits of a level.
    pub max_edits: u32,
    /// Bytes of a section before compression.
    pub max_section_bytes: u64,
    /// Corners that all records together, or the edits of a level, may make the reader visit
    /// (about 7 per record).
    pub max_corner_visits: u64,
}

impl Default for ReadLimits {
    fn default() -> Self {
        Self {
            max_faces: 40_000_000,
            max_vertices: 40_000_000,
            max_attribute_values: 1 << 30,
            max_edits: 100_000_000,
            max_section_bytes: 2 << 30,
            max_corner_visits: 4_000_000_000,
        }
    }
}

/// `Err` when `count` is over `limit`.
pub(super) fn check_limit(
    what: &'static str,
    count: u64,
    limit: u64,
) -> Result<(), ProgressiveError> {
    if count <= limit { Ok(()) } else { Err(ProgressiveError::OverLimit { what, count, limit }) }
}

/// Where the level of a name is.
pub(super) fn find_level(levels: &[Level], name: &str) -> Result<usize, ProgressiveError> {
    levels.iter().position(|level| level.name == name).ok_or_else(|| {
        let known: Vec<&str> = levels.iter().map(|level| level.name.as_str()).collect();
        ProgressiveError::UnknownLevel { name: name.to_owned(), known: known.join(", ") }
    })
}

/// An opened file.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    header: Header,
    pub(super) body: &'a [u8],
    pub(super) limits: ReadLimits,
}

impl<'a> Reader<'a> {
    /// Reads the header; nothing else yet.
    ///
    /// # Errors
    /// See [`ProgressiveError`].
    pub fn open(bytes: &'a [u8]) -> Result<Self, ProgressiveError> {
        Self::open_with(bytes, ReadLimits::default())
    }

    /// Likewise, with other limits.
    ///
    /// # Errors
    /// See [`ProgressiveError`].
    pub fn open_with(bytes: &'a [u8], limits: ReadLimits) -> Result<Self, ProgressiveError> {
        let (header, body) = Header::parse(bytes, &limits)?;
        Ok(Self { header, body, limits })
    }

    /// Counts, layers, levels, blocks.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The level with the most triangles of those that have at most `target_faces`, by collapses
    /// alone. Every record is a level, so no other is nearer.
    ///
    /// # Errors
    /// [`ProgressiveError::TooCoarse`] when even the coarsest level has more.
    pub fn extract(&self, target_faces: u32) -> Result<Mesh, ProgressiveError> {
        if target_faces < self.header.n_base_faces {
            return Err(ProgressiveError::TooCoarse {
                target: target_faces.into(),
                coarsest: self.header.n_base_faces.into(),
            });
        }
        let mut splits = self.coarse_to_fine()?;
        while let Some(n_new_faces) = splits.peek()?.map(|c| c.removed.len() as u64) {
            if u64::from(splits.replay.n_faces()) + n_new_faces > target_faces.into() {
                break;
            }
            splits.split()?;
        }
        Ok(splits.to_mesh())
    }

    /// The level that the header lists by this name.
    ///
    /// # Errors
    /// [`ProgressiveError::UnknownLevel`] names those that are there.
    pub fn level(&self, name: &str) -> Result<&Level, ProgressiveError> {
        find_level(&self.header.levels, name).map(|i| &self.header.levels[i])
    }

    /// A level as the collapses leave it, where its edits begin.
    pub(super) fn extract_record(&self, level: &Level) -> Result<Mesh, ProgressiveError> {
        let mut splits = self.coarse_to_fine()?;
        while splits.n_left > level.record && splits.split()?.is_some() {}
        Ok(splits.to_mesh())
    }

    /// The records from the coarsest mesh on; each `next` undoes one.
    ///
    /// # Errors
    /// When the coarsest mesh cannot be read.
    pub fn coarse_to_fine(&self) -> Result<CoarseToFine<'_>, ProgressiveError> {
        let Header { images, blobs, parts, n_faces, .. } = &self.header;
        let mut replay = self.header.blank_replay();
        replay.images = take_images(images, blobs, self.body)?;
        (replay.tree, replay.face_parts) =
            take_parts(parts.as_ref(), self.body, *n_faces as usize)?;
        let is_known = self.read_base(&mut replay)?;
        Ok(CoarseToFine {
            reader: self,
            replay,
            is_known,
            next_block: 0,
            block: Reading::default(),
            n_left_in_block: 0,
            n_left: self.header.n_records,
            n_visits: 0,
            pending: None,
            is_broken: false,
        })
    }

    /// The records from the original mesh on; each `next` applies one. The whole file is read
    /// first, and its records are kept in memory, about 80 bytes each.
    ///
    /// # Errors
    /// When any part of the file cannot be read.
    pub fn fine_to_coarse(&self) -> Result<FineToCoarse, ProgressiveError> {
        let mut splits = self.coarse_to_fine()?;
        let mut log = RecordLog::default();
        while let Some(collapse) = splits.split()? {
            log.push(&collapse);
        }
        Ok(FineToCoarse { replay: splits.replay, log })
    }

    /// Fills in the coarsest mesh; returns which wedges have values.
    fn read_base(&self, replay: &mut Replay) -> Result<Vec<bool>, ProgressiveError> {
        let header = &self.header;
        let place = "coarsest mesh";
        let streams = Streams::unpack(&header.base, self.body, place)?;
        let mut cursors = streams.cursors();
        // Each id takes a byte at least, which bounds the lists by what is there.
        let n_ids = u64::from(header.n_base_vertices)
            + u64::from(header.n_base_faces)
            + u64::from(header.n_base_wedges);
        if n_ids > streams.ids.len() as u64 {
            return Err(Damage("the data end too early").at(place));
        }
        let mut vertices = vec![0; header.n_base_vertices as usize];
        let mut faces = vec![0; header.n_base_faces as usize];
        let mut wedges = vec![0; header.n_base_wedges as usize];
        code_mesh(&mut cursors, replay, &mut vertices, &mut faces).map_err(|d| d.at(place))?;
        code_wedges(&mut cursors, replay, &mut wedges).map_err(|d| d.at(place))?;
        if !cursors.is_empty() {
            return Err(Damage("bytes are left over").at(place));
        }
        replay.n_alive_vertices = header.n_base_vertices;
        for id in faces {
            let vertices = replay.faces[id as usize].map(VertexId);
            replay.set_alive(
                &RemovedFace { face: FaceId(id), vertices, wedges: [WedgeId(0); 3] },
                true,
            );
        }
        let mut is_known = vec![false; header.n_all_wedges as usize];
        for wedge in wedges {
            is_known[wedge as usize] = true;
        }
        Ok(is_known)
    }
}

/// Vertex splits from the coarsest mesh to the original.
#[derive(Clone, Debug)]
pub struct CoarseToFine<'a> {
    reader: &'a Reader<'a>,
    replay: Replay,
    is_known: Vec<bool>,
    next_block: usize,
    block: Reading,
    n_left_in_block: u32,
    n_left: u32,
    n_visits: u64,
    /// Read but not undone yet.
    pending: Option<Collapse>,
    is_broken: bool,
}

impl CoarseToFine<'_> {
    /// The mesh at the present level.
    pub fn to_mesh(&self) -> Mesh {
        self.replay.to_mesh()
    }

    /// The arrays at the present level.
    pub fn replay(&self) -> &Replay {
        &self.replay
    }

    /// Undoes one record and returns it; `None` at the original mesh.
    ///
    /// # Errors
    /// When the record cannot be read or does not fit; nothing can be read after that.
    pub fn split(&mut self) -> Result<Option<Collapse>, ProgressiveError> {
        self.peek()?;
        let Some(collapse) = self.pending.take() else { return Ok(None) };
        if let Err(error) = self.replay.undo(&collapse) {
            self.is_broken = true;
            return Err(match error {
                ProgressiveError::Misfit { problem } => Damage(problem).at(self.place()),
                other => other,
            });
        }
        self.n_left -= 1;
        if self.n_left == 0 {
            self.check_original()?;
        }
        Ok(Some(collapse))
    }

    /// The record that [`Self::split`] would undo.
    fn peek(&mut self) -> Result<Option<&Collapse>, ProgressiveError> {
        if self.pending.is_none() && self.n_left > 0 {
            if self.is_broken {
                return Err(Damage("an earlier record could not be read").at(self.place()));
            }
            // Set until the record is there.
            self.is_broken = true;
            self.pending = Some(self.read()?);
            self.is_broken = false;
        }
        Ok(self.pending.as_ref())
    }

    fn read(&mut self) -> Result<Collapse, ProgressiveError> {
        while self.n_left_in_block == 0 {
            self.open_block()?;
        }
        let place = self.place();
        let mut cursors = self.block.rest();
        let (collapse, n_visits) =
            linked::decode(&mut cursors, &mut self.replay, &mut self.is_known)
                .map_err(|damage| damage.at(place.clone()))?;
        let n_left = cursors.n_left();
        self.block.leave(n_left);
        self.n_visits += n_visits;
        check_limit("corner visits", self.n_visits, self.reader.limits.max_corner_visits)?;
        self.n_left_in_block -= 1;
        if self.n_left_in_block == 0 && n_left != [0; 3] {
            return Err(Damage("bytes are left over in its block").at(place));
        }
        Ok(collapse)
    }

    fn open_block(&mut self) -> Result<(), ProgressiveError> {
        let place = format!("block {}", self.next_block);
        let Some(block) = self.reader.header.blocks.get(self.next_block) else {
            return Err(Damage("it is not there").at(place));
        };
        if block.n_faces != self.replay.n_faces() {
            return Err(Damage("it begins at another level").at(place));
        }
        self.block = Reading::new(Streams::unpack(&block.section, self.reader.body, &place)?);
        self.n_left_in_block = block.n_records;
        self.next_block += 1;
        Ok(())
    }

    /// At the end all ids must be back.
    fn check_original(&self) -> Result<(), ProgressiveError> {
        let r = &self.replay;
        let n_wedges = r.n_original_wedges;
        if r.is_original() && r.face_wedges.iter().flatten().all(|w| *w < n_wedges) {
            return Ok(());
        }
        Err(Damage("the records do not lead to the original mesh").at("the last record"))
    }

    fn place(&self) -> String {
        format!("record {} from the coarsest", self.reader.header.n_records - self.n_left)
    }
}

impl Iterator for CoarseToFine<'_> {
    type Item = Result<Collapse, ProgressiveError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.is_broken {
            return None;
        }
        self.split().transpose()
    }
}

/// Collapses from the original mesh to the coarsest.
#[derive(Clone, Debug)]
pub struct FineToCoarse {
    replay: Replay,
    log: RecordLog,
}

impl FineToCoarse {
    /// The mesh at the present level.
    pub fn to_mesh(&self) -> Mesh {
        self.replay.to_mesh()
    }

    /// The arrays at the present level.
    pub fn replay(&self) -> &Replay {
        &self.replay
    }

    /// Applies one record and returns it; `None` at the coarsest mesh.
    ///
    /// # Errors
    /// None for a file that [`Reader::fine_to_coarse`] has read.
    pub fn collapse(&mut self) -> Result<Option<Collapse>, ProgressiveError> {
        let Some(collapse) = self.log.pop()? else { return Ok(None) };
        self.replay.apply(&collapse)?;
        Ok(Some(collapse))
    }
}

impl Iterator for FineToCoarse {
    type Item = Result<Collapse, ProgressiveError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.collapse().transpose()
    }
}
