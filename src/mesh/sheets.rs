//! Cutting a surface apart into sheets: what more than two triangles share is shared by pairs of
//! them instead.
//!
//! Round an edge of more than two triangles, two are of one sheet if what lies between them is
//! inside of both, so that parts which touch come apart as parts, and what is flat, with its two
//! sides, comes off. A triangle that finds no partner gets a border there. Triangles which only a
//! vertex joins come apart, too.
//!
//! Invariants:
//! 1. triangles keep their ids and corners' order, and vertices their ids; nothing looks different;
//! 2. no edge of the result has more than two triangles, and the triangles at a vertex are one fan.

use std::collections::BTreeMap;

use glam::DVec3;

use super::model::{AttributeLayer, Mesh};

/// A triangle at an edge.
#[derive(Clone, Copy)]
struct Wing {
    /// The first of its corners, `3 * face`.
    face: u32,
    /// Its corners at the edge's lower and higher vertex.
    corners: [u32; 2],
    /// Whether it has the edge from the lower vertex to the higher one.
    is_forward: bool,
}

impl Mesh {
    /// Cuts the surface apart where it is not one sheet. O(triangles · log triangles).
    #[must_use]
    pub fn cut_into_sheets(mut self) -> Self {
        let mut fans = fans_of_sheets(&self);
        let mut first_fan = vec![u32::MAX; self.positions.len()];
        let mut copies = BTreeMap::new();
        let mut wedges = Vec::new();
        for corner in 0..3 * self.faces.len() as u32 {
            let (face, k) = (corner as usize / 3, corner as usize % 3);
            let (fan, vertex) = (fans.root(corner), self.faces[face][k]);
            let first = &mut first_fan[vertex as usize];
            if *first == u32::MAX {
                *first = fan;
            }
            if *first == fan {
                continue;
            }
            self.faces[face][k] = *copies.entry(fan).or_insert_with(|| {
                self.positions.push(self.positions[vertex as usize]);
                self.positions.len() as u32 - 1
            });
            if !self.layers.is_empty() {
                wedges.push((corner, fan));
            }
        }
        self.copy_wedges(&wedges);
        self
    }

    /// Gives corners of fans that have a vertex of their own wedges of their own.
    fn copy_wedges(&mut self, corners: &[(u32, u32)]) {
        let mut copies = BTreeMap::new();
        for &(corner, fan) in corners {
            let wedge = &mut self.face_wedges[corner as usize / 3][corner as usize % 3];
            let old = *wedge;
            *wedge = *copies.entry((fan, old)).or_insert_with(|| {
                let n = self.layers[0].values.len() / self.layers[0].width;
                self.layers.iter_mut().for_each(|layer| push_copy(layer, old as usize));
                n as u32
            });
        }
    }
}

/// Which corners share a vertex once the surface is cut.
fn fans_of_sheets(mesh: &Mesh) -> Fans {
    let edges = wings_of_edges(mesh);
    let n_corners = 3 * mesh.faces.len();
    let pairs: Vec<_> = edges.iter().map(|(edge, wings)| partners(mesh, *edge, wings)).collect();
    let mut fans = Fans::of(n_corners, pairs.iter().flatten());
    // Where a sheet meets itself at both ends of an edge, the edge is whole still: it becomes a
    // border, which opens each of the two fans at it.
    let mut is_whole = |wings: &Vec<Wing>| {
        let mut ends: Vec<_> = wings.iter().map(|w| w.corners.map(|c| fans.root(c))).collect();
        ends.sort_unstable();
        ends.windows(3).any(|three| three[0] == three[2])
    };
    let kept: Vec<_> = edges.values().map(|wings| !is_whole(wings)).collect();
    let is_kept = pairs.iter().zip(kept).filter(|(_, is_kept)| *is_kept);
    Fans::of(n_corners, is_kept.flat_map(|(pairs, _)| pairs))
}

fn push_copy(layer: &mut AttributeLayer, wedge: usize) {
    let at = wedge * layer.width;
    layer.values.extend_from_within(at..at + layer.width);
}

