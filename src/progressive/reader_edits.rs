//! Levels with their edits out of a file, and the edits both ways.
//!
//! A level that was edited on its own needs the header, the collapses up to it and its own blocks
//! of edits, which lie at the end of the file.

use super::{
    error::{Damage, ProgressiveError},
    header::{Level, LevelEdits},
    linked_edits,
    log::RecordLog,
    reader::{Reader, check_limit},
    replay::Replay,
    section::{Reading, Streams},
};
use crate::mesh::{EditRecord, Mesh};

impl Reader<'_> {
    /// The level that the header lists by this name, with its edits.
    ///
    /// # Errors
    /// [`ProgressiveError::UnknownLevel`] names those that are there.
    pub fn extract_level(&self, name: &str) -> Result<Mesh, ProgressiveError> {
        let level = self.level(name)?;
        if level.is_by_records_alone() {
            return self.extract_record(level);
        }
        let mut edits = self.edits_forward(name)?;
        while edits.apply()?.is_some() {}
        Ok(edits.to_mesh())
    }

    /// The level that the header lists by this name, as its edits found it.
    ///
    /// # Errors
    /// [`ProgressiveError::UnknownLevel`] names those that are there.
    pub fn extract_level_before_edits(&self, name: &str) -> Result<Mesh, ProgressiveError> {
        self.extract_record(self.level(name)?)
    }

    /// Like [`Self::extract`], but a level that was edited on its own is taken instead of the mesh
    /// of the collapses when it has at least as many triangles, and at most `target_faces`: it
    /// looks better. Returns that level, if it is one.
    ///
    /// # Errors
    /// [`ProgressiveError::TooCoarse`] when every level has more triangles.
    pub fn extract_nearest(
        &self,
        target_faces: u32,
    ) -> Result<(Mesh, Option<&Level>), ProgressiveError> {
        let edited = self.header().levels.iter().filter(|level| !level.is_by_records_alone());
        let fitting = edited.filter(|level| level.n_final_faces() <= target_faces);
        // Of equals, the first.
        let best = fitting.rev().max_by_key(|level| level.n_final_faces());
        let plain = self.extract(target_faces);
        match (best, plain) {
            (Some(level), Err(ProgressiveError::TooCoarse { .. })) => {
                Ok((self.extract_level(&level.name)?, Some(level)))
            }
            (Some(level), Ok(mesh)) if level.n_final_faces() as usize >= mesh.faces.len() => {
                Ok((self.extract_level(&level.name)?, Some(level)))
            }
            (_, plain) => Ok((plain?, None)),
        }
    }

    /// The edits of a level from where they begin; each `next` applies one.
    ///
    /// # Errors
    /// When the level is not there or cannot be read.
    pub fn edits_forward(&self, name: &str) -> Result<EditsForward<'_>, ProgressiveError> {
        let level = self.level(name)?;
        let replay = Replay::from_mesh(&self.extract_record(level)?)?;
        Ok(EditsForward {
            reader: self,
            level,
            replay,
            next_block: 0,
            block: Reading::default(),
            n_left_in_block: 0,
            n_left: level.n_edits(),
            n_visits: 0,
            is_broken: false,
        })
    }

    /// The edits of a level from its final mesh back; each `next` undoes one. All of them are read
    /// first and kept in memory, about 50 bytes each.
    ///
    /// # Errors
    /// When the level is not there, or any part of it cannot be read.
    pub fn edits_backward(&self, name: &str) -> Result<EditsBackward, ProgressiveError> {
        let mut edits = self.edits_forward(name)?;
        let mut log = RecordLog::default();
        while let Some(record) = edits.apply()? {
            log.push(record.edit());
        }
        Ok(EditsBackward { replay: edits.replay, log })
    }
}

/// Edits of a level from the mesh that collapses left to the final one.
#[derive(Clone, Debug)]
pub struct EditsForward<'a> {
    reader: &'a Reader<'a>,
    level: &'a Level,
    replay: Replay,
    next_block: usize,
    block: Reading,
    n_left_in_block: u32,
    n_left: u32,
    n_visits: u64,
    is_broken: bool,
}

