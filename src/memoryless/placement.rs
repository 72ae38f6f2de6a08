//! Where the vertex of a collapsed edge goes and what it costs (sections 3 to 6).

use glam::DVec3;

use super::constraints::{Constraints, MIN_ROW2};
use super::gather::{Fan, Surroundings, boundary};
use super::params::{Params, Start};
use super::quadratic::{Quadratic, Symmetric};
use crate::mesh::{EditMesh, FaceId, VertexId};

/// A vertex further from the edge's middle than this many radii of its neighbourhood is not
/// believed: nearly parallel planes meet anywhere.
const MAX_RADII: f64 = 2.0;

/// The place and the price of a collapse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Where the vertex goes, model space.
    pub to: DVec3,
    /// f_C = λ Σ V² + (1 − λ) L² Σ a² (equation 11), length units to the sixth.
    pub cost: f64,
}

/// Memory that evaluations reuse, so that they allocate nothing.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    ring: Vec<VertexId>,
}

/// The placement for collapsing the edge (a, b), whether or not that is legal. `None` if the two
/// share no triangle.
///
/// Coincident ends collapse in place at no cost, and those of which one is locked at that end.
pub fn placement(
    mesh: &EditMesh,
    a: VertexId,
    b: VertexId,
    params: &Params,
    scratch: &mut Scratch,
) -> Option<Placement> {
    let exists = !mesh.edge_faces(a, b).is_empty();
    let fans = [Fan::new(mesh, a), Fan::new(mesh, b)];
    exists.then(|| placement_between(mesh, [a, b], [&fans[0], &fans[1]], params, scratch))
}

/// As [`placement`], of an edge that exists, from the sums at its ends.
#[inline]
pub(super) fn placement_between(
    mesh: &EditMesh,
    ends: [VertexId; 2],
    fans: [&Fan; 2],
    params: &Params,
    scratch: &mut Scratch,
) -> Placement {
    let fixed = mesh.fixed_place(ends);
    let Some(around) = Surroundings::new(mesh, ends, fans) else {
        return Placement { to: fixed.unwrap_or_else(|| mesh.position(ends[0])), cost: 0.0 };
    };
    let mut cost = around.volume * params.lambda;
    let is_closed = ends.iter().all(|&end| mesh.is_closed_fan(end));
    let boundary = if is_closed { None } else { boundary(mesh, ends, &around) };
    if let Some(boundary) = &boundary {
        // f_C in the edge's frame, where L = 1.
        cost = cost + boundary.optimisation * (1.0 - params.lambda);
    }
    let preservation = boundary.as_ref().map(|b| &b.preservation);
    let mut place = Place { mesh, ends, around: &around, cost: &cost, preservation, scratch };
    let x = fixed.map_or_else(|| place.find(params), |at| around.local(at));
    let length2 = around.length * around.length;
    let cost = cost.value(x) * (length2 * length2 * length2);
    Placement { to: fixed.unwrap_or(around.middle + x * around.length), cost }
}

/// What decides where a vertex goes, in the edge's frame.
struct Place<'a> {
    mesh: &'a EditMesh,
    ends: [VertexId; 2],
    around: &'a Surroundings,
    /// f_C.
    cost: &'a Quadratic,
    /// Boundary preservation, where there is a boundary.
    preservation: Option<&'a Quadratic>,
    scratch: &'a mut Scratch,
}