/// The triangles at each edge, by its vertices, the lower first.
fn wings_of_edges(mesh: &Mesh) -> BTreeMap<[u32; 2], Vec<Wing>> {
    let mut edges: BTreeMap<[u32; 2], Vec<Wing>> = BTreeMap::new();
    for (f, vertices) in mesh.faces.iter().enumerate() {
        let face = 3 * f as u32;
        for k in 0..3 {
            let next = (k + 1) % 3;
            let is_forward = vertices[k] < vertices[next];
            let [low, high] = if is_forward { [k, next] } else { [next, k] };
            let corners = [face + low as u32, face + high as u32];
            let wings = edges.entry([vertices[low], vertices[high]]).or_default();
            wings.push(Wing { face, corners, is_forward });
        }
    }
    edges
}

/// Which triangles at an edge are of one sheet.
fn partners(mesh: &Mesh, edge: [u32; 2], wings: &[Wing]) -> Vec<[Wing; 2]> {
    if let [a, b] = *wings {
        return vec![[a, b]];
    }
    let mut wings = wings.to_vec();
    let [low, high] = edge.map(|v| mesh.positions[v as usize]);
    let axis = (high - low).normalize_or_zero();
    let side = axis.any_orthonormal_vector();
    let angle = |wing: &Wing| {
        let face = mesh.faces[wing.face as usize / 3];
        let apex = face.iter().find(|v| !edge.contains(v)).copied().unwrap_or(edge[0]);
        turn(mesh.positions[apex as usize] - low, side, axis.cross(side))
    };
    wings.sort_by(|a, b| {
        angle(a)
            .total_cmp(&angle(b))
            .then(a.is_forward.cmp(&b.is_forward))
            .then(a.face.cmp(&b.face))
    });
    let mut pairs = Vec::new();
    // Inside is before a forward triangle and behind a backward one, in the direction of the turn.
    let is_pair = |a: &Wing, b: &Wing| !a.is_forward && b.is_forward;
    let mut i = 0;
    while wings.len() > 1 && i < wings.len() {
        let next = (i + 1) % wings.len();
        if !is_pair(&wings[i], &wings[next]) {
            i += 1;
            continue;
        }
        pairs.push([wings[i], wings[next]]);
        wings.retain(|w| pairs.last().is_none_or(|p| p.iter().all(|p| p.face != w.face)));
        // What was before the two may have its partner behind them now.
        i = i.min(next).saturating_sub(1);
    }
    pairs
}

/// Grows with the angle of `direction` from `x` towards `y`, from -2 to 2.
fn turn(direction: DVec3, x: DVec3, y: DVec3) -> f64 {
    let (u, v) = (direction.dot(x), direction.dot(y));
    let length = u.abs() + v.abs();
    let share = if length > 0.0 { u / length } else { 1.0 };
    if v < 0.0 { share - 1.0 } else { 1.0 - share }
}

/// Sets of corners that share a vertex, each known by the lowest of them.
struct Fans(Vec<u32>);

