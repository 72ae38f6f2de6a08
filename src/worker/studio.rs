//! The pictures of the original, and who judges by them: one studio serves every stage of a job.

use glam::DVec3;

use crate::{
    jobs::spec::Spec,
    mesh::{EditMesh, Mesh},
    metric::{
        Objective, Pictures, ViewSet, bounding_sphere, scene_of_edit_mesh, scene_with_normals,
    },
    render::{Reference, RenderError, choose},
};

use super::{
    params,
    pipeline::{DeviceChoice, PipelineError},
    recorder::Recorder,
};

/// The name by which the native twin is asked for, and the one it gives itself.
const TWIN: (&str, &str) = ("cpu", "native");

/// See the module.
pub(super) struct Studio<'m> {
    original: &'m Mesh,
    center: DVec3,
    /// The run-time views, then the same turned.
    sets: Vec<ViewSet>,
    /// As asked for; once it was measured, the one that was fastest.
    device: String,
    has_chosen: bool,
    has_own_normals: bool,
}

impl<'m> Studio<'m> {
    /// Draws the original from all sides.
    pub fn open(spec: &Spec, original: &'m Mesh, device: &DeviceChoice) -> Self {
        let pictures = params::pictures(spec, original);
        let center = bounding_sphere(original).center;
        Self {
            original,
            center,
            sets: vec![ViewSet::turned(original, &pictures, center, 0)],
            device: device.0.clone(),
            has_chosen: false,
            has_own_normals: false,
        }
    }

    /// From now on vertex normals are those that meshes have as an attribute.
    pub fn use_own_normals(&mut self) {
        self.has_own_normals = true;
    }

    /// The original in the run-time views, and in others.
    pub fn sets(&self) -> &[ViewSet] {
        &self.sets
    }

    /// Draws the original in one set of views more.
    pub fn add_set(&mut self) {
        let (turn, base) = (self.sets.len() as u64, &self.sets[0].pictures);
        self.sets.push(ViewSet::turned(self.original, base, self.center, turn));
    }

    /// Draws a mesh in the run-time views, and tells which device was chosen when that is new.
    pub fn objective(
        &mut self,
        mesh: &EditMesh,
        recorder: &mut Recorder<'_>,
    ) -> Result<Objective, PipelineError> {
        let set = &self.sets[0];
        if self.has_chosen {
            return Ok(self.show(set, mesh)?);
        }
        let scene = self.scene(mesh, &set.pictures);
        let choice = choose(&self.device, &scene, set.reference.clone())?;
        let name = choice.evaluator.name();
        for (name, evaluations_per_sec) in &choice.figures {
            let text = format!("{name}: {evaluations_per_sec:.0} evaluations/s");
            recorder.note("DEVICE_MEASURED", &text)?;
        }
        for note in &choice.notes {
            recorder.note("DEVICE_NOTE", note)?;
        }
        recorder.note("DEVICE_CHOSEN", &name)?;
        let objective = Objective::new(mesh, scene, choice.evaluator);
        let objective = self.finish(objective, set.reference.clone());
        self.has_chosen = true;
        self.device = if name == TWIN.1 { TWIN.0.into() } else { name };
        Ok(objective)
    }

    /// Draws a mesh in a set of views.
    pub fn show(&self, set: &ViewSet, mesh: &EditMesh) -> Result<Objective, RenderError> {
        let scene = self.scene(mesh, &set.pictures);
        let choice = choose(&self.device, &scene, set.reference.clone())?;
        let objective = Objective::new(mesh, scene, choice.evaluator);
        Ok(self.finish(objective, set.reference.clone()))
    }

    fn scene(&self, mesh: &EditMesh, pictures: &Pictures) -> crate::render::Scene {
        if self.has_own_normals {
            scene_with_normals(mesh, pictures)
        } else {
            scene_of_edit_mesh(mesh, pictures)
        }
    }

    fn finish(&self, objective: Objective, reference: Reference) -> Objective {
        let objective = objective.with_reference(reference);
        if self.has_own_normals { objective.with_own_normals() } else { objective }
    }
}