impl EditsForward<'_> {
    /// The mesh after the edits so far.
    pub fn to_mesh(&self) -> Mesh {
        self.replay.to_mesh()
    }

    /// The arrays after the edits so far.
    pub fn replay(&self) -> &Replay {
        &self.replay
    }

    /// Applies one edit and returns it; `None` at the final mesh.
    ///
    /// # Errors
    /// When the edit cannot be read or does not fit; nothing can be read after that.
    pub fn apply(&mut self) -> Result<Option<EditRecord>, ProgressiveError> {
        let Some(edits) = self.level.edits.as_ref().filter(|_| self.n_left > 0) else {
            return Ok(None);
        };
        if self.is_broken {
            return Err(Damage("an earlier edit could not be read").at(self.place(edits)));
        }
        // Set until all is well.
        self.is_broken = true;
        let record = self.read(edits)?;
        if let Err(error) = self.replay.apply_edit(record.edit()) {
            return Err(match error {
                ProgressiveError::Misfit { problem } => Damage(problem).at(self.place(edits)),
                other => other,
            });
        }
        self.check_size()?;
        self.n_left -= 1;
        if self.n_left == 0 {
            let (faces, vertices) = (self.replay.n_faces(), self.replay.n_vertices());
            if (faces, vertices) != (edits.faces, edits.vertices) {
                return Err(Damage("they lead to another mesh").at(self.place(edits)));
            }
        }
        self.is_broken = false;
        Ok(Some(record))
    }

    fn read(&mut self, edits: &LevelEdits) -> Result<EditRecord, ProgressiveError> {
        while self.n_left_in_block == 0 {
            self.open_block(edits)?;
        }
        let mut cursors = self.block.rest();
        let decoded = linked_edits::decode(&mut cursors, &self.replay);
        let n_left = cursors.n_left();
        let (record, n_visits) = decoded.map_err(|damage| damage.at(self.place(edits)))?;
        self.block.leave(n_left);
        self.n_visits += n_visits;
        check_limit("corner visits", self.n_visits, self.reader.limits.max_corner_visits)?;
        self.n_left_in_block -= 1;
        if self.n_left_in_block == 0 && n_left != [0; 3] {
            return Err(Damage("bytes are left over in its block").at(self.place(edits)));
        }
        Ok(record)
    }

    fn open_block(&mut self, edits: &LevelEdits) -> Result<(), ProgressiveError> {
        let place = format!("block {} of the edits of '{}'", self.next_block, self.level.name);
        let Some(block) = edits.blocks.get(self.next_block) else {
            return Err(Damage("it is not there").at(place));
        };
        if block.n_faces != self.replay.n_faces() {
            return Err(Damage("it begins at another mesh").at(place));
        }
        self.block = Reading::new(Streams::unpack(&block.section, self.reader.body, &place)?);
        self.n_left_in_block = block.n_records;
        self.next_block += 1;
        Ok(())
    }

    /// Edits append slots that are never reused.
    fn check_size(&self) -> Result<(), ProgressiveError> {
        let (limits, replay) = (&self.reader.limits, &self.replay);
        check_limit("triangles", replay.faces.len() as u64, limits.max_faces.into())?;
        check_limit("vertices", replay.positions.len() as u64, limits.max_vertices.into())?;
        let n_values = replay.wedge_values.len() as u64;
        check_limit("attribute values", n_values, limits.max_attribute_values)
    }

    fn place(&self, edits: &LevelEdits) -> String {
        format!("edit {} of '{}'", edits.n_edits - self.n_left, self.level.name)
    }
}

impl Iterator for EditsForward<'_> {
    type Item = Result<EditRecord, ProgressiveError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.is_broken {
            return None;
        }
        self.apply().transpose()
    }
}

/// Edits of a level from the final mesh back to the one that collapses left.
#[derive(Clone, Debug)]
pub struct EditsBackward {
    replay: Replay,
    log: RecordLog,
}

impl EditsBackward {
    /// The mesh before the edits that were undone.
    pub fn to_mesh(&self) -> Mesh {
        self.replay.to_mesh()
    }

    /// The arrays before the edits that were undone.
    pub fn replay(&self) -> &Replay {
        &self.replay
    }

    /// Undoes one edit and returns it; `None` where they began.
    ///
    /// # Errors
    /// None for a level that [`Reader::edits_backward`] has read.
    pub fn undo(&mut self) -> Result<Option<EditRecord>, ProgressiveError> {
        let Some(record) = self.log.pop_edit()? else { return Ok(None) };
        self.replay.undo_edit(record.edit())?;
        Ok(Some(record))
    }
}

impl Iterator for EditsBackward {
    type Item = Result<EditRecord, ProgressiveError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.undo().transpose()
    }
}
