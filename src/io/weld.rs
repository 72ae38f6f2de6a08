//! Soup to mesh: joins what is equal, drops what is degenerate or unreferenced.
//!
//! 1. Points at bit-equal positions (−0 counts as 0) become one vertex. No distance is tolerated:
//!    what a file keeps apart stays apart.
//! 2. At a vertex, bit-equal attribute vectors become one wedge.
//! 3. Triangles with a repeated vertex are dropped and counted; thin triangles with three
//!    distinct vertices are kept; a note counts those whose corners are on a line. Nothing but these is no surface.
//! 4. All patches get the same layers: the union of what they have. Where a patch lacks one,
//!    colours are white, texture coordinates 0, and normals are computed (the area-weighted mean
//!    over the patch's triangles at that point). The same mends zero and non-finite normals.
//!    Tangents cannot be made up: the layer goes unless every patch has it.
//! 5. A vertex is locked if one of its points is, and matters as much as the one that matters most.
//! 6. Vertices, wedges and triangles keep the order of the file.

use std::sync::Arc;

use glam::{DVec3, Vec3};

use super::{
    IoError,
    intern::Interner,
    soup::{Attribute, Notes, Patch, PatchMaterials, PointMarks, Soup, defaults_of},
    source::Source,
};
use crate::mesh::{AttributeLayer, MAX_WEIGHT, Marks, Material, Mesh, Semantic, Tree, VertexId};

/// The mesh and what the report needs beside it.
pub(super) struct Welded {
    pub(super) mesh: Mesh,
    pub(super) marks: Marks,
    pub(super) n_triangles_in_file: u64,
    pub(super) n_points_in_file: u64,
    pub(super) n_degenerate: u64,
    pub(super) n_instances: u64,
    pub(super) notes: Notes,
}

/// Joins a soup into a mesh.
///
/// # Errors
/// [`IoError::NoTriangles`] when none is left.
pub(super) fn weld(source: &Source<'_>, soup: Soup) -> Result<Welded, IoError> {
    let n_points_in_file = soup.n_points();
    let Soup { mut patches, materials, textures, images, tree, mut notes, n_instances, .. } = soup;
    let n_triangles_in_file = patches.iter().map(|p| p.triangles.len() as u64).sum();
    let layers = choose_layers(&patches, &mut notes);
    for patch in &mut patches {
        complete_attributes(patch, &layers, &mut notes);
    }
    let mut joiner = Joiner::new(layers);
    let has_weights = patches.iter().any(|p| !p.marks.weights.is_empty());
    for patch in &mut patches {
        settle_weights(patch, has_weights, &mut notes);
    }
    for patch in patches {
        joiner.join(&patch);
    }
    if joiner.faces.is_empty() {
        return Err(source.no_triangles(match n_triangles_in_file {
            0 => "the file holds no surface".to_owned(),
            n => format!("each of its {n} triangles has two corners at the same point"),
        }));
    }
    let n_degenerate = joiner.n_degenerate;
    let tree = Arc::new(if tree.says_nothing() { Tree::default() } else { tree });
    let (mesh, marks) = joiner.into_mesh(materials);
    let n_flat = n_without_area(&mesh);
    if n_flat == mesh.faces.len() {
        let problem = format!("the corners of each of its {n_flat} triangles are on a line");
        return Err(source.no_triangles(problem));
    }
    if n_flat > 0 {
        let text = format!("{n_flat} triangles have no area: their corners are on a line");
        notes.add("triangles_without_area", text);
    }
    let mesh = Mesh { textures, images, tree, ..mesh };
    Ok(Welded {
        mesh,
        marks,
        n_triangles_in_file,
        n_points_in_file,
        n_degenerate,
        n_instances,
        notes,
    })
}

/// The layers of the mesh, in a fixed order.
fn choose_layers(patches: &[Patch], notes: &mut Notes) -> Vec<Semantic> {
    let has = |p: &Patch, s: Semantic| p.attributes.iter().any(|a| a.semantic == s);
    let mut layers: Vec<Semantic> = Vec::new();
    for semantic in patches.iter().flat_map(|p| &p.attributes).map(|a| a.semantic) {
        if !layers.contains(&semantic) {
            layers.push(semantic);
        }
    }
    layers.sort_by_key(|s| match *s {
        Semantic::Normal => (0, 0),
        Semantic::Tangent => (1, 0),
        Semantic::TexCoord(set) => (2, set),
        Semantic::Color(set) => (3, set),
        Semantic::Skin => (4, 0),
        Semantic::Custom(set) => (5, set),
    });
    let everywhere = |s| patches.iter().all(|p| p.triangles.is_empty() || has(p, s));
    if layers.contains(&Semantic::Tangent) && !everywhere(Semantic::Tangent) {
        layers.retain(|s| *s != Semantic::Tangent);
        notes.add("tangents_dropped", "tangents are left out: some primitives have none");
    }
    // Parts without a skin have no joints.
    for &s in layers.iter().filter(|&&s| s != Semantic::Skin && !everywhere(s)) {
        notes.add("attribute_filled", format!("{} is filled in where missing", name_of(s)));
    }
    layers
}

