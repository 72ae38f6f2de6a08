//! What a collapse of an edge would disturb, summed up: the input of every placement.
//!
//! Everything is in the edge's own frame: origin at its middle, its length as unit. Both ends
//! then lie at ∓h with |h| = ½, and every triangle contains one of them, so its plane needs only
//! its normal: d = nᵀ(∓h). Nothing here loses precision far from the model's origin, and the sums
//! over the triangles at one vertex ([`Fan`]) serve all its edges.

use glam::DVec3;
use smallvec::SmallVec;

use super::quadratic::{Quadratic, Symmetric};
use crate::mesh::{EditMesh, FaceId, VertexId};

/// Longer lists than this are not merged to find what they share.
const MAX_MERGED: usize = 64;

/// Sums over triangles with a common vertex, model units.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Fan {
    /// Σ nnᵀ.
    matrix: Symmetric,
    /// Σ n.
    normal: DVec3,
}

impl Fan {
    /// The sums over all living triangles at a vertex.
    #[inline]
    pub(super) fn new(mesh: &EditMesh, vertex: VertexId) -> Self {
        let mut fan = Self::default();
        for &face in mesh.faces_around(vertex) {
            fan.add(mesh.area_normal(face));
        }
        fan
    }

    #[inline]
    fn add(&mut self, normal: DVec3) {
        self.matrix += Symmetric::outer(normal);
        self.normal += normal;
    }

    /// The sums over the triangles that hold both vertices.
    #[inline]
    fn shared(mesh: &EditMesh, a: VertexId, b: VertexId) -> Self {
        let mut shared = Self::default();
        let (at_a, at_b) = (mesh.faces_around(a), mesh.faces_around(b));
        if at_a.len().max(at_b.len()) > MAX_MERGED {
            mesh.edge_faces(a, b).iter().for_each(|&f| shared.add(mesh.area_normal(f)));
            return shared;
        }
        let (mut i, mut j) = (0, 0);
        let (mut found, mut n_found) = ([FaceId(0); 8], 0);
        // Both lists ascend. No branches in here: which is lower cannot be predicted.
        while let (Some(&f), Some(&g)) = (at_a.get(i), at_b.get(j)) {
            found[n_found % found.len()] = f;
            n_found += usize::from(f == g);
            i += usize::from(f <= g);
            j += usize::from(g <= f);
        }
        match found.get(..n_found) {
            Some(found) => found.iter().for_each(|&f| shared.add(mesh.area_normal(f))),
            None => mesh.edge_faces(a, b).iter().for_each(|&f| shared.add(mesh.area_normal(f))),
        }
        shared
    }
}

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
    /// Σ |nᵢ|², the size that |`normal`|² might have.
    pub(super) normal2: f64,
    /// Σ Vᵢ², the volume objective (equation 8).
    pub(super) volume: Quadratic,
}

impl Surroundings {
    /// The sums for the edge (a, b) from those at its ends; `None` if its length is zero or not
    /// finite.
    #[inline]
    pub(super) fn new(
        mesh: &EditMesh,
        [a, b]: [VertexId; 2],
        [at_a, at_b]: [&Fan; 2],
    ) -> Option<Self> {
        let (from, to) = (mesh.position(a), mesh.position(b));
        let edge = to - from;
        let length2 = edge.length_squared();
        let scale = 1.0 / length2;
        if !(scale.is_finite() && scale > 0.0) {
            return None;
        }
        let length = length2.sqrt();
        let h = edge * (0.5 / length);
        let shared = Fan::shared(mesh, a, b);
        // Products of two normals carry length⁴. The planes of shared triangles hold both ends:
        // they drop out of Σ dᵢ and Σ dᵢnᵢ.
        let scale2 = scale * scale / 18.0;
        let matrix = (at_a.matrix + at_b.matrix - shared.matrix) * scale2;
        let tilt = (at_b.matrix - at_a.matrix) * scale2;
        Some(Self {
            middle: from + edge * 0.5,
            length,
            h,
            normal: (at_a.normal + at_b.normal - shared.normal) * scale,
            offset: h.dot(at_b.normal - at_a.normal) * scale,
            normal2: matrix.trace() * 18.0,
            volume: Quadratic { a: matrix, b: tilt * h, c: h.dot(matrix * h) },
        })
    }

    /// From model space into the edge's frame.
    #[inline]
    pub(super) fn local(&self, position: DVec3) -> DVec3 {
        (position - self.middle) / self.length
    }
}

/// Sums over the boundary edges at either end of an edge, in the edge's frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Boundary {
    /// |Σ aⱼ|², boundary preservation (equation 13).
    pub(super) preservation: Quadratic,
    /// Σ |aⱼ|², boundary optimisation (equation 14).
    pub(super) optimisation: Quadratic,
}

/// The boundary edges at `a` or `b`, each counted once; `None` if there are none.
#[cold]
pub(super) fn boundary(
    mesh: &EditMesh,
    [a, b]: [VertexId; 2],
    around: &Surroundings,
) -> Option<Boundary> {
    let (mut edge_sum, mut cross_sum) = (DVec3::ZERO, DVec3::ZERO);
    let mut optimisation = Quadratic::default();
    let mut is_empty = true;
    for (end, other) in [(a, None), (b, Some(a))] {
        let (faces, far_ends) = (mesh.faces_around(end), far_ends(mesh, end));
        for &face in faces {
            let [next, last] = mesh.turned_to(face, end);
            for [from, to] in [[end, next], [last, end]] {
                let far = if from == end { to } else { from };
                if Some(far) == other || !occurs_once(&far_ends, far) {
                    continue;
                }
                let [x0, x1] = [from, to].map(|v| around.local(mesh.position(v)));
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

/// The far end of each side at a vertex, ascending; twice where two triangles share the side.
fn far_ends(mesh: &EditMesh, vertex: VertexId) -> SmallVec<[VertexId; 32]> {
    let faces = mesh.faces_around(vertex).iter();
    let mut far_ends: SmallVec<_> = faces.flat_map(|&f| mesh.turned_to(f, vertex)).collect();
    far_ends.sort_unstable();
    far_ends
}

fn occurs_once(ascending: &[VertexId], vertex: VertexId) -> bool {
    let at = ascending.partition_point(|&v| v < vertex);
    ascending.get(at) == Some(&vertex) && ascending.get(at + 1) != Some(&vertex)
}

/// |½(E × x − C)|² as a function of x.
fn swept_area2(e: DVec3, c: DVec3) -> Quadratic {
    let identity = Symmetric::scaled_identity(e.length_squared());
    Quadratic {
        a: (identity - Symmetric::outer(e)) * 0.5,
        b: c.cross(e) * 0.5,
        c: c.length_squared() * 0.5,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{Mesh, shapes};

    fn surroundings(mesh: &EditMesh, a: VertexId, b: VertexId) -> Option<Surroundings> {
        Surroundings::new(mesh, [a, b], [&Fan::new(mesh, a), &Fan::new(mesh, b)])
    }

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
                let s = surroundings(&mesh, a, b).unwrap();
                let x = DVec3::new(0.3, -0.7, 0.2);
                let expected = by_definition(&mesh, a, b, x);
                let boundary = boundary(&mesh, [a, b], &s)
                    .map_or([0.0; 2], |b| [b.preservation.value(x), b.optimisation.value(x)]);
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
        assert!(surroundings(&mesh, VertexId(0), VertexId(1)).is_none());
    }
}
