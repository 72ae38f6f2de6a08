//! A mesh cut into patches that know nothing of each other, so that of a cycle's edits those of the patches that they
//! have helped may stay, and those of the others go.
//!
//! What a cycle does to the whole mesh is the sum of what it does everywhere: the better the mesh, the rarer that more is
//! gained than lost. What is gained in one patch does not depend on another's luck. Beyond the paper.
//!
//! Invariants:
//! 1. patches meet at vertices that stay as they are, place and attributes, whatever happens on either side (but
//!    normals that follow from triangles on both sides, and what hides the other in a picture: pixels tell whose they are);
//! 2. no patch has more triangles at the end of a cycle than it should, or it goes.
//!
//! Measured: see `cycle.rs`.

use std::ops::{ControlFlow, RangeInclusive};

use crate::{
    mesh::{Edit, EditMesh, EditRecord, FaceId, Marks, Names, Step, VertexId},
    metric::{NOWHERE, changes_by_region, scene_as_drawn},
    tape::Question,
};

use super::{
    alternate::{Alternation, Halt, Listener, Shower, heard, tell},
    cycle::Worst,
    descent,
    driver::OptimizeError,
    params::StoppedBy,
    rng::Rng,
};

/// Vertices of a patch, those at its border included, as long as there are not too many patches.
const SIZE: usize = 25;
/// Fewer patches are not worth while; each of more would have to look at the whole mesh.
const N_PATCHES: RangeInclusive<usize> = 4..=64;

/// What a tape is asked here (see `alternate.rs`).
const CHANGES: Question = Question::of(9);

/// Which vertex and which triangle belongs to which patch; [`NOWHERE`]: it stays as it is.
pub(super) struct Patches {
    of_vertices: Vec<u32>,
    of_faces: Vec<u32>,
    n: usize,
    /// Triangles that each should have in the end.
    pub targets: Vec<usize>,
}

impl Patches {
    /// Whether a mesh is large enough to be cut.
    pub fn are_worth_while(mesh: &EditMesh) -> bool {
        mesh.n_vertices() >= N_PATCHES.start() * SIZE
    }

    /// Cuts a mesh that is to have so many triangles up at random: what is nearest, edge by edge, to one of some vertices
    /// belongs together. Components without such a vertex stay.
    pub fn random(mesh: &EditMesh, n_faces: usize, rng: &mut Rng) -> Self {
        let vertices = (0..mesh.n_vertex_slots() as u32).map(VertexId);
        let used: Vec<VertexId> = vertices.filter(|v| mesh.is_used(*v)).collect();
        let mut cells = vec![NOWHERE; mesh.n_vertex_slots()];
        let mut n = 0;
        let mut seeds: Vec<VertexId> = Vec::new();
        for _ in 0..(used.len() / SIZE).min(*N_PATCHES.end()) {
            let seed = used[rng.below(used.len())];
            if cells[seed.index()] == NOWHERE {
                cells[seed.index()] = n;
                n += 1;
                seeds.push(seed);
            }
        }
        grow(mesh, &mut cells, seeds);
        let mut this = Self::of_cells(mesh, &cells, n as usize);
        this.targets = this.sizes(mesh);
        // At borders a triangle may be lost that is to be had again.
        let n_missing = n_faces.saturating_sub(mesh.n_faces());
        this.targets.iter_mut().take(n_missing).for_each(|target| *target += 1);
        this
    }

    /// Without the vertices at which cells meet, and those that are locked.
    fn of_cells(mesh: &EditMesh, cells: &[u32], n: usize) -> Self {
        let mut this =
            Self { of_vertices: cells.to_vec(), of_faces: Vec::new(), n, targets: Vec::new() };
        let mut ring = Vec::new();
        for v in (0..cells.len() as u32).map(VertexId) {
            mesh.neighbours(v, &mut ring);
            let cell = cells[v.index()];
            if mesh.is_locked(v) || ring.iter().any(|w| cells[w.index()] < cell) {
                this.of_vertices[v.index()] = NOWHERE;
            }
        }
        this.of_faces = vec![NOWHERE; mesh.n_face_slots()];
        for f in mesh.faces() {
            this.of_faces[f.index()] = this.of(mesh.vertices_of(f));
        }
        this
    }