/// Brings the attributes of a patch into the order of `layers`, filling what is missing and
/// mending what is not finite.
fn complete_attributes(patch: &mut Patch, layers: &[Semantic], notes: &mut Notes) {
    let mut found = std::mem::take(&mut patch.attributes);
    for &semantic in layers {
        let default = defaults_of(semantic);
        let values = match found.iter().position(|a| a.semantic == semantic) {
            Some(i) => found.swap_remove(i).values,
            None => default.repeat(patch.positions.len()),
        };
        patch.attributes.push(Attribute { semantic, values });
    }
    for attribute in &mut patch.attributes {
        let default = defaults_of(attribute.semantic);
        let mut n_mended = 0;
        for record in attribute.values.chunks_exact_mut(default.len()) {
            if !record.iter().all(|v| v.is_finite()) {
                record.copy_from_slice(default);
                n_mended += 1;
            }
        }
        if n_mended > 0 {
            let name = name_of(attribute.semantic);
            notes.add("attribute_mended", format!("{name} was not finite at some vertices"));
        }
    }
    mend_normals(patch);
}

/// Weights of every point where some patch has any, in range.
fn settle_weights(patch: &mut Patch, is_wanted: bool, notes: &mut Notes) {
    let weights = &mut patch.marks.weights;
    if is_wanted && weights.is_empty() {
        weights.resize(patch.positions.len(), 1.0);
    }
    for weight in weights {
        let settled = if weight.is_nan() { 1.0 } else { weight.clamp(0.0, MAX_WEIGHT) };
        if *weight != settled {
            let text = format!("weights are held to 0 to {MAX_WEIGHT}");
            notes.add("weight_clamped", text);
        }
        *weight = settled;
    }
}

/// Replaces zero normals (missing ones are zero by now) by the area-weighted mean.
fn mend_normals(patch: &mut Patch) {
    let Patch { positions, triangles, attributes, .. } = patch;
    let Some(normals) = attributes.iter_mut().find(|a| a.semantic == Semantic::Normal) else {
        return;
    };
    if normals.values.chunks_exact(3).all(|n| n.iter().any(|v| *v != 0.0)) {
        return;
    }
    let sums = area_normals(positions, triangles);
    for (normal, sum) in normals.values.chunks_exact_mut(3).zip(sums) {
        if normal.iter().all(|v| *v == 0.0) {
            normal.copy_from_slice(&unit_or_z(sum).to_array());
        }
    }
}

/// Twice the sum of the area vectors of the triangles at each point. All indices are in range.
pub(super) fn area_normals(positions: &[DVec3], triangles: &[[u32; 3]]) -> Vec<DVec3> {
    let mut sums = vec![DVec3::ZERO; positions.len()];
    for t in triangles {
        let [a, b, c] = t.map(|v| positions[v as usize]);
        let area = (b - a).cross(c - a);
        for v in t {
            sums[*v as usize] += area;
        }
    }
    sums
}

/// `v` at length 1, or +Z where it has no direction.
pub(super) fn unit_or_z(v: DVec3) -> Vec3 {
    v.try_normalize().unwrap_or(DVec3::Z).as_vec3()
}

/// Triangles whose height is nothing beside their longest side.
fn n_without_area(mesh: &Mesh) -> usize {
    const NOTHING: f64 = 1e-12;
    let is_flat = |face: &&[u32; 3]| {
        let [a, b, c] = face.map(|v| mesh.positions[v as usize]);
        let sides = [b - a, c - b, a - c].map(DVec3::length_squared);
        (b - a).cross(c - a).length() <= NOTHING * sides.into_iter().fold(0.0, f64::max)
    };
    mesh.faces.iter().filter(is_flat).count()
}

/// What messages call a layer.
pub(super) fn name_of(semantic: Semantic) -> String {
    match semantic {
        Semantic::Normal => "normal".to_owned(),
        Semantic::Tangent => "tangent".to_owned(),
        Semantic::TexCoord(set) => format!("texture coordinate set {set}"),
        Semantic::Color(set) => format!("colour set {set}"),
        Semantic::Skin => "skin".to_owned(),
        Semantic::Custom(id) => format!("custom attribute {id}"),
    }
}

/// The mesh under construction.
struct Joiner {
    layers: Vec<Semantic>,
    positions: Interner,
    /// Records: vertex, then the bits of all layers.
    wedges: Interner,
    /// By vertex.
    marks: Marks,
    faces: Vec<[u32; 3]>,
    face_wedges: Vec<[u32; 3]>,
    face_materials: Vec<u32>,
    face_parts: Vec<u32>,
    n_degenerate: u64,
}

