//! The objective of the image-driven stages: the energy of the pictures, and how a local edit of
//! the mesh changes it.
//!
//! Turns planned edits ([`Collapse`]) into the evaluator's [`Move`]s. Flat shading redraws the
//! triangles at both ends of the edge (T = ⌈⌈⌊e⌋⌉⌉); smooth shading also those of the ring, whose
//! vertex normals change (Lindstrom & Turk 2000, section 5).

use std::sync::Arc;

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::{
    mesh::{AttributeLayer, Collapse, EditMesh, FaceId, Mesh, Semantic, VertexId},
    render::{
        AddedFace, Evaluator, MAX_MOVE_VERTICES, Move, Reference, RenderError, RenderParams, Scene,
        SceneFace, Shading, reference_and_seen,
        view::{BoundingSphere, View},
    },
};

use super::{appearance::Appearance, channels::Metric, masking, palette::Palette};

/// Pictures of the model being simplified, beside the original's.
pub struct Objective {
    scene: Scene,
    evaluator: Box<dyn Evaluator>,
    appearance: Appearance,
    reference: Option<Reference>,
    has_own_normals: bool,
    evaluations: u64,
}

/// Cameras and drawing of the run-time pictures.
#[derive(Clone, Debug)]
pub struct Pictures {
    /// How they are drawn.
    pub params: RenderParams,
    /// From where.
    pub views: Vec<View>,
    /// The textures of the mesh that they show.
    pub palette: Arc<Palette>,
}

/// A set of views, and what the original looks like in them.
#[derive(Clone, Debug)]
pub struct ViewSet {
    /// From where, and how.
    pub pictures: Pictures,
    /// The original.
    pub reference: Reference,
    /// Triangles of the original that are in front in no pixel.
    pub n_unseen: usize,
}

impl ViewSet {
    /// The original in other views: those of `pictures`, turned (see [`Pictures::turned`]).
    pub fn turned(original: &Mesh, pictures: &Pictures, center: DVec3, turn: u64) -> Self {
        let pictures = pictures.turned(center, turn);
        let (reference, n_unseen) = pictures_and_unseen(original, &pictures);
        Self { pictures, reference, n_unseen }
    }
}

impl Pictures {
    /// Of a mesh, and of what is made of it.
    pub fn of(mesh: &Mesh, params: RenderParams, views: Vec<View>) -> Self {
        Self::by_metric(mesh, params, views, Metric::Luminance)
    }

    /// The same by another metric: where colours count, each camera takes a picture of each channel.
    pub fn by_metric(
        mesh: &Mesh,
        mut params: RenderParams,
        cameras: Vec<View>,
        metric: Metric,
    ) -> Self {
        let palette = Arc::new(Palette::of(mesh, params.image_size, metric));
        // A camera's pictures follow one another, so those of the interior still come first.
        params.interior_views *= metric.n_channels();
        let views = cameras.into_iter().flat_map(|camera| {
            (0..metric.n_channels() as u8).map(move |channel| camera.in_channel(channel))
        });
        Self { params, views: views.collect(), palette }
    }

    /// The same cameras, all turned about the centre of the model by the same rotation: number
    /// `turn` of a sequence that covers the rotations evenly; number 0 is none at all.
    #[must_use]
    pub fn turned(&self, center: DVec3, turn: u64) -> Self {
        let rotation = nth_rotation(turn);
        let view = |v: &View| {
            let mut v = *v;
            v.eye = center + rotation * (v.eye - center);
            for axis in [&mut v.right, &mut v.up, &mut v.back, &mut v.to_light] {
                *axis = rotation * *axis;
            }
            v
        };
        Self { views: self.views.iter().map(view).collect(), ..self.clone() }
    }
}

/// Uniform rotations (Shoemake 1992) from an additive recurrence in three dimensions.
fn nth_rotation(n: u64) -> DQuat {
    if n == 0 {
        return DQuat::IDENTITY;
    }
    let part = |step: f64| (0.5 + n as f64 * step).fract();
    let [u, v, w] =
        [0.819_172_513_396_164_4, 0.671_043_606_703_789_3, 0.549_700_477_901_970_3].map(part);
    let (sin_v, cos_v) = libm::sincos(std::f64::consts::TAU * v);
    let (sin_w, cos_w) = libm::sincos(std::f64::consts::TAU * w);
    let (p, q) = ((1.0 - u).sqrt(), u.sqrt());
    DQuat::from_xyzw(p * sin_v, p * cos_v, q * sin_w, q * cos_w)
}

