//! The pictures of the original, and who judges by them: one studio serves every stage of a job.

use std::sync::{Arc, mpsc::Receiver};

use glam::DVec3;

use crate::{
    mesh::{EditMesh, Mesh},
    metric::{
        Objective, Palette, Pictures, ViewSet, bounding_sphere, pictures_and_unseen, scene_as_drawn,
    },
    render::{self, Maker, RenderError, Scene, Taped, choose, make_evaluator},
    tape::{Question, Tape},
};

use super::{
    pipeline::{DeviceChoice, PipelineError},
    recorder::Recorder,
};

/// 0 to 6: `render/taped.rs`, `optimize/alternate.rs`, `clock.rs`.
const MEASURED: Question = Question::of(7);

/// The name by which the native twin is asked for, and the one it gives itself.
const TWIN: (&str, &str) = ("cpu", "native");

/// See the module.
pub(super) struct Studio<'m> {
    original: &'m Mesh,
    center: DVec3,
    base: Pictures,
    /// The textures of the mesh that is worked on.
    palette: Arc<Palette>,
    /// The run-time views, then the same turned.
    sets: Vec<ViewSet>,
    /// Sets that are drawn ahead (`illustrator.rs`).
    drawn: Receiver<ViewSet>,
    /// As asked for; once it was measured, the one that was fastest.
    device: String,
    /// What the fastest calls itself, once it was measured.
    evaluator: Option<String>,
    has_own_normals: bool,
    tape: Tape,
}

impl<'m> Studio<'m> {
    /// Of pictures like these, which `drawn` brings as far as they are drawn ahead, for a mesh with these
    /// textures.
    pub fn new(
        original: &'m Mesh,
        (base, palette): (Pictures, Arc<Palette>),
        drawn: Receiver<ViewSet>,
        (device, tape): (&DeviceChoice, &Tape),
    ) -> Self {
        Self {
            original,
            center: bounding_sphere(original).center,
            base,
            palette,
            sets: Vec::new(),
            drawn,
            device: device.0.clone(),
            evaluator: None,
            has_own_normals: false,
            tape: tape.clone(),
        }
    }

    /// What is known already.
    pub fn tape(&self) -> &Tape {
        &self.tape
    }

    /// From now on vertex normals are those that meshes have as an attribute.
    pub fn use_own_normals(&mut self) {
        self.has_own_normals = true;
    }

    /// The original in the run-time views, and in others.
    pub fn sets(&self) -> &[ViewSet] {
        &self.sets
    }

    /// Adds the original in one set of views more.
    pub fn add_set(&mut self) {
        let turn = self.sets.len() as u64;
        let draw = |_| ViewSet::turned(self.original, &self.base, self.center, turn);
        let mut set = self.drawn.recv().unwrap_or_else(draw);
        set.pictures.palette = self.palette.clone();
        self.sets.push(set);
    }

    /// The energy of a mesh on the run-time views, drawn once.
    pub fn energy(&mut self, mesh: &EditMesh) -> u64 {
        if self.sets.is_empty() {
            self.add_set();
        }
        let ViewSet { pictures, reference, .. } = &self.sets[0];
        self.tape.known(MEASURED, || {
            let drawn = render::reference(&self.scene(mesh, pictures));
            render::energy(&pictures.views, reference, &drawn.pictures)
        })
    }

    /// Who computes: measured with this mesh, and told, when it is first asked. Draws the run-time views
    /// where they are lacking.
    pub fn evaluator(
        &mut self,
        mesh: &EditMesh,
        recorder: &mut Recorder<'_>,
    ) -> Result<String, PipelineError> {
        if let Some(name) = &self.evaluator {
            return Ok(name.clone());
        }
        if self.sets.is_empty() {
            self.add_set();
        }
        let set = &self.sets[0];
        let choice = choose(&self.device, &self.scene(mesh, &set.pictures), set.reference.clone())?;
        for (name, evaluations_per_sec) in &choice.figures {
            let text = format!("{name}: {evaluations_per_sec:.0} evaluations/s");
            recorder.note("DEVICE_MEASURED", &text)?;
        }
        for note in &choice.notes {
            recorder.note("DEVICE_NOTE", note)?;
        }
        let name = choice.evaluator.name();
        recorder.note("DEVICE_CHOSEN", &name)?;
        self.device = if name == TWIN.1 { TWIN.0.into() } else { name.clone() };
        self.evaluator = Some(name.clone());
        Ok(name)
    }

    /// Draws a mesh in a view set; number 0 is the run-time views.
    pub fn show(&self, set: usize, mesh: &EditMesh) -> Result<Objective, RenderError> {
        let ViewSet { pictures, reference, .. } = &self.sets[set];
        let scene = self.scene(mesh, pictures);
        let (device, shown) = (self.device.clone(), reference.clone());
        let make: Maker = Box::new(move |scene| make_evaluator(&device, scene, shown.clone()));
        let evaluator = Box::new(Taped::new(&self.tape, &scene, make)?);
        let objective = Objective::new(mesh, &pictures.palette, scene, evaluator);
        let objective = objective.with_reference(reference.clone());
        Ok(if self.has_own_normals { objective.with_own_normals() } else { objective })
    }

    /// Triangles of the original that no run-time view sees; `None` where they were not drawn.
    pub fn n_unseen(&self) -> Option<usize> {
        self.sets.first().map(|set| set.n_unseen)
    }

    /// The same of a level.
    pub fn n_unseen_of(&self, level: &Mesh) -> Option<usize> {
        self.sets.first().map(|set| pictures_and_unseen(level, &set.pictures).1)
    }

    fn scene(&self, mesh: &EditMesh, pictures: &Pictures) -> Scene {
        scene_as_drawn(mesh, pictures, self.has_own_normals)
    }
}
