//! Measures meshes against the budgets of levels.
//!
//! Budgets are of two kinds ([`LevelBudget`]): a level goes on until it is as small as it should be, but no
//! further than it may. How far d2 may go, the image-driven stage sees to.

use std::{borrow::Cow, cell::OnceCell};

use crate::{
    io::{self, GlbOptions},
    jobs::spec::LevelBudget,
    mesh::{EditMesh, FaceId, Mesh},
};

use super::{pipeline::PipelineError, stopped::StoppedBy, switching::Switching};

/// Knows the original.
pub(super) struct Gauge<'m> {
    original: &'m Mesh,
    options: GlbOptions,
    switching: OnceCell<Switching>,
    /// Bytes of a file of one triangle: images, materials, what describes them.
    n_fixed_bytes: OnceCell<u64>,
}

impl<'m> Gauge<'m> {
    /// For levels of this original, whose files are written like this. Nothing is prepared before it is asked for.
    pub fn new(original: &'m Mesh, options: GlbOptions) -> Self {
        let (switching, n_fixed_bytes) = (OnceCell::new(), OnceCell::new());
        Self { original, options, switching, n_fixed_bytes }
    }

    /// The file of a level.
    pub fn glb(&self, mesh: &Mesh) -> Result<Vec<u8>, PipelineError> {
        Ok(io::write_glb_with(mesh, self.options)?)
    }

    /// Measures distances from the original.
    pub fn switching(&self) -> &Switching {
        self.switching.get_or_init(|| Switching::new(self.original))
    }

    /// Bytes that every level's file has.
    fn n_fixed_bytes(&self) -> Result<u64, PipelineError> {
        if let Some(n) = self.n_fixed_bytes.get() {
            return Ok(*n);
        }
        let triangle = self.original.subset(vec![FaceId(0)]).mesh;
        let n = self.glb(&triangle)?.len() as u64;
        Ok(*self.n_fixed_bytes.get_or_init(|| n))
    }

    /// Bytes that a level's file may have, and what ends the level there: where what every file has is more
    /// than the budget, the rest is held to it.
    pub fn max_bytes(
        &self,
        budget: &LevelBudget,
    ) -> Result<Option<(u64, StoppedBy)>, PipelineError> {
        let Some(most) = budget.max_bytes else { return Ok(None) };
        let n_fixed = self.n_fixed_bytes()?;
        let is_hopeless = n_fixed > most;
        Ok(Some(if is_hopeless {
            (n_fixed + most, StoppedBy::Images)
        } else {
            (most, StoppedBy::Bytes)
        }))
    }

    /// A mesh to be measured.
    pub fn measure<'a>(&'a self, mesh: Cow<'a, EditMesh>) -> Measured<'a> {
        let (n_bytes, deviation) = (OnceCell::new(), OnceCell::new());
        Measured { gauge: self, mesh, snapshot: OnceCell::new(), n_bytes, deviation }
    }
}

/// A mesh, and what has been found out about it.
pub(super) struct Measured<'m> {
    gauge: &'m Gauge<'m>,
    mesh: Cow<'m, EditMesh>,
    snapshot: OnceCell<Mesh>,
    n_bytes: OnceCell<u64>,
    deviation: OnceCell<f64>,
}

impl Measured<'_> {
    /// What keeps a level from being as small as it should be; none where nothing does. A level without such
    /// a budget is never small enough.
    pub fn is_above(&self, budget: &LevelBudget) -> Result<Option<StoppedBy>, PipelineError> {
        let by_count = if budget.is_ratio { StoppedBy::Ratio } else { StoppedBy::Triangles };
        if budget.triangles.is_some_and(|most| self.mesh.n_faces() > most as usize) {
            return Ok(Some(by_count));
        }
        match self.gauge.max_bytes(budget)? {
            Some((most, by)) => Ok((self.n_bytes()? > most).then_some(by)),
            None => Ok(budget.triangles.is_none().then_some(by_count)),
        }
    }

    /// Whether it is further from the original than a level may be.
    pub fn is_too_far(&self, budget: &LevelBudget) -> bool {
        let is_seen = |pixels| Switching::screen_size(self.deviation()) < pixels;
        budget.screen_size.is_some_and(is_seen)
    }

    fn snapshot(&self) -> &Mesh {
        self.snapshot.get_or_init(|| self.mesh.snapshot())
    }

    fn n_bytes(&self) -> Result<u64, PipelineError> {
        if let Some(n) = self.n_bytes.get() {
            return Ok(*n);
        }
        let n = self.gauge.glb(self.snapshot())?.len() as u64;
        Ok(*self.n_bytes.get_or_init(|| n))
    }

    fn deviation(&self) -> f64 {
        let measure = || self.gauge.switching().deviation_radii(self.snapshot()).unwrap_or(0.0);
        *self.deviation.get_or_init(measure)
    }
}
