//! What a collapse of an edge would disturb, summed up: the input of every placement.
//!
//! Everything is in the edge's own frame: origin at its middle, its length as unit. Both ends
//! then lie at ∓h with |h| = ½, and every triangle contains one of them, so its plane needs only
//! its normal: d = nᵀ(∓h). Nothing here loses precision far from the model's origin.

use glam::DVec3;

use super::quadratic::{Quadratic, Symmetric};
use crate::mesh::{EditMesh, FaceId, VertexId};

/// Sums over the triangles T at either end of an edge, in the edge's frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surroundings {
    /// The middle of the edge, model space.
    pub(super) middle: DVec3,
    /// The length of the edge, model units.
    pub(super) length: f64,
    /// Half the edge: the ends are at −h and +h.
    pub(super) h: DVec3,
    /// Σ nᵢ: volume is preserved on the plane `normal`ᵀx = `offset`.
    pub(super) normal: DVec3,
    /// Σ dᵢ.
    pub(super) offset: f64,
    /// Σ |nᵢ|², the size that `normal` might have.
    pub(super) normal2: f64,
    /// Σ Vᵢ², the volume objective (equation 8).
    pub(super) volume: Quadratic,
    /// The boundary at the two ends, if there is one.
    pub(super) boundary: Option<Boundary>,
}

/// Sums over the boundary edges at either end of an edge.
#[derive(Clone, Copy, Debug)]
pub(super) struct Boundary {
    /// |Σ aⱼ|², boundary preservation (equation 13).
    pub(super) preservation: Quadratic,
    /// Σ |aⱼ|², boundary optimisation (equation 14).
    pub(super) optimisation: Quadratic,
}

/// Sums over the triangles at one end.
#[derive(Default)]
struct Fan {
    matrix: Symmetric,
    normal: DVec3,
    /// Zero if every neighbour follows the end in one triangle and precedes it in another.
    balance: u64,
}

/// The sums for the edge (a, b); `None` if its length is zero or not finite.
#[inline]
pub(super) fn gather(mesh: &EditMesh, a: VertexId, b: VertexId) -> Option<Surroundings> {
    let (from, to) = (mesh.position(a), mesh.position(b));
    let edge = to - from;
    let length = edge.length();
    let scale = 1.0 / (length * length);
    if !(scale.is_finite() && scale > 0.0) {
        return None;
    }
    // Triangles at both ends are summed with the first.
    let at_a = fan(mesh, a, None, scale);
    let at_b = fan(mesh, b, Some(a), scale);
    let h = edge / length * 0.5;
    let middle = from + edge * 0.5;
    let (ha, hb) = (at_a.matrix * h, at_b.matrix * h);
    let volume = Quadratic { a: at_a.matrix + at_b.matrix, b: hb - ha, c: h.dot(ha + hb) };
    let is_open = at_a.balance != 0 || at_b.balance != 0;
    let frame = Frame { middle, scale: 1.0 / length };
    Some(Surroundings {
        middle,
        length,
        h,
        normal: at_a.normal + at_b.normal,
        offset: h.dot(at_b.normal - at_a.normal),
        normal2: volume.a.trace(),
        volume: volume * (1.0 / 18.0),
        boundary: if is_open { boundary(mesh, a, b, frame) } else { None },
    })
}

/// Sums the triangles at `end`, leaving out the values of those that also hold `other`.
#[inline]
fn fan(mesh: &EditMesh, end: VertexId, other: Option<VertexId>, scale: f64) -> Fan {
    let mut fan = Fan::default();
    for &face in mesh.faces_around(end) {
        let [next, last] = turned_to(mesh, face, end);
        fan.balance = fan.balance.wrapping_add(mixed(next)).wrapping_sub(mixed(last));
        if other.is_none_or(|o| next != o && last != o) {
            let normal = mesh.area_normal(face) * scale;
            fan.matrix += Symmetric::outer(normal);
            fan.normal += normal;
        }
    }
    fan
}

/// The other two vertices of a triangle in its direction, from `vertex` on.
#[inline]
fn turned_to(mesh: &EditMesh, face: FaceId, vertex: VertexId) -> [VertexId; 2] {
    let [p, q, r] = mesh.vertices_of(face);
    if p == vertex {
        [q, r]
    } else if q == vertex {
        [r, p]
    } else {
        [p, q]
    }
}

/// A vertex id spread over 64 bits, such that sums of different sets differ: a balance of zero
/// stands for a closed fan. (Should chance ever bring 2⁻⁶⁴ about, one vertex is placed as if it
/// were interior.) Fans that are open, or not oriented alike, are then counted exactly.
#[inline]
fn mixed(vertex: VertexId) -> u64 {
    let x = u64::from(vertex.0).wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    (x ^ (x >> 32)).wrapping_mul(x | 1)
}

/// From model space into an edge's frame.
#[derive(Clone, Copy)]
struct Frame {
    middle: DVec3,
    scale: f64,
}