impl Fans {
    /// Those of `n_corners` corners, where these pairs of triangles share both ends of an edge.
    fn of<'a>(n_corners: usize, pairs: impl Iterator<Item = &'a [Wing; 2]>) -> Self {
        let mut fans = Self((0..n_corners as u32).collect());
        for [a, b] in pairs {
            a.corners.iter().zip(b.corners).for_each(|(a, b)| fans.join(*a, b));
        }
        fans
    }

    fn root(&mut self, mut corner: u32) -> u32 {
        while self.0[corner as usize] != corner {
            let above = self.0[self.0[corner as usize] as usize];
            self.0[corner as usize] = above;
            corner = above;
        }
        corner
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{EditMesh, Semantic, shapes};

    /// Two octahedra with the edge from (1, 0, 0) to (0, 1, 0) in common.
    fn two_that_share_an_edge() -> Mesh {
        let mut mesh = shapes::octahedron();
        let centre = DVec3::new(1.0, 1.0, 0.0);
        let other = mesh.clone();
        let mut ids = Vec::new();
        for p in &other.positions {
            let at = centre - *p;
            ids.push(mesh.positions.iter().position(|q| *q == at).unwrap_or_else(|| {
                mesh.positions.push(at);
                mesh.positions.len() - 1
            }) as u32);
        }
        // Seen through its centre a triangle has the other direction.
        mesh.faces.extend(other.faces.iter().map(|&[a, b, c]| [c, b, a].map(|v| ids[v as usize])));
        mesh
    }

    fn n_vertices(mesh: &Mesh) -> usize {
        EditMesh::new(mesh.clone()).unwrap().n_vertices()
    }

    fn check(mesh: Mesh, n_added: usize) {
        let cut = mesh.clone().cut_into_sheets();
        assert_eq!(n_vertices(&cut), n_vertices(&mesh) + n_added);
        let places = |m: &Mesh| -> Vec<[DVec3; 3]> {
            m.faces.iter().map(|f| f.map(|v| m.positions[v as usize])).collect()
        };
        assert_eq!(places(&cut), places(&mesh));
        let wings = wings_of_edges(&cut);
        assert!(wings.values().all(|wings| wings.len() <= 2));
        assert_eq!(cut.clone().cut_into_sheets(), cut, "once is enough");
        EditMesh::new(cut).unwrap().validate().unwrap();
    }

    #[test]
    fn what_is_one_sheet_stays() {
        for mesh in [shapes::torus(8, 6, 0.2), shapes::terrain(3, 0.1), Mesh::default()] {
            assert_eq!(mesh.clone().cut_into_sheets(), mesh);
        }
    }

    #[test]
    fn parts_that_touch_come_apart_as_parts() {
        let mesh = two_that_share_an_edge();
        check(mesh.clone(), 2);
        let cut = mesh.cut_into_sheets();
        let first: Vec<u32> = cut.faces[..8].as_flattened().to_vec();
        assert!(cut.faces[8..].as_flattened().iter().all(|v| !first.contains(v)));
    }

    #[test]
    fn a_fin_comes_off() {
        let mut mesh = shapes::octahedron();
        mesh.positions.push(DVec3::new(1.0, 1.0, 0.0));
        mesh.faces.push([1, 2, 6]);
        check(mesh.clone(), 2);
        mesh.faces.push([6, 2, 1]);
        check(mesh, 2);
    }

    #[test]
    fn a_wall_inside_comes_off_if_it_has_two_sides() {
        let mut mesh = shapes::octahedron();
        mesh.faces.push([0, 1, 3]);
        // With one side it makes a tent, of which one half of the octahedron gets a border.
        check(mesh.clone(), 1);
        mesh.faces.push([3, 1, 0]);
        check(mesh, 3);
    }

    #[test]
    fn two_fans_at_one_vertex_come_apart() {
        let mut mesh = shapes::octahedron();
        let n = mesh.positions.len() as u32;
        mesh.positions.extend([DVec3::new(2.0, 1.0, 0.0), DVec3::new(2.0, -1.0, 0.0)]);
        mesh.faces.push([1, n, n + 1]);
        check(mesh, 1);
    }

    #[test]
    fn vertices_that_are_new_have_wedges_of_their_own() {
        let mut mesh = two_that_share_an_edge();
        mesh.face_wedges.clone_from(&mesh.faces);
        let values: Vec<f32> = (0..2 * mesh.positions.len()).map(|i| i as f32).collect();
        mesh.layers = vec![AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values }];
        let cut = mesh.clone().cut_into_sheets();
        cut.check().unwrap();
        assert_eq!(cut.n_wedges(), mesh.n_wedges() + 2);
        assert_eq!(cut.face_wedges, cut.faces, "as before: one wedge for each vertex");
        for (new, old) in cut.face_wedges.iter().zip(&mesh.face_wedges) {
            for (new, old) in new.iter().zip(old) {
                let value = |m: &Mesh, w: u32| m.layers[0].values[2 * w as usize..][..2].to_vec();
                assert_eq!(value(&cut, *new), value(&mesh, *old));
            }
        }
    }

    #[test]
    fn random_triangles_become_sheets() {
        // Over few vertices: many triangles at an edge, both windings, all in one plane or on a line.
        let places: Vec<DVec3> =
            (0..7).map(|i| DVec3::new(f64::from(i % 3), f64::from(i / 3), 0.0)).collect();
        let mut state = 1u64;
        let mut next = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as u32 % 7
        };
        for _ in 0..200 {
            let drawn: Vec<[u32; 3]> = (0..20).map(|_| [next(), next(), next()]).collect();
            let is_one = |f: &&[u32; 3]| f[0] != f[1] && f[1] != f[2] && f[0] != f[2];
            let faces = drawn.iter().filter(is_one).copied().collect();
            let mesh = Mesh::from_parts(places.clone(), faces);
            let n_added = n_vertices(&mesh.clone().cut_into_sheets()) - n_vertices(&mesh);
            check(mesh, n_added);
        }
    }
}