/// Renders the original: once per job.
pub fn reference_pictures(original: &Mesh, pictures: &Pictures) -> Reference {
    pictures_and_unseen(original, pictures).0
}

/// Likewise; and how many triangles are in front in no pixel.
pub fn pictures_and_unseen(mesh: &Mesh, pictures: &Pictures) -> (Reference, usize) {
    let (mut reference, seen) = reference_and_seen(&scene_of(mesh, pictures, |_| true));
    if pictures.palette.metric() == Metric::Perceptual {
        let weigh = |p: &Vec<u8>| masking::weights(p, pictures.params.image_size as usize);
        reference.weights = reference.pictures.par_iter().map(weigh).collect();
    }
    (reference, seen.iter().filter(|is_seen| !**is_seen).count())
}

/// The bounding sphere of the vertices that some triangle uses.
pub fn bounding_sphere(mesh: &Mesh) -> BoundingSphere {
    let mut is_used = vec![false; mesh.positions.len()];
    mesh.faces.iter().flatten().for_each(|v| is_used[*v as usize] = true);
    BoundingSphere::of(
        mesh.positions.iter().zip(is_used).filter_map(|(p, used)| used.then_some(*p)),
    )
}

/// The current state of an editable mesh as a scene, to build an evaluator from.
pub fn scene_of_edit_mesh(mesh: &EditMesh, pictures: &Pictures) -> Scene {
    scene_of(mesh.mesh(), pictures, |f| mesh.is_alive(FaceId(f)))
}

/// The same as [`scene_of_edit_mesh`] for smooth shading with the normals that the mesh has as an
/// attribute: the mean over the corners at each vertex. They need not be of unit length.
pub fn scene_with_normals(mesh: &EditMesh, pictures: &Pictures) -> Scene {
    let mut scene = scene_of_edit_mesh(mesh, pictures);
    let normals = (0..mesh.n_vertex_slots() as u32).map(VertexId).filter(|&v| mesh.is_used(v));
    let normals = normals.filter_map(|v| Some((v.0, stored_normal(mesh, v)?))).collect();
    scene.apply(&Move { normals, ..Move::default() });
    scene
}

/// A mesh as it is drawn: with normals of its own, or with those of its triangles.
pub fn scene_as_drawn(mesh: &EditMesh, pictures: &Pictures, has_own_normals: bool) -> Scene {
    if has_own_normals {
        scene_with_normals(mesh, pictures)
    } else {
        scene_of_edit_mesh(mesh, pictures)
    }
}

/// The mean of the normals stored at the corners of a vertex.
pub fn stored_normal(mesh: &EditMesh, vertex: VertexId) -> Option<DVec3> {
    let layer = mesh.mesh().layer(Semantic::Normal)?;
    let faces = mesh.faces_around(vertex);
    let mut sum = DVec3::ZERO;
    for &face in faces {
        let at = mesh.vertices_of(face).iter().position(|&v| v == vertex)?;
        match layer.get(mesh.wedges_of(face)[at]) {
            &[x, y, z] => sum += DVec3::new(f64::from(x), f64::from(y), f64::from(z)),
            _ => return None,
        }
    }
    (!faces.is_empty()).then(|| sum / faces.len() as f64)
}

/// The same mesh with its area-weighted normals as an attribute of its own, one at each vertex:
/// what an optimizer of normals starts from. A normal layer that it has is replaced.
pub fn with_vertex_normals(mut mesh: Mesh) -> Mesh {
    let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
    for face in &mesh.faces {
        let [p0, p1, p2] = face.map(|v| mesh.positions[v as usize]);
        for v in face {
            sums[*v as usize] += (p1 - p0).cross(p2 - p0);
        }
    }
    let normals: Vec<[f32; 3]> =
        sums.into_iter().map(|n| n.normalize_or_zero().as_vec3().to_array()).collect();
    if mesh.layers.is_empty() {
        mesh.face_wedges.clone_from(&mesh.faces);
    }
    let n_wedges = if mesh.layers.is_empty() { normals.len() } else { mesh.n_wedges() };
    let mut values = vec![0.0; 3 * n_wedges];
    for (vertices, wedges) in mesh.faces.iter().zip(&mesh.face_wedges) {
        for (v, w) in vertices.iter().zip(wedges) {
            values[3 * *w as usize..][..3].copy_from_slice(&normals[*v as usize]);
        }
    }
    mesh.layers.retain(|l| l.semantic != Semantic::Normal);
    mesh.layers.push(AttributeLayer { semantic: Semantic::Normal, width: 3, values });
    mesh
}

