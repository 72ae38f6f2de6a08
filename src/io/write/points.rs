//! The distinct corners of a set of faces, as a file stores them.

use std::collections::HashSet;

use glam::DVec3;

use crate::mesh::{AttributeLayer, Mesh, WedgeId};

/// Vertices of a file and the triangles between them.
pub(super) struct Points {
    /// (wedge, vertex), ascending until `part` or `reorder`; wedge 0 in a mesh without layers.
    corners: Vec<(u32, u32)>,
    pub(super) triangles: Vec<[u32; 3]>,
}

impl Points {
    /// The corners that `faces` use. The mesh has been checked.
    pub(super) fn of(mesh: &Mesh, faces: &[u32]) -> Self {
        let corners_of = |face: u32| {
            let vertices = mesh.faces[face as usize];
            let wedges = mesh.face_wedges.get(face as usize).copied().unwrap_or([0; 3]);
            [0, 1, 2].map(|k| (wedges[k], vertices[k]))
        };
        let mut corners: Vec<_> = faces.iter().flat_map(|f| corners_of(*f)).collect();
        corners.sort_unstable();
        corners.dedup();
        let index_of = |c: (u32, u32)| corners.partition_point(|x| *x < c) as u32;
        let triangles = faces.iter().map(|f| corners_of(*f).map(index_of)).collect();
        Self { corners, triangles }
    }

    /// Gives each triangle that has the three points of an earlier one, as the second side of a sheet
    /// has, a point of its own: Blender drops triangles that do not differ in one.
    pub(super) fn part(&mut self) {
        let mut seen = HashSet::with_capacity(self.triangles.len());
        for triangle in &mut self.triangles {
            let mut points = *triangle;
            points.sort_unstable();
            if !seen.insert(points) {
                self.corners.push(self.corners[triangle[2] as usize]);
                triangle[2] = self.corners.len() as u32 - 1;
            }
        }
    }

    /// Puts triangles and points in an order that compresses well.
    pub(super) fn reorder(&mut self) {
        let n = self.len();
        let corners = meshopt::optimize_vertex_cache(self.triangles.as_flattened(), n);
        let new_ids = meshopt::optimize_vertex_fetch_remap(&corners, n);
        let mut reordered = self.corners.clone();
        for (old, new) in new_ids.iter().enumerate() {
            reordered[*new as usize] = self.corners[old];
        }
        let renumbered = |t: &[u32; 3]| t.map(|v| new_ids[v as usize]);
        self.triangles = corners.as_chunks().0.iter().map(renumbered).collect();
        self.corners = reordered;
    }

    pub(super) fn len(&self) -> usize {
        self.corners.len()
    }

    pub(super) fn positions<'a>(&'a self, mesh: &'a Mesh) -> impl Iterator<Item = DVec3> + 'a {
        self.corners.iter().map(|(_, v)| mesh.positions[*v as usize])
    }

    /// The values of a layer at each point.
    pub(super) fn values<'a>(
        &'a self,
        layer: &'a AttributeLayer,
    ) -> impl Iterator<Item = &'a [f32]> {
        self.corners.iter().map(|(w, _)| layer.get(WedgeId(*w)))
    }
}