impl Place<'_> {
    /// The position in the edge's frame.
    #[inline]
    fn find(&mut self, params: &Params) -> DVec3 {
        let keeps_volume = params.scheme.keeps_volume;
        let start = match params.scheme.start {
            Start::Optimum => self.optimum(keeps_volume),
            Start::Midpoint => self.project(DVec3::ZERO, keeps_volume),
            Start::RandomEnd => self.project(self.random_end(params.seed), keeps_volume),
            Start::BetterEnd => self.project(self.better_end(), keeps_volume),
        };
        match start {
            Some(x) if self.is_near(x) => x,
            _ => self.fallback(keeps_volume),
        }
    }

    /// The point nearest to the middle that keeps the volume, if that is near; else the middle.
    #[cold]
    fn fallback(&self, keeps_volume: bool) -> DVec3 {
        let projected = self.project(DVec3::ZERO, keeps_volume);
        projected.filter(|&x| self.is_near(x)).unwrap_or(DVec3::ZERO)
    }

    /// Constraints in the paper's order: volume and boundary preservation, cost, shape.
    #[inline]
    fn optimum(&mut self, keeps_volume: bool) -> Option<DVec3> {
        let mut constraints = Constraints::default();
        if keeps_volume {
            let around = self.around;
            constraints.add(around.normal, around.offset, around.normal2);
        }
        if let Some(preservation) = self.preservation {
            constraints.minimise(preservation);
        }
        constraints.minimise(self.cost);
        if !constraints.is_full() {
            constraints.minimise(&self.shape());
        }
        constraints.solve()
    }

    /// The point nearest to `x` that keeps the volume: `x` itself where any does.
    #[inline]
    fn project(&self, x: DVec3, keeps_volume: bool) -> Option<DVec3> {
        let Surroundings { normal, offset, normal2, .. } = *self.around;
        let length2 = normal.length_squared();
        if !keeps_volume || length2 <= MIN_ROW2 * normal2 {
            return Some(x);
        }
        let x = x + normal * ((offset - normal.dot(x)) / length2);
        x.is_finite().then_some(x)
    }

    fn better_end(&self) -> DVec3 {
        let h = self.around.h;
        if self.cost.value(-h) <= self.cost.value(h) { -h } else { h }
    }

    fn random_end(&self, seed: u64) -> DVec3 {
        let [a, b] = self.ends.map(|v| u64::from(v.0));
        let mut bits = seed ^ (a.min(b) << 32 | a.max(b));
        for _ in 0..2 {
            bits = (bits ^ (bits >> 31)).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        }
        if (bits >> 63 == 0) == (a < b) { -self.around.h } else { self.around.h }
    }

    /// Σ |x − xᵢ|² over the ring (equation 10).
    #[cold]
    fn shape(&mut self) -> Quadratic {
        self.find_ring();
        let (mut n, mut sum) = (0.0, DVec3::ZERO);
        for i in 0..self.scratch.ring.len() {
            sum += self.local(self.scratch.ring[i]);
            n += 1.0;
        }
        Quadratic { a: Symmetric::scaled_identity(2.0 * n), b: sum * 2.0, c: 0.0 }
    }

    /// Whether a position is within reach of the neighbourhood.
    #[inline]
    fn is_near(&self, x: DVec3) -> bool {
        // The ends belong to the neighbourhood, so its radius is at least ½.
        let distance2 = x.length_squared();
        distance2 <= 0.25 * MAX_RADII * MAX_RADII || self.is_within_reach(distance2)
    }

    #[cold]
    fn is_within_reach(&self, distance2: f64) -> bool {
        let reaches = |&face: &FaceId| {
            let vertices = self.mesh.vertices_of(face);
            let radius2 = vertices.map(|v| self.local(v).length_squared());
            radius2.iter().any(|r| r * MAX_RADII * MAX_RADII >= distance2)
        };
        self.ends.iter().any(|&end| self.mesh.faces_around(end).iter().any(reaches))
    }

    fn local(&self, vertex: VertexId) -> DVec3 {
        self.around.local(self.mesh.position(vertex))
    }

    /// The vertices that share a triangle with an end, the ends left out.
    fn find_ring(&mut self) {
        let ring = &mut self.scratch.ring;
        ring.clear();
        for end in self.ends {
            for &face in self.mesh.faces_around(end) {
                let vertices = self.mesh.vertices_of(face).into_iter();
                ring.extend(vertices.filter(|v| !self.ends.contains(v)));
            }
        }
        ring.sort_unstable();
        ring.dedup();
    }
}

/// Whether collapsing (a, b) to `to` would turn a surviving triangle by more than the angle with
/// cosine `min_cos`, or flatten it to nothing. Triangles without area may turn as they like.
pub fn turns_too_far(mesh: &EditMesh, [a, b]: [VertexId; 2], to: DVec3, min_cos: f64) -> bool {
    let turns = |face: FaceId, end: VertexId, other: VertexId| {
        let [next, last] = mesh.turned_to(face, end);
        if next == other || last == other {
            return false;
        }
        let before = mesh.area_normal(face);
        let after = (mesh.position(next) - to).cross(mesh.position(last) - to);
        let size2 = before.length_squared();
        size2 > 0.0 && before.dot(after) <= min_cos * (size2.sqrt() * after.length())
    };
    [(a, b), (b, a)].into_iter().any(|(end, other)| {
        min_cos > -1.0 && mesh.faces_around(end).iter().any(|&f| turns(f, end, other))
    })
}
