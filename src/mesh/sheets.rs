//! Cutting a surface apart into sheets: what more than two triangles share is shared by pairs of
//! them instead.
//!
//! Round an edge of more than two triangles, two are of one sheet if what lies between them is inside
//! of both: parts that touch come apart as parts, walls inside and fins come off, and what is flat, with
//! its two sides, falls apart into its triangles (see `cluster.rs` for what that is worth). Where both ends
//! of an edge would stay whole, its triangles are not of one sheet. Triangles which only a vertex joins
//! come apart, too.
//!
//! Invariants:
//! 1. triangles keep their ids and corners' order, and vertices their ids; nothing looks different;
//! 2. no edge of the result has more than two triangles, and the triangles at a vertex are one fan.
//!
//! What is closed stays closed, but for edges whose triangles go round them in no order of outside and
//! inside, and for some where a sheet meets itself at both ends.

use std::collections::BTreeMap;

use glam::DVec3;
use smallvec::SmallVec;

use super::model::{AttributeLayer, Mesh};

/// A triangle at an edge.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Wing {
    /// The edge's lower and higher vertex.
    edge: [u32; 2],
    /// The triangle's corners at them.
    corners: [u32; 2],
    /// Whether it has the edge from the lower vertex to the higher one.
    is_forward: bool,
}

impl Mesh {
    /// Cuts the surface apart where it is not one sheet. O(triangles · log triangles), with some 90
    /// bytes a triangle.
    #[must_use]
    pub fn cut_into_sheets(mut self) -> Self {
        let mut fans = fans_of_sheets(&self);
        let (n_vertices, n_wedges) = (self.positions.len(), self.n_wedges());
        let Self { positions, faces, face_wedges, layers, .. } = &mut self;
        own_ids(faces, n_vertices, &mut fans, |v| positions.push(positions[v]));
        let copy_wedge = |w| layers.iter_mut().for_each(|layer| push_copy(layer, w));
        own_ids(face_wedges, n_wedges, &mut fans, copy_wedge);
        self
    }
}

/// Gives every fan ids of its own: those that another has already are copied.
fn own_ids(corners: &mut [[u32; 3]], n_ids: usize, fans: &mut Fans, mut copy: impl FnMut(usize)) {
    let mut owners = vec![u32::MAX; n_ids];
    let mut copies = BTreeMap::new();
    let mut n_ids = n_ids as u32;
    for (corner, id) in corners.as_flattened_mut().iter_mut().enumerate() {
        let (fan, old) = (fans.root(corner as u32), *id);
        let owner = &mut owners[old as usize];
        if *owner == u32::MAX {
            *owner = fan;
        }
        if *owner != fan {
            *id = *copies.entry((fan, old)).or_insert_with(|| {
                copy(old as usize);
                n_ids += 1;
                n_ids - 1
            });
        }
    }
}

/// Which corners share a vertex once the surface is cut.
fn fans_of_sheets(mesh: &Mesh) -> Fans {
    let wings = wings_by_edge(mesh);
    let edges = || wings.chunk_by(|a, b| a.edge == b.edge);
    let mut fans = Fans::of(mesh, edges());
    // Where a sheet meets itself at both ends of an edge, the edge is whole still: it joins nothing,
    // which opens the two fans at it.
    let mut is_whole = |wings: &[Wing]| {
        let mut ends: Vec<_> = wings.iter().map(|w| w.corners.map(|c| fans.root(c))).collect();
        ends.sort_unstable();
        ends.windows(3).any(|three| three[0] == three[2])
    };
    let is_kept: Vec<bool> = edges().map(|wings| wings.len() < 3 || !is_whole(wings)).collect();
    Fans::of(mesh, edges().zip(is_kept).filter_map(|(wings, is_kept)| is_kept.then_some(wings)))
}

fn push_copy(layer: &mut AttributeLayer, wedge: usize) {
    let at = wedge * layer.width;
    layer.values.extend_from_within(at..at + layer.width);
}

/// The triangles at the edges, those at one edge side by side.
fn wings_by_edge(mesh: &Mesh) -> Vec<Wing> {
    let mut wings = Vec::with_capacity(3 * mesh.faces.len());
    for (f, vertices) in mesh.faces.iter().enumerate() {
        for k in 0..3 {
            let next = (k + 1) % 3;
            let is_forward = vertices[k] < vertices[next];
            let ends = if is_forward { [k, next] } else { [next, k] };
            let edge = ends.map(|k| vertices[k]);
            wings.push(Wing { edge, corners: ends.map(|k| (3 * f + k) as u32), is_forward });
        }
    }
    wings.sort_unstable();
    wings
}

/// Which triangles at an edge are of one sheet. O(n log n) of n triangles.
fn partners(mesh: &Mesh, wings: &[Wing]) -> SmallVec<[[Wing; 2]; 1]> {
    if let [a, b] = *wings {
        return SmallVec::from_elem([a, b], 1);
    }
    // Inside is behind a backward triangle, in the direction of the turn, and before a forward one:
    // like brackets, which close round a circle too.
    let (mut pairs, mut open, mut early) = (SmallVec::new(), Vec::new(), Vec::new());
    for wing in in_turn(mesh, wings) {
        if !wing.is_forward {
            open.push(wing);
        } else if let Some(partner) = open.pop() {
            pairs.push([partner, wing]);
        } else {
            early.push(wing);
        }
    }
    pairs.extend(early.into_iter().map_while(|wing| Some([open.pop()?, wing])));
    pairs
}