fn scene_of(mesh: &Mesh, pictures: &Pictures, is_alive: impl Fn(u32) -> bool) -> Scene {
    let appearance = Appearance::of(mesh, &pictures.palette);
    let faces = (0..mesh.faces.len() as u32)
        .map(|f| {
            is_alive(f).then(|| SceneFace {
                vertices: mesh.faces[f as usize],
                surface: appearance.of_face(mesh, FaceId(f)),
            })
        })
        .collect();
    let (params, views) = (pictures.params.clone(), pictures.views.clone());
    let texels = pictures.palette.texels().clone();
    Scene::new(params, views, texels, mesh.positions.clone(), faces)
}

impl Objective {
    /// `evaluator` must have been built from `scene`, which shows `mesh` as it is now with this palette.
    pub fn new(
        mesh: &EditMesh,
        palette: &Arc<Palette>,
        scene: Scene,
        evaluator: Box<dyn Evaluator>,
    ) -> Self {
        Self {
            scene,
            evaluator,
            appearance: Appearance::of(mesh.mesh(), palette),
            reference: None,
            has_own_normals: false,
            evaluations: 0,
        }
    }

    /// The same objective for a model whose vertex normals are its own, not derived from its
    /// triangles: `scene` shows them (see [`scene_with_normals`]).
    #[must_use]
    pub fn with_own_normals(self) -> Self {
        Self { has_own_normals: true, ..self }
    }

    /// Whether vertex normals stay when triangles move.
    pub fn has_own_normals(&self) -> bool {
        self.has_own_normals
    }

    /// How surfaces are shaded.
    pub fn shading(&self) -> Shading {
        self.scene.params.shading
    }

    /// The same objective, which can also tell where the pictures differ: `reference` is what its
    /// evaluator was built from.
    #[must_use]
    pub fn with_reference(self, reference: Reference) -> Self {
        Self { reference: Some(reference), ..self }
    }

    /// The pictures of the original, if they were kept.
    pub fn reference(&self) -> Option<&Reference> {
        self.reference.as_ref()
    }

