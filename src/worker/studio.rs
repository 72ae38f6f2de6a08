//! The pictures of the original, and who judges by them: one studio serves every stage of a job.

use glam::DVec3;

use crate::{
    jobs::spec::Spec,
    mesh::{EditMesh, Mesh},
    metric::{
        Objective, Pictures, bounding_sphere, reference_pictures, scene_of_edit_mesh,
        scene_with_normals,
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
    pictures: Pictures,
    reference: Reference,
    /// As asked for; once it was measured, the one that was fastest.
    device: String,
    has_chosen: bool,
    has_own_normals: bool,
}

impl<'m> Studio<'m> {
    /// Draws the original from all sides.
    pub fn open(spec: &Spec, original: &'m Mesh, device: &DeviceChoice) -> Self {
        let pictures = params::pictures(spec, original);
        let reference = reference_pictures(original, &pictures);
        Self {
            original,
            center: bounding_sphere(original).center,
            pictures,
            reference,
            device: device.0.clone(),
            has_chosen: false,
            has_own_normals: false,
        }
    }

    /// From now on vertex normals are those that meshes have as an attribute.
    pub fn use_own_normals(&mut self) {
        self.has_own_normals = true;
    }

    /// Draws a mesh as it is now, and tells which device was chosen when that is new.
    pub fn objective(
        &mut self,
        mesh: &EditMesh,
        recorder: &mut Recorder<'_>,
    ) -> Result<Objective, PipelineError> {
        if self.has_chosen {
            return Ok(self.turned(0, mesh)?);
        }
        let scene = self.scene(mesh, &self.pictures);
        let choice = choose(&self.device, &scene, self.reference.clone())?;
        let name = choice.evaluator.name();
        for (name, evaluations_per_sec) in &choice.figures {
            let text = format!("{name}: {evaluations_per_sec:.0} evaluations/s");
            recorder.note("DEVICE_MEASURED", &text)?;
        }
        for note in &choice.notes {
            recorder.note("DEVICE_NOTE", note)?;
        }
        recorder.note("DEVICE_CHOSEN", &name)?;
        self.has_chosen = true;
        self.device = if name == TWIN.1 { TWIN.0.into() } else { name };
        Ok(self.finish(Objective::new(mesh, scene, choice.evaluator), self.reference.clone()))
    }

    /// The same with all cameras turned: the `turn`-th of a fixed sequence, 0 being none at all.
    pub fn turned(&self, turn: u64, mesh: &EditMesh) -> Result<Objective, RenderError> {
        let pictures = self.pictures.turned(self.center, turn);
        let reference = match turn {
            0 => self.reference.clone(),
            _ => reference_pictures(self.original, &pictures),
        };
        let scene = self.scene(mesh, &pictures);
        let choice = choose(&self.device, &scene, reference.clone())?;
        Ok(self.finish(Objective::new(mesh, scene, choice.evaluator), reference))
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