impl Joiner {
    fn new(layers: Vec<Semantic>) -> Self {
        let width: usize = layers.iter().map(|s| defaults_of(*s).len()).sum();
        Self {
            layers,
            positions: Interner::new(6),
            wedges: Interner::new(1 + width),
            marks: Marks::default(),
            faces: Vec::new(),
            face_wedges: Vec::new(),
            face_materials: Vec::new(),
            face_parts: Vec::new(),
            n_degenerate: 0,
        }
    }

    fn join(&mut self, patch: &Patch) {
        let used = points_used(patch, |_| true);
        let vertex_of_point = self.number_vertices(&patch.positions, &used);
        self.mark_vertices(&patch.marks, &vertex_of_point, &used);
        let is_kept = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|p| vertex_of_point[p as usize]);
            a != b && b != c && c != a
        };
        let wedge_of_point = if self.layers.is_empty() {
            Vec::new()
        } else {
            let used = points_used(patch, is_kept);
            self.number_wedges(&patch.attributes, &vertex_of_point, &used)
        };
        for (i, t) in patch.triangles.iter().enumerate() {
            if !is_kept(t) {
                self.n_degenerate += 1;
                continue;
            }
            self.faces.push(t.map(|p| vertex_of_point[p as usize]));
            if !wedge_of_point.is_empty() {
                self.face_wedges.push(t.map(|p| wedge_of_point[p as usize]));
            }
            self.face_parts.push(patch.part);
            self.face_materials.push(match &patch.materials {
                PatchMaterials::All(m) => *m,
                PatchMaterials::Each(list) => list.get(i).copied().unwrap_or(0),
            });
        }
    }

    /// The vertex of each used point, 0 for the others.
    fn number_vertices(&mut self, positions: &[DVec3], used: &[bool]) -> Vec<u32> {
        let number = |(p, used): (&DVec3, &bool)| {
            if !used {
                return 0;
            }
            let mut record = [0; 6];
            for (words, x) in record.chunks_exact_mut(2).zip(p.to_array()) {
                // Adding 0 turns −0 into 0.
                let bits = (x + 0.0).to_bits();
                words.copy_from_slice(&[bits as u32, (bits >> 32) as u32]);
            }
            self.positions.intern(&record)
        };
        positions.iter().zip(used).map(number).collect()
    }

    fn mark_vertices(&mut self, marks: &PointMarks, vertex_of_point: &[u32], used: &[bool]) {
        let n_vertices = self.positions.len();
        let points =
            || vertex_of_point.iter().zip(used).enumerate().filter(|(_, (_, used))| **used);
        if !marks.locks.is_empty() {
            self.marks.locked.resize(n_vertices, false);
            points().for_each(|(p, (v, _))| {
                self.marks.locked[*v as usize] |= marks.locks[p] != 0.0;
            });
        }
        if !marks.weights.is_empty() {
            self.marks.weights.resize(n_vertices, 0.0);
            points().for_each(|(p, (v, _))| {
                let weight = &mut self.marks.weights[*v as usize];
                *weight = weight.max(marks.weights[p]);
            });
        }
    }

    /// The wedge of each used point, 0 for the others.
    fn number_wedges(
        &mut self,
        attributes: &[Attribute],
        vertex_of_point: &[u32],
        used: &[bool],
    ) -> Vec<u32> {
        let mut record = Vec::new();
        let mut number = |(point, used): (usize, &bool)| {
            if !used {
                return 0;
            }
            record.clear();
            record.push(vertex_of_point[point]);
            for a in attributes {
                let width = defaults_of(a.semantic).len();
                let values = &a.values[point * width..(point + 1) * width];
                record.extend(values.iter().map(|v| (v + 0.0).to_bits()));
            }
            self.wedges.intern(&record)
        };
        used.iter().enumerate().map(&mut number).collect()
    }

    /// Leaves out the vertices that only dropped triangles used.
    fn into_mesh(mut self, materials: Vec<Material>) -> (Mesh, Marks) {
        let positions = self.positions.into_words();
        let mut is_used = vec![false; positions.len() / 6];
        for v in self.faces.iter().flatten() {
            is_used[*v as usize] = true;
        }
        let mut new_ids = Vec::with_capacity(is_used.len());
        let (mut kept, mut kept_ids) = (Vec::new(), Vec::new());
        for (v, (words, used)) in positions.chunks_exact(6).zip(&is_used).enumerate() {
            new_ids.push(kept.len() as u32);
            if *used {
                kept_ids.push(VertexId(v as u32));
                let word = |k: usize| u64::from(words[k]);
                let x = |k: usize| f64::from_bits(word(k) | word(k + 1) << 32);
                kept.push(DVec3::new(x(0), x(2), x(4)));
            }
        }
        for v in self.faces.iter_mut().flatten() {
            *v = new_ids[*v as usize];
        }
        for list in [&mut self.face_materials, &mut self.face_parts] {
            if list.iter().all(|index| *index == 0) {
                *list = Vec::new();
            }
        }
        let mesh = Mesh {
            positions: kept,
            faces: self.faces,
            face_wedges: self.face_wedges,
            face_materials: self.face_materials,
            face_parts: self.face_parts,
            layers: split_layers(&self.layers, &self.wedges.into_words()),
            materials,
            ..Mesh::default()
        };
        (mesh, self.marks.of(&kept_ids))
    }
}