    /// The patch of the first vertex that has one. Vertices that share a triangle do not have different ones.
    fn of(&self, vertices: impl IntoIterator<Item = VertexId>) -> u32 {
        let patch = |v: VertexId| self.of_vertices.get(v.index()).copied();
        let mut patches = vertices.into_iter().filter_map(patch);
        patches.find(|patch| *patch != NOWHERE).unwrap_or(NOWHERE)
    }

    fn of_face(&self, face: FaceId) -> u32 {
        self.of_faces.get(face.index()).copied().unwrap_or(NOWHERE)
    }

    /// The patch of an edit, if it has one place.
    fn of_edit(&self, edit: Edit<'_>) -> Option<u32> {
        match edit {
            Edit::Collapse(c) => Some(self.of([c.keep, c.drop])),
            Edit::Split(s) => Some(self.of([s.a, s.b])),
            Edit::Swap(s) => Some(self.of(s.ends)),
            Edit::Displacement(d) => Some(self.of([d.vertex])),
            Edit::Revalue(_) => None,
        }
    }

    /// What is new belongs to the patch where it came to be.
    pub fn follow(&mut self, edits: &[EditRecord]) {
        for edit in edits {
            let EditRecord::Split(split) = edit else { continue };
            let patch = self.of([split.a, split.b]);
            enter(&mut self.of_vertices, split.vertex.index(), patch);
            for half in &split.halves {
                enter(&mut self.of_faces, half.new_face.index(), patch);
            }
        }
    }

    /// Triangles of each patch.
    pub fn sizes(&self, mesh: &EditMesh) -> Vec<usize> {
        let mut sizes = vec![0; self.n];
        for face in mesh.faces() {
            if let Some(size) = sizes.get_mut(self.of_face(face) as usize) {
                *size += 1;
            }
        }
        sizes
    }

    /// Locks all vertices but those of one patch, or of all patches.
    pub fn lock(&self, mesh: &mut EditMesh, all_but: Option<usize>) {
        let is_locked =
            |patch: &u32| *patch == NOWHERE || all_but.is_some_and(|one| one != *patch as usize);
        let n_vertices = mesh.n_vertex_slots();
        let locked = self.of_vertices.iter().take(n_vertices).map(is_locked).collect();
        let weights = mesh.marks().weights.clone();
        mesh.mark(Marks { locked, weights });
    }
}

/// Gives everything that can be reached from vertices their cell, the nearest first.
fn grow(mesh: &EditMesh, cells: &mut [u32], mut front: Vec<VertexId>) {
    let mut ring = Vec::new();
    while !front.is_empty() {
        for v in std::mem::take(&mut front) {
            mesh.neighbours(v, &mut ring);
            for w in &ring {
                if cells[w.index()] == NOWHERE {
                    cells[w.index()] = cells[v.index()];
                    front.push(*w);
                }
            }
        }
    }
}

fn enter(patches: &mut Vec<u32>, at: usize, patch: u32) {
    patches.resize(patches.len().max(at + 1), NOWHERE);
    patches[at] = patch;
}

impl Alternation<'_> {
    /// Works on a copy that is cut into patches; what helps a patch is done here, too.
    pub(super) fn patch_by_patch<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        (worst, end): (Worst<'_>, u64),
        show: &mut Shower<'_, E>,
        on: &mut Listener<'_>,
    ) -> Result<(), Halt<E>> {
        // What comes after it is to be paid for, too.
        let n_looks = 2 * self.sets.len();
        let end = end.saturating_sub(descent::cost_of_looks(mesh, n_looks));
        let mut rng = Rng::new(!self.params.seed ^ self.outcome.evaluations);
        let mut patches = Patches::random(mesh, self.n_faces, &mut rng);
        let mut copy = mesh.clone();
        patches.lock(&mut copy, None);
        let mut edits = Vec::new();
        let mut listen = |step: Step<'_>| match step {
            Step::Edit(edit) => {
                edits.push(edit.to_record());
                ControlFlow::Continue(())
            }
            step => on(step),
        };
        let work = (worst, end, Some(&mut patches));
        let ended = self.refine_and_coarsen(&mut copy, work, show, &mut listen);
        if let Err(halt @ (Halt::Fault(_) | Halt::By(StoppedBy::Caller))) = ended {
            return Err(halt);
        }
        let is_better = self.better(mesh, &copy, &patches);
        let done = repeat(mesh, &edits, &patches, &is_better);
        self.forget(mesh);
        heard(tell(&done, on))
    }

    /// Which patches look better in all view sets together.
    fn better(&mut self, mesh: &EditMesh, copy: &EditMesh, patches: &Patches) -> Vec<bool> {
        let sizes = patches.sizes(copy);
        let changes = self.tape.known(CHANGES, || {
            let mut sums = vec![0.0; patches.n];
            for set in self.sets {
                let draw = |mesh| scene_as_drawn(mesh, &set.pictures, self.has_own_normals);
                let (before, after) = (draw(mesh), draw(copy));
                let scenes = [(&before, &patches.of_faces[..]), (&after, &patches.of_faces[..])];
                let found = changes_by_region(scenes, &set.reference, patches.n);
                sums.iter_mut().zip(found).for_each(|(sum, one)| *sum += one);
            }
            sums
        });
        self.outcome.evaluations += descent::cost_of_looks(mesh, 2 * self.sets.len());
        let is_better = |p: usize| changes.get(p).is_some_and(|c| *c < 0.0);
        (0..patches.n).map(|p| is_better(p) && sizes[p] <= patches.targets[p]).collect()
    }
}