impl Frame {
    fn local(self, p: DVec3) -> DVec3 {
        (p - self.middle) * self.scale
    }
}

/// The boundary edges at `a` or `b`, each counted once; `None` if there are none.
#[cold]
fn boundary(mesh: &EditMesh, a: VertexId, b: VertexId, frame: Frame) -> Option<Boundary> {
    let (mut edge_sum, mut cross_sum) = (DVec3::ZERO, DVec3::ZERO);
    let mut optimisation = Quadratic::default();
    let mut is_empty = true;
    for (end, other) in [(a, None), (b, Some(a))] {
        let faces = mesh.faces_around(end);
        for &face in faces {
            let [next, last] = turned_to(mesh, face, end);
            for [from, to] in [[end, next], [last, end]] {
                let far = if from == end { to } else { from };
                let holds_far = |&&f: &&FaceId| mesh.vertices_of(f).contains(&far);
                if Some(far) == other || faces.iter().filter(holds_far).count() != 1 {
                    continue;
                }
                let [x0, x1] = [from, to].map(|v| frame.local(mesh.position(v)));
                let (edge, cross) = (x1 - x0, x1.cross(x0));
                edge_sum += edge;
                cross_sum += cross;
                optimisation = optimisation + swept_area2(edge, cross);
                is_empty = false;
            }
        }
    }
    let preservation = swept_area2(edge_sum, cross_sum);
    (!is_empty).then_some(Boundary { preservation, optimisation })
}

/// |½(E × x − C)|² as a function of x.
fn swept_area2(e: DVec3, c: DVec3) -> Quadratic {
    let identity = Symmetric::scaled_identity(e.length_squared());
    Quadratic {
        a: (identity + Symmetric::outer(e) * -1.0) * 0.5,
        b: c.cross(e) * 0.5,
        c: c.length_squared() * 0.5,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{Mesh, shapes};

    /// The sums again, straight from the definitions in section 4 and 6 of the paper.
    fn by_definition(mesh: &EditMesh, a: VertexId, b: VertexId, x: DVec3) -> [f64; 4] {
        let middle = (mesh.position(a) + mesh.position(b)) * 0.5;
        let length = mesh.position(a).distance(mesh.position(b));
        let local = |v: VertexId| (mesh.position(v) - middle) / length;
        let (mut volume, mut volume2) = (0.0, 0.0);
        let (mut area, mut area2) = (DVec3::ZERO, 0.0);
        for f in mesh.faces() {
            let vertices = mesh.vertices_of(f);
            if !vertices.contains(&a) && !vertices.contains(&b) {
                continue;
            }
            let [p, q, r] = vertices.map(|v| local(v) - x);
            let swept = p.dot(q.cross(r)) / 6.0;
            volume += swept;
            volume2 += swept * swept;
            for (s, t) in [(0, 1), (1, 2), (2, 0)] {
                let ends = [vertices[s], vertices[t]];
                let touches = ends.contains(&a) || ends.contains(&b);
                if touches && mesh.is_boundary_edge(ends[0], ends[1]) {
                    let swept = (local(ends[0]) - x).cross(local(ends[1]) - x) * 0.5;
                    area += swept;
                    area2 += swept.length_squared();
                }
            }
        }
        [volume, volume2, area.length_squared(), area2]
    }

    #[test]
    fn sums_agree_with_their_definitions() {
        for (shape, offset) in [
            (shapes::terrain(6, 0.3), DVec3::ZERO),
            (shapes::terrain(5, 0.3), DVec3::new(300.0, -20.0, 7.0)),
            (shapes::torus(7, 6, 0.1), DVec3::ONE),
        ] {
            let moved = shape.positions.iter().map(|&p| p + offset).collect();
            let mesh = EditMesh::new(Mesh::from_parts(moved, shape.faces)).unwrap();
            let edges = crate::mesh::EdgeTable::new(&mesh);
            for edge in edges.edges() {
                let [a, b] = edges.ends(edge);
                let s = gather(&mesh, a, b).unwrap();
                let x = DVec3::new(0.3, -0.7, 0.2);
                let expected = by_definition(&mesh, a, b, x);
                let boundary = s.boundary.map_or([0.0; 2], |b| {
                    [b.preservation.value(x), b.optimisation.value(x)]
                });
                let swept = -(s.normal.dot(x) - s.offset) / 6.0;
                let found = [swept, s.volume.value(x), boundary[0], boundary[1]];
                for (found, expected) in found.into_iter().zip(expected) {
                    assert!((found - expected).abs() < 1e-9 * (1.0 + expected.abs()));
                }
            }
        }
    }

    #[test]
    fn an_edge_without_length_has_no_frame() {
        let positions = vec![DVec3::ONE, DVec3::ONE, DVec3::X];
        let mesh = EditMesh::new(Mesh::from_parts(positions, vec![[0, 1, 2]])).unwrap();
        assert!(gather(&mesh, VertexId(0), VertexId(1)).is_none());
    }
}
