//! Steps down the slope of all vertices at once, in many views. Beyond the paper, which moves a few
//! vertices at a time by the energies of trial places: one drawing of the pictures gives the slope at
//! every vertex, so that hundreds of views can have their say.
//!
//! Invariants:
//! 1. the connectivity stays; all that changes is where vertices are, and attributes: normals of their own, texture
//!    coordinates and colours (`metric/attributes.rs` says within which bounds);
//! 2. what comes out is kept only if it lowers the energy of the pictures it is judged by.
//!
//! Source: Gauss–Newton steps, damped and with momentum (Polyak 1964), over mini-batches of views; what
//! comes out is the mean of the last places (Polyak & Juditsky 1992).

use std::ops::ControlFlow;

use glam::{DMat3, DVec3};

use crate::{
    mesh::{Corner, EditMesh, EditRecord, Semantic, VertexId},
    metric::{Attributes, Slope, Slopes, Unknown, ViewSet, scene_as_drawn, slopes, stored_normal},
    render::Scene,
    tape::Answer,
};

/// Share of a Gauss–Newton step that is taken: neighbours that move too make up the rest.
const SHARE: f64 = 0.3;
/// Share of the last steps that goes on.
const MOMENTUM: f64 = 0.85;
/// Bends are means over about so many steps.
const HORIZON: f64 = 8.0;
/// Added to a bend, as a share of its trace, so that no direction is without one.
const DAMPING: f64 = 0.003;
/// A step is at most this share of the mean length of a vertex's edges; on a texture, of theirs there; in a colour, of
/// full scale.
const LONGEST_STEP: f64 = 0.1;
/// The same for normals, which are about as long as 1.
const LONGEST_TURN: f64 = 0.1;
/// What comes out is the mean over this share of the steps, the last ones.
const MEAN_OVER: f64 = 0.3;

/// Pixels that say whether a descent has helped: those of one view set or, of small pictures, of several. It is the
/// last sets that say so: moves have looked at these the least, and image-driven simplification not at all.
const JUDGED_PIXELS: u64 = 1 << 20;

/// What a descent may change.
#[derive(Clone, Copy, Debug)]
pub struct Unknowns {
    /// Vertices have normals of their own.
    pub has_own_normals: bool,
    /// These move too.
    pub normals: bool,
    /// So do texture coordinates and vertex colours, where pictures show some.
    pub attributes: bool,
}

/// Triangles that an evaluation draws: those of a vertex.
const FACES_PER_EVALUATION: usize = 6;

/// What a descent costs: the evaluations that draw as many triangles.
pub fn cost(mesh: &EditMesh, n_steps: usize) -> u64 {
    if n_steps == 0 { 0 } else { cost_of_looks(mesh, n_steps + 2) }
}

/// What drawing the mesh in so many view sets costs.
pub fn cost_of_looks(mesh: &EditMesh, n_looks: usize) -> u64 {
    (mesh.n_faces() * n_looks).div_ceil(FACES_PER_EVALUATION) as u64
}

/// Goes down the slope in `n_steps` steps, each by the next of the view sets, from number `first` on.
/// Returns where that leads; nowhere if it does not help. Breaks off where `on_step` says so.
pub fn descend(
    mesh: &EditMesh,
    sets: &[ViewSet],
    (first, n_steps): (usize, usize),
    unknowns: Unknowns,
    on_step: &mut dyn FnMut(usize) -> ControlFlow<()>,
) -> ControlFlow<(), Destination> {
    let set = |k: usize| &sets[(first + k) % sets.len()];
    let mut scene = scene_as_drawn(mesh, &set(0).pictures, unknowns.has_own_normals);
    let attributes = Some(Attributes::of(mesh, &set(0).pictures.palette));
    let attributes = attributes.filter(|found| unknowns.attributes && !found.is_empty());
    let mut walk = Walk::new(mesh, (unknowns, attributes), n_steps);
    let n_judges = JUDGED_PIXELS.div_ceil(scene.n_pixels().max(1)).min(sets.len() as u64) as usize;
    let judge = |walk: &Walk, scene: &mut Scene| -> f64 {
        let judges = sets.iter().rev().take(n_judges);
        judges.map(|set| walk.look(scene, set).energy).sum()
    };
    let before = judge(&walk, &mut scene);
    for k in 0..n_steps {
        on_step(k)?;
        let found = walk.look(&mut scene, set(k));
        walk.step(&found, k);
    }
    walk.come_to_rest();
    let helps = judge(&walk, &mut scene) < before;
    ControlFlow::Continue(if helps { walk.destination() } else { Destination::default() })
}

/// Where vertices should be, by slot, and their normals; texture coordinates, by a corner that has them and the number
/// of their set, and colours, by a corner. Those that stay are left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Destination {
    places: Vec<(u32, DVec3)>,
    normals: Vec<(u32, [f32; 3])>,
    coordinates: Vec<(u32, (u32, [f32; 2]))>,
    colours: Vec<(u32, [f32; 3])>,
}