    /// The model as it is drawn.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    pub(super) fn appearance(&self) -> &Appearance {
        &self.appearance
    }

    /// Moves judged so far.
    pub fn evaluations(&self) -> u64 {
        self.evaluations
    }

    /// Sum of squared differences over all pictures, each as often as its view and its pixel count, 0..=255
    /// units.
    pub fn energy(&self) -> u64 {
        self.evaluator.energy()
    }

    /// The papers' d2 on the run-time views: percent of full scale.
    pub fn d2_percent(&self) -> f64 {
        d2_percent(self.energy(), self.n_counted_pixels())
    }

    /// Pixels in all pictures, as often as they count at most.
    pub fn n_counted_pixels(&self) -> u64 {
        let full_weight = self.reference.as_ref().map_or(1, Reference::full_weight);
        self.scene.n_counted_pixels() * u64::from(full_weight)
    }

    /// The change of energy of each move.
    pub fn evaluate(&mut self, moves: &[Move]) -> Result<Vec<i64>, RenderError> {
        self.evaluations += moves.len() as u64;
        self.evaluator.evaluate(&self.scene, moves)
    }

    /// Makes a move.
    pub fn commit(&mut self, mv: &Move) -> Result<i64, RenderError> {
        self.evaluator.commit(&mut self.scene, mv)
    }

    /// Makes a move if that lowers the energy; `mesh` has not followed yet. Returns the change of
    /// energy, or `None` when it would not have fallen: then nothing has changed.
    pub fn commit_if_better(
        &mut self,
        mesh: &EditMesh,
        mv: &Move,
    ) -> Result<Option<i64>, RenderError> {
        let back = self.inverse(mesh, mv);
        let delta = self.commit(mv)?;
        if delta < 0 {
            return Ok(Some(delta));
        }
        self.commit(&back)?;
        Ok(None)
    }

    /// The move that takes back `mv`, which the pictures do not show yet.
    pub fn inverse(&self, mesh: &EditMesh, mv: &Move) -> Move {
        let scene = &self.scene;
        let face = |f: &u32| {
            let face = scene.faces.get(*f as usize).copied().flatten()?;
            Some(AddedFace { face: *f, vertices: face.vertices, surface: face.surface })
        };
        // A vertex that the move brings has nowhere to go back to.
        let is_old = |v: u32| (v as usize) < mesh.n_vertex_slots();
        let moved = mv.moved.iter().filter(|m| is_old(m.0));
        let normals = mv.normals.iter().filter(|m| is_old(m.0));
        Move {
            removed: mv.added.iter().map(|a| a.face).collect(),
            added: mv.removed.iter().filter_map(face).collect(),
            moved: moved.map(|(v, _)| (*v, scene.position(*v))).collect(),
            normals: normals.map(|(v, _)| (*v, scene.normal(*v))).collect(),
        }
    }

    /// A collapse that `mesh` has not made yet, as a move. `None` when it touches more of the mesh
    /// than one move may hold.
    pub fn collapse_move(&self, mesh: &EditMesh, plan: &Collapse) -> Option<Move> {
        let mut mv = Move::default();
        mv.moved.push((plan.keep.0, plan.to));
        let mut faces: Vec<FaceId> = mesh.faces_around(plan.keep).to_vec();
        faces.extend_from_slice(mesh.faces_around(plan.drop));
        let ring = match self.scene.params.shading {
            Shading::Flat => Vec::new(),
            Shading::Smooth => Self::widen_to_ring(mesh, plan, &mut faces),
        };
        faces.sort_unstable();
        faces.dedup();
        for face in faces {
            mv.removed.push(face.0);
            if let Some(added) = self.after_collapse(mesh, plan, face) {
                mv.added.push(added);
            }
        }
        for v in ring {
            mv.normals.push((v.0, normal_after(mesh, plan, v)));
        }
        (mv.added.len() * 3 <= MAX_MOVE_VERTICES).then_some(mv)
    }

    /// Adds the triangles of every ring vertex; returns the vertices whose normals change.
    fn widen_to_ring(mesh: &EditMesh, plan: &Collapse, faces: &mut Vec<FaceId>) -> Vec<VertexId> {
        let mut ring: Vec<VertexId> = faces.iter().flat_map(|f| mesh.vertices_of(*f)).collect();
        ring.sort_unstable();
        ring.dedup();
        ring.retain(|v| *v != plan.drop);
        for v in &ring {
            faces.extend_from_slice(mesh.faces_around(*v));
        }
        ring
    }

    /// A triangle as it will be after the collapse; `None` when the collapse removes it.
    pub(super) fn after_collapse(
        &self,
        mesh: &EditMesh,
        plan: &Collapse,
        face: FaceId,
    ) -> Option<AddedFace> {
        let before = mesh.vertices_of(face);
        if before.contains(&plan.keep) && before.contains(&plan.drop) {
            return None;
        }
        let vertices = before.map(|v| if v == plan.drop { plan.keep.0 } else { v.0 });
        let surface = self.appearance.of_face_after(mesh, plan, face);
        Some(AddedFace { face: face.0, vertices, surface })
    }

    /// Tells the objective of a collapse that the mesh has made (new wedges have new colours).
    pub fn follow(&mut self, mesh: &EditMesh) {
        self.appearance.extend(mesh.mesh());
    }

    /// The picture of one view now.
    pub fn picture(&mut self, view: usize) -> Result<Vec<u8>, RenderError> {
        self.evaluator.picture(&self.scene, view)
    }
}

/// Area-weighted unit normal of a vertex after a planned collapse.
fn normal_after(mesh: &EditMesh, plan: &Collapse, v: VertexId) -> DVec3 {
    let place = |w: VertexId| {
        if w == plan.keep || w == plan.drop { plan.to } else { mesh.position(w) }
    };
    let area = |f: &FaceId| {
        let vertices = mesh.vertices_of(*f);
        if vertices.contains(&plan.keep) && vertices.contains(&plan.drop) {
            return DVec3::ZERO;
        }
        let p = vertices.map(place);
        (p[1] - p[0]).cross(p[2] - p[0])
    };
    let mut sum: DVec3 = mesh.faces_around(v).iter().map(area).sum();
    if v == plan.keep {
        sum += mesh.faces_around(plan.drop).iter().map(area).sum::<DVec3>();
    }
    sum.normalize_or_zero()
}

/// The highest sum of squared 8-bit differences over `n_pixels` at which d2 is no more than `percent` of
/// full scale.
pub fn energy_of_d2(percent: f64, n_pixels: u64) -> u64 {
    let difference = 255.0 / 100.0 * percent;
    (difference * difference * n_pixels as f64) as u64
}

/// d2 in percent of full scale from a sum of squared 8-bit differences over `n_pixels`.
pub fn d2_percent(energy: u64, n_pixels: u64) -> f64 {
    100.0 / 255.0 * (energy as f64 / n_pixels.max(1) as f64).sqrt()
}