/// Triangles at an edge in the order of their angles round it. Of the two sides of what is flat, which have
/// one angle, the backward one is first, so that they are partners.
fn in_turn(mesh: &Mesh, wings: &[Wing]) -> impl Iterator<Item = Wing> {
    let place = |v: u32| mesh.positions[v as usize];
    let [low, high] = wings[0].edge.map(place);
    let axis = (high - low).normalize_or(DVec3::Z);
    let side = axis.any_orthonormal_vector();
    let angle = |wing: &Wing| {
        let face = mesh.faces[wing.corners[0] as usize / 3];
        let apex = face.into_iter().find(|v| !wing.edge.contains(v));
        turn(apex.map_or(DVec3::ZERO, |v| place(v) - low), side, axis.cross(side))
    };
    let mut sorted: Vec<(f64, Wing)> = wings.iter().map(|wing| (angle(wing), *wing)).collect();
    sorted.sort_by(|(a, one), (b, other)| {
        let key = |wing: &Wing| (wing.is_forward, wing.corners);
        a.total_cmp(b).then(key(one).cmp(&key(other)))
    });
    sorted.into_iter().map(|(_, wing)| wing)
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
    /// Where partners at these edges share both ends.
    fn of<'w>(mesh: &Mesh, edges: impl Iterator<Item = &'w [Wing]>) -> Self {
        let mut fans = Self((0..3 * mesh.faces.len() as u32).collect());
        for [a, b] in edges.flat_map(|wings| partners(mesh, wings)) {
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
        let cut = check_cut(&mesh);
        assert_eq!(n_vertices(&cut), n_vertices(&mesh) + n_added);
    }

    fn check_cut(mesh: &Mesh) -> Mesh {
        let cut = mesh.clone().cut_into_sheets();
        let places = |m: &Mesh| -> Vec<[DVec3; 3]> {
            m.faces.iter().map(|f| f.map(|v| m.positions[v as usize])).collect()
        };
        assert_eq!(places(&cut), places(mesh));
        let wings = wings_by_edge(&cut);
        assert!(wings.chunk_by(|a, b| a.edge == b.edge).all(|wings| wings.len() <= 2));
        assert_eq!(cut.clone().cut_into_sheets(), cut, "once is enough");
        EditMesh::new(cut.clone()).unwrap().validate().unwrap();
        cut
    }

    #[test]
    fn what_is_one_sheet_stays() {
        for mesh in [shapes::torus(8, 6, 0.2), shapes::terrain(3, 0.1), Mesh::default()] {
            assert_eq!(mesh.clone().cut_into_sheets(), mesh);
        }
    }

    #[test]
    fn parts_that_touch_in_an_edge_come_apart() {
        let mesh = two_that_share_an_edge();
        check(mesh.clone(), 2);
        let cut = mesh.cut_into_sheets();
        let first: Vec<u32> = cut.faces[..8].as_flattened().to_vec();
        assert!(cut.faces[8..].as_flattened().iter().all(|v| !first.contains(v)));
    }

    #[test]
    fn what_is_flat_falls_apart() {
        let mut mesh = shapes::terrain(4, 0.0);
        let other_side: Vec<_> = mesh.faces.iter().map(|&[a, b, c]| [c, b, a]).collect();
        mesh.faces.extend(other_side);
        let n_triangles = mesh.faces.len() / 2;
        let n = n_vertices(&mesh);
        check(mesh, 3 * n_triangles - n);
    }

    #[test]
    fn a_fin_comes_off() {
        let mut mesh = shapes::octahedron();
        mesh.positions.push(DVec3::new(0.0, 2.0, 0.0));
        mesh.faces.extend([[1, 2, 6], [6, 2, 1]]);
        check(mesh.clone(), 2);
        mesh.faces.extend([[2, 3, 6], [6, 3, 2]]);
        check(mesh, 2 + 3);
    }

    #[test]
    fn a_wall_inside_comes_off_if_it_has_two_sides() {
        let mut mesh = shapes::octahedron();
        mesh.faces.push([0, 1, 3]);
        // With one side it takes the place of a side of the octahedron, which gets a border there.
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
        // Over few vertices: many triangles at an edge, both windings, some flat, some on a line, and two
        // vertices in one place.
        let places: Vec<DVec3> = (0..8)
            .map(|i| DVec3::new(f64::from(i % 3), f64::from(i / 3), f64::from(i % 7 / 4)))
            .chain([DVec3::ZERO])
            .collect();
        let mut state = 1u64;
        let mut next = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as u32 % 9
        };
        for _ in 0..200 {
            let drawn: Vec<[u32; 3]> = (0..20).map(|_| [next(), next(), next()]).collect();
            let is_one = |f: &&[u32; 3]| f[0] != f[1] && f[1] != f[2] && f[0] != f[2];
            let faces = drawn.iter().filter(is_one).copied().collect();
            let mesh = Mesh::from_parts(places.clone(), faces);
            check_cut(&mesh);
        }
    }
}