impl Answer for Destination {
    fn write(&self, out: &mut Vec<u8>) {
        self.places.write(out);
        self.normals.write(out);
        self.coordinates.write(out);
        self.colours.write(out);
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        Some(Self {
            places: Answer::read(bytes)?,
            normals: Answer::read(bytes)?,
            coordinates: Answer::read(bytes)?,
            colours: Answer::read(bytes)?,
        })
    }
}

/// Goes there; the edits.
pub fn go(mesh: &mut EditMesh, to: &Destination) -> Vec<EditRecord> {
    let mut records: Vec<EditRecord> = (to.places.iter())
        .map(|(v, to)| EditRecord::Displacement(mesh.displace(VertexId(*v), *to)))
        .collect();
    if !to.normals.is_empty() {
        let normals: Vec<_> = to.normals.iter().map(|(v, n)| (VertexId(*v), *n)).collect();
        records.extend(mesh.revalue(Semantic::Normal, &normals).map(EditRecord::Revalue));
    }
    let mut sets: Vec<u32> = to.coordinates.iter().map(|(_, (set, _))| *set).collect();
    sets.sort_unstable();
    sets.dedup();
    for set in sets {
        let of_set = to.coordinates.iter().filter(|(_, (own, _))| *own == set);
        let values: Vec<_> = of_set.map(|(corner, (_, uv))| (Corner(*corner), *uv)).collect();
        let record = mesh.revalue_shared(Semantic::TexCoord(set), &values);
        records.extend(record.map(EditRecord::Revalue));
    }
    if !to.colours.is_empty() {
        let values: Vec<_> = to.colours.iter().map(|(c, rgb)| (Corner(*c), *rgb)).collect();
        let record = mesh.revalue_shared(Semantic::Color(0), &values);
        records.extend(record.map(EditRecord::Revalue));
    }
    records
}

/// All vertices under way, by slot.
struct Walk {
    n_steps: usize,
    has_own_normals: bool,
    places: Vec<Particle>,
    /// Empty unless they are unknowns.
    normals: Vec<Particle>,
    /// What else is unknown, if anything, and those under way.
    attributes: Option<Attributes>,
    coordinates: Vec<Particle>,
    colours: Vec<Particle>,
}

/// One place, normal, texture coordinate or colour under way.
#[derive(Clone, Copy, Debug, Default)]
struct Particle {
    from: DVec3,
    at: DVec3,
    momentum: DVec3,
    bend: DMat3,
    /// The sum of the last places.
    sum: DVec3,
    /// Least and greatest of each number.
    bounds: [DVec3; 2],
    /// The direction in which alone it moves.
    way: Option<DVec3>,
    /// 0 for a slot that no vertex uses, and where the vertex is locked.
    longest_step: f64,
}

impl Walk {
    fn new(
        mesh: &EditMesh,
        (unknowns, attributes): (Unknowns, Option<Attributes>),
        n_steps: usize,
    ) -> Self {
        let slots = || (0..mesh.n_vertex_slots() as u32).map(VertexId);
        let place = |v| {
            if mesh.is_locked(v) {
                Particle::new(mesh.position(v), 0.0)
            } else if mesh.is_used(v) {
                Particle::new(mesh.position(v), LONGEST_STEP * mesh.mean_edge_length(v))
            } else {
                Particle::default()
            }
        };
        let normal = |v| match stored_normal(mesh, v) {
            Some(normal) if mesh.is_locked(v) => Particle::new(normal, 0.0),
            Some(normal) if mesh.is_used(v) => Particle::new(normal, LONGEST_TURN),
            _ => Particle::default(),
        };
        let n_normals = if unknowns.normals { usize::MAX } else { 0 };
        let value = |u: &Unknown| Particle::of(u, mesh.is_locked(u.vertex));
        let values = |of: fn(&Attributes) -> &[Unknown]| -> Vec<Particle> {
            attributes.iter().flat_map(|a| of(a).iter().map(value)).collect()
        };
        Self {
            n_steps,
            has_own_normals: unknowns.has_own_normals,
            places: slots().map(place).collect(),
            normals: slots().take(n_normals).map(normal).collect(),
            coordinates: values(Attributes::coordinates),
            colours: values(Attributes::colours),
            attributes,
        }
    }

    /// Draws the model as it is now in a view set.
    fn look(&self, scene: &mut Scene, set: &ViewSet) -> Slopes {
        scene.redraw(&set.pictures.views, now(&self.places), !self.has_own_normals);
        scene.turn_normals(self.normals.iter().map(|p| p.at));
        if let Some(attributes) = &self.attributes {
            attributes.dress(scene, &now(&self.coordinates), &now(&self.colours));
        }
        slopes(scene, &set.reference, self.has_own_normals, self.attributes.as_ref())
    }