/// Makes those of a copy's edits that belong to wanted patches.
fn repeat(
    mesh: &mut EditMesh,
    edits: &[EditRecord],
    patches: &Patches,
    is_wanted: &[bool],
) -> Vec<EditRecord> {
    let is_wanted = |patch: u32| is_wanted.get(patch as usize) == Some(&true);
    let (mut names, mut done) = (Names::default(), Vec::new());
    // Collapses look at what is locked.
    let locked = mesh.marks().locked.clone();
    patches.lock(mesh, None);
    for edit in edits.iter().map(EditRecord::edit) {
        if patches.of_edit(edit).is_none_or(is_wanted) {
            done.extend(mesh.repeat(edit, &mut names, |face| is_wanted(patches.of_face(face))));
        }
    }
    let weights = mesh.marks().weights.clone();
    mesh.mark(Marks { locked, weights });
    done
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::shapes;

    #[test]
    fn patches_share_no_triangle_and_keep_what_is_locked() {
        let locked = [3, 77, 500];
        let n_vertices = 40 * 24;
        let marks = Marks {
            locked: (0..n_vertices).map(|v| locked.contains(&v)).collect(),
            ..Marks::default()
        };
        let mesh = EditMesh::new(shapes::torus(40, 24, 0.1)).unwrap().with_marks(marks);
        for seed in 0..20 {
            let patches = Patches::random(&mesh, mesh.n_faces(), &mut Rng::new(seed));
            assert!((20..=n_vertices / SIZE).contains(&patches.n), "{}", patches.n);
            for f in mesh.faces() {
                let of = |v: VertexId| patches.of_vertices[v.index()];
                for v in mesh.vertices_of(f).into_iter().filter(|v| of(*v) != NOWHERE) {
                    assert_eq!(of(v), patches.of_face(f), "{f:?}");
                }
            }
            assert!(locked.iter().all(|v| patches.of_vertices[*v] == NOWHERE));
            let n_free = patches.of_vertices.iter().filter(|p| **p != NOWHERE).count();
            assert!(2 * n_free > n_vertices, "{n_free}");
            let mut copy = mesh.clone();
            patches.lock(&mut copy, Some(0));
            let n_locked = copy.marks().n_locked();
            patches.lock(&mut copy, None);
            assert!(n_locked > copy.marks().n_locked());
            assert_eq!(copy.marks().n_locked(), n_vertices - n_free);
        }
    }

    #[test]
    fn what_is_split_belongs_to_the_patch() {
        let mut mesh = EditMesh::new(shapes::torus(40, 24, 0.1)).unwrap();
        let mut patches = Patches::random(&mesh, mesh.n_faces() + 3, &mut Rng::new(1));
        let before = patches.sizes(&mesh);
        let gain = |(p, n): (usize, &usize)| patches.targets[p] - n;
        assert_eq!(before.iter().enumerate().map(gain).sum::<usize>(), 3);
        let is_inside =
            |f: &FaceId| mesh.vertices_of(*f).iter().all(|v| patches.of_vertices[v.index()] == 5);
        let [a, b, _] = mesh.vertices_of(mesh.faces().find(is_inside).unwrap());
        let edit = EditRecord::Split(mesh.split(a, b, mesh.position(a)).unwrap());
        assert_eq!(patches.of_edit(edit.edit()), Some(5));
        patches.follow(&[edit]);
        let mut wanted = before;
        wanted[5] += 2;
        assert_eq!(patches.sizes(&mesh), wanted);
    }
}