/// Which points the triangles that `keep` accepts use.
fn points_used(patch: &Patch, keep: impl Fn(&[u32; 3]) -> bool) -> Vec<bool> {
    let mut used = vec![false; patch.positions.len()];
    for t in patch.triangles.iter().filter(|t| keep(t)) {
        for p in t {
            used[*p as usize] = true;
        }
    }
    used
}

/// From records (vertex, all layers) to one array per layer.
fn split_layers(layers: &[Semantic], records: &[u32]) -> Vec<AttributeLayer> {
    let width: usize = 1 + layers.iter().map(|s| defaults_of(*s).len()).sum::<usize>();
    let mut first = 1;
    let mut split = Vec::with_capacity(layers.len());
    for &semantic in layers {
        let end = first + defaults_of(semantic).len();
        let values = records
            .chunks_exact(width)
            .flat_map(|r| &r[first..end])
            .map(|bits| f32::from_bits(*bits))
            .collect();
        split.push(AttributeLayer { semantic, width: end - first, values });
        first = end;
    }
    split
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::Limits;

    fn soup_of(patches: Vec<Patch>) -> Welded {
        let limits = Limits::default();
        let source = Source { file: "test", bytes: &[], limits: &limits, beside: None };
        let mut soup = Soup::default();
        for patch in patches {
            soup.push(&source, patch).unwrap();
        }
        weld(&source, soup).unwrap()
    }

    /// Two triangles that share an edge whose ends are stored twice, one of them once as −0,
    /// and a third triangle whose corners 0 and 3 coincide.
    fn torn_quad() -> Patch {
        let xy = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, 1.0), (1.0, -0.0), (1.0, 1.0)];
        Patch {
            positions: xy.iter().map(|(x, y)| DVec3::new(*x, *y, 0.0)).collect(),
            triangles: vec![[0, 1, 2], [2, 3, 5], [3, 4, 5]],
            ..Patch::default()
        }
    }

    #[test]
    fn joins_coincident_points_and_drops_the_degenerate() {
        let welded = soup_of(vec![torn_quad()]);
        assert_eq!(welded.mesh.faces, vec![[0, 1, 2], [2, 1, 3]]);
        assert_eq!(welded.mesh.positions.len(), 4);
        assert_eq!((welded.n_degenerate, welded.n_triangles_in_file), (1, 3));
        assert!(welded.mesh.face_wedges.is_empty() && welded.mesh.face_materials.is_empty());
    }

    #[test]
    fn distinct_attributes_make_distinct_wedges() {
        let mut patch = torn_quad();
        let semantic = Semantic::TexCoord(0);
        // Point 4 repeats the coordinates of point 1, point 3 differs from point 2.
        let uv = [0., 0., 1., 0., 0., 1., 0.5, 0.5, 1., 0., 1., 1.];
        patch.attributes.push(Attribute { semantic, values: uv.to_vec() });
        let welded = soup_of(vec![patch]);
        assert_eq!(welded.mesh.face_wedges, vec![[0, 1, 2], [3, 1, 4]]);
        assert_eq!(welded.mesh.n_wedges(), 5);
    }

    #[test]
    fn missing_normals_are_computed_and_tangents_dropped() {
        let mut with = torn_quad();
        let semantic = Semantic::Normal;
        with.attributes.push(Attribute { semantic, values: [1.0, 0.0, 0.0].repeat(6) });
        let semantic = Semantic::Tangent;
        with.attributes.push(Attribute { semantic, values: [1.0, 0.0, 0.0, 1.0].repeat(6) });
        let welded = soup_of(vec![with, torn_quad()]);
        let normals = welded.mesh.layer(Semantic::Normal).unwrap();
        let filled = welded.mesh.face_wedges[2][0];
        assert_eq!(normals.get(crate::mesh::WedgeId(filled)), &[0.0, 0.0, 1.0]);
        assert_eq!(welded.mesh.layers.len(), 1);
        let codes: Vec<_> = welded.notes.into_vec().iter().map(|n| n.code).collect();
        assert_eq!(codes, ["tangents_dropped", "attribute_filled"]);
    }
}