    fn all_mut(&mut self) -> [&mut Vec<Particle>; 4] {
        [&mut self.places, &mut self.normals, &mut self.coordinates, &mut self.colours]
    }

    /// One step of everything.
    fn step(&mut self, found: &Slopes, k: usize) {
        let share = if 2 * k > self.n_steps { 0.5 * SHARE } else { SHARE };
        let is_counted = k + self.n_last() >= self.n_steps;
        let found = [&found.places, &found.normals, &found.coordinates, &found.colours];
        for (particles, slopes) in self.all_mut().into_iter().zip(found) {
            for (particle, slope) in particles.iter_mut().zip(slopes) {
                particle.step(slope, k, share);
                if is_counted {
                    particle.sum += particle.at;
                }
            }
        }
    }

    fn n_last(&self) -> usize {
        ((MEAN_OVER * self.n_steps as f64) as usize).max(1)
    }

    /// Everything goes where it was in the mean over the last steps.
    fn come_to_rest(&mut self) {
        let n = self.n_last() as f64;
        for particle in self.all_mut().into_iter().flatten() {
            if particle.at != particle.from {
                particle.at = particle.sum / n;
            }
        }
        for particle in self.coordinates.iter_mut().chain(&mut self.colours) {
            particle.at = particle.at.as_vec3().as_dvec3();
        }
        if let Some(attributes) = &self.attributes {
            let mut coordinates = now(&self.coordinates);
            attributes.unfold(&mut coordinates);
            self.coordinates.iter_mut().zip(coordinates).for_each(|(p, at)| p.at = at);
        }
    }

    /// Where everything is that has moved.
    fn destination(&self) -> Destination {
        let moved = |p: &(usize, &Particle)| p.1.at != p.1.from;
        let places = self.places.iter().enumerate().filter(moved);
        let normals = self.normals.iter().enumerate().filter(moved);
        let (coordinates, colours) = match &self.attributes {
            Some(all) => (
                changed(all.coordinates(), &self.coordinates),
                changed(all.colours(), &self.colours),
            ),
            None => <_>::default(),
        };
        let on_texture = |(u, [x, y, _]): (Unknown, [f32; 3])| match u.semantic {
            Semantic::TexCoord(set) => Some((u.corner.0, (set, [x, y]))),
            _ => None,
        };
        Destination {
            places: places.map(|(i, p)| (i as u32, p.at)).collect(),
            normals: normals.map(|(i, p)| (i as u32, p.at.as_vec3().to_array())).collect(),
            coordinates: coordinates.into_iter().filter_map(on_texture).collect(),
            colours: colours.into_iter().map(|(u, rgb)| (u.corner.0, rgb)).collect(),
        }
    }
}

/// Those that have moved, and their values now.
fn changed(unknowns: &[Unknown], particles: &[Particle]) -> Vec<(Unknown, [f32; 3])> {
    let moved = unknowns.iter().zip(particles).filter(|(_, p)| p.at != p.from);
    moved.map(|(u, p)| (*u, p.at.as_vec3().to_array())).collect()
}

/// Where they are.
fn now(particles: &[Particle]) -> Vec<DVec3> {
    particles.iter().map(|p| p.at).collect()
}

impl Particle {
    fn new(at: DVec3, longest_step: f64) -> Self {
        Self {
            from: at,
            at,
            longest_step,
            bounds: [DVec3::NEG_INFINITY, DVec3::INFINITY],
            ..Self::default()
        }
    }

    fn of(unknown: &Unknown, is_locked: bool) -> Self {
        let longest_step = if is_locked { 0.0 } else { LONGEST_STEP * unknown.reach };
        let Unknown { at, bounds, way, .. } = *unknown;
        Self { bounds, way, ..Self::new(at, longest_step) }
    }

    fn step(&mut self, slope: &Slope, n_before: usize, share: f64) {
        let slope = self.way.map_or(*slope, |way| slope.along(way));
        let newest = 1.0 / (n_before as f64 + 1.0).min(HORIZON);
        self.bend = self.bend * (1.0 - newest) + slope.bend * newest;
        self.momentum = self.momentum * MOMENTUM + slope.gradient;
        let trace = self.bend.x_axis.x + self.bend.y_axis.y + self.bend.z_axis.z;
        let damped = self.bend + DMat3::from_diagonal(DVec3::splat(DAMPING * trace));
        let step = damped.inverse() * self.momentum * -share;
        if self.longest_step > 0.0 && trace > 0.0 && step.is_finite() {
            let [low, high] = self.bounds;
            self.at = (self.at + step.clamp_length_max(self.longest_step)).max(low).min(high);
        }
    }
}
