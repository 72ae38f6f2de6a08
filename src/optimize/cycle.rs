//! Cycles of more and fewer triangles: where the pictures are worst, edges are split; all is optimized;
//! then image-driven simplification goes back to as many triangles as before, and all is optimized again.
//! Beyond the paper, which has its teleports change places one vertex at a time; "oversimplify, then
//! reinsert" the other way round.
//!
//! Invariants:
//! 1. a cycle is kept if it lowers the energy in all view sets together, and its edits are told then; else
//!    it leaves no trace. One that is broken off ends there, and is kept only if it had come back to as many
//!    triangles as before;
//! 2. the mesh has at the end no more triangles than at the beginning of the run, and hardly less (see
//!    `teleport.rs`);
//! 3. the first cycles are of the whole mesh, in which vertices may go anywhere; of those after them each patch of the
//!    mesh keeps what has helped it (`patches.rs`).
//!
//! What is told of moves counts those of cycles that were not kept, too.
//!
//! Measured, energy in the run-time views where they alone are looked at, in percent of the start, bunny from memoryless
//! simplification to 1,336 triangles, after so many evaluations a triangle; by what share of the vertices is added, and
//! whether all cycles but the first four go patch by patch:
//!
//! | share | patches | 540 | 900 |
//! |---|---|---:|---:|
//! | .2 | no | 59.6 | 59.1 |
//! | .35 | no | 59.0 | 58.3 |
//! | .5 | no | 59.2 | 58.7 |
//! | .8 | no | 59.9 | 58.7 |
//! | .1 | yes | 60.1 | 59.8 |
//! | .35 | yes | 58.8 | 58.4 |
//! | .5 | yes | 59.0 | 58.1 |
//! | .8 | yes | 59.4 | 58.6 |
//! | .2, .35 and .5 in turns | yes | 58.5 | 58.0 |
//!
//! (Single runs, which scatter by .2; patches of 15 to 50 vertices, or patches from the third cycle on, are as good.) The
//! armadillo at 864 triangles after 926 evaluations a triangle: 64.2 with .2 and none, 63.2 with .5 and patches. In many
//! view sets it is less: unseen d2 after 1,000 evaluations a triangle 8.13 instead of 8.15 (bunny, 1,333), 14.08 instead
//! of 14.14 (304), after 520 13.49 instead of 13.51 (armadillo, 864). With .5 alone, no cycle
//! helped a torus of 220 or 300 triangles.
//!
//! Where topology is free, cycles of the whole mesh may collapse any edge, as image-driven simplification may: clustered
//! bunny, 1,435 triangles, in the run-time views after 2,100 evaluations a triangle 26.2 instead of 26.6, with sheets that
//! had joined (see `cluster.rs`). No collapse takes away a triangle that nobody sees if its vertices are seen: 48 of such
//! a mesh in the end, some 25 where sheets were cut apart. In patches free topology is no better: 25.44 instead of 25.50.
//!
//! Not kept, unseen d2 of the bunny at 1,333 after 1,050 and more evaluations a triangle, where runs scatter by .03 about
//! 8.13: turns that end when swaps are known to be in vain (8.12 to 8.17), cycles of half the length (8.13), patches that
//! may become worse by a bound that falls to nothing (8.11 to 8.13), 48 view sets (8.13), descents of twice (8.15) or of
//! six times (8.18) the steps, pictures of the original that are anti-aliased (8.15 to 8.19). Pictures of 512², 8.04 at
//! four times the pixels (armadillo 13.45 instead of 13.48), and of 1,024² are no better.

use std::ops::ControlFlow;

use crate::{
    memoryless,
    mesh::{EditMesh, EditRecord, FaceId, Step, Topology, VertexId},
    metric::{Objective, scene_as_drawn, slopes},
    simplify::{self, Policy, Rules, Simplifier},
};

use super::{
    alternate::{Alternation, Halt, Listener, RESIDUAL, Shower, Stretch, heard, tell},
    descent,
    driver::OptimizeError,
    params::StoppedBy,
    patches::Patches,
    rng::Rng,
    run::Memory,
};

/// Vertices that cycles add in turns, as a share of those there are.
const SHARES: [f64; 3] = [0.5, 0.2, 0.35];
/// So many cycles are of the whole mesh.
const N_WHOLE: u64 = 4;
/// Of a cycle's evaluations, the mesh is finer for one in so many.
const FINER_FOR: u64 = 5;
/// The order of splits is changed at random by as much, so that cycles differ.
const NOISE: f64 = 0.3;

/// Rounds of the searches of image-driven simplification, which is at effort fast otherwise.
const SEARCH_ROUNDS: u32 = 5;

/// How far the pictures of all view sets are off, by triangle slot.
type Residual = Vec<f64>;

/// Where a cycle begins.
#[derive(Clone, Copy)]
pub(super) struct Worst<'r> {
    residual: &'r [f64],
    /// Of the vertices, so many more.
    share: f64,
}

impl Alternation<'_> {
    /// The `k`-th cycle, counted from 1, until the run has spent `end` evaluations.
    pub(super) fn cycle<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        (k, end): (u64, u64),
        show: &mut Shower<'_, E>,
        on: &mut Listener<'_>,
    ) -> Result<(), Halt<E>> {
        let is_cut = k > N_WHOLE && Patches::are_worth_while(mesh);
        let (before, worst) = (self.judged(mesh), self.residual(mesh));
        // What comes after it is to be paid for, too.
        let end = end.saturating_sub(descent::cost_of_looks(mesh, self.sets.len()));
        let attempted = self.attempt(mesh, before, on, |this, mesh, on| {
            let mut on = |step: Step<'_>| match step {
                Step::Sample(_) | Step::Moves(_) => ControlFlow::Continue(()),
                step => on(step),
            };
            let share = SHARES[k as usize % SHARES.len()];
            let worst = Worst { residual: &worst, share };
            let ended = if is_cut {
                this.patch_by_patch(mesh, (worst, end), show, &mut on)
            } else {
                this.refine_and_coarsen(mesh, (worst, end, None), show, &mut on)
            };
            match ended {
                Err(halt @ (Halt::Fault(_) | Halt::By(StoppedBy::Caller))) => Err(halt),
                _ => Ok(()),
            }
        });
        let is_kept = matches!(attempted, Ok(((), Some(_))));
        self.n_fruitless = if is_kept { 0 } else { self.n_fruitless + 1 };
        attempted.map(|_| ())
    }

    /// What a cycle does, in a mesh that may be cut into patches.
    pub(super) fn refine_and_coarsen<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        (worst, end, patches): (Worst<'_>, u64, Option<&mut Patches>),
        show: &mut Shower<'_, E>,
        on: &mut Listener<'_>,
    ) -> Result<(), Halt<E>> {
        let spent = self.outcome.evaluations;
        let finer_until = spent + end.saturating_sub(spent) / FINER_FOR;
        let seed = self.params.seed ^ spent;
        let splits = refine(mesh, worst, &mut Rng::new(seed));
        let cut = patches.map(|patches| {
            patches.follow(&splits);
            &*patches
        });
        let is_cut = cut.is_some();
        heard(tell(&splits, on))?;
        self.forget(mesh);
        self.take_turns(mesh, Stretch { end: finer_until, counts: false, is_cut }, show, on)?;
        self.coarsen(mesh, cut, show, on)?;
        self.forget(mesh);
        self.take_turns(mesh, Stretch { end, counts: true, is_cut }, show, on)
    }

    /// Image-driven simplification to as many triangles as there were, in each patch if there are any.
    fn coarsen<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        cut: Option<&Patches>,
        show: &mut Shower<'_, E>,
        on: &mut Listener<'_>,
    ) -> Result<(), Halt<E>> {
        let mut objective = show(self.some_set(), mesh).map_err(Halt::Fault)?;
        let topology = self.params.topology_of_cycles();
        let Some(patches) = cut else {
            return self.collapse_to(mesh, (self.n_faces, topology), &mut objective, on);
        };
        let sizes = patches.sizes(mesh).into_iter();
        let surpluses = sizes.zip(&patches.targets).map(|(n, target)| n.saturating_sub(*target));
        for (patch, surplus) in surpluses.enumerate().filter(|(_, surplus)| *surplus > 0) {
            patches.lock(mesh, Some(patch));
            // A hole may be closed from two patches, of which one may go.
            let target = (mesh.n_faces() - surplus, Topology::Preserve);
            self.collapse_to(mesh, target, &mut objective, on)?;
        }
        patches.lock(mesh, None);
        Ok(())
    }

    /// Image-driven simplification to so many triangles.
    fn collapse_to<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        (n_faces, topology): (usize, Topology),
        objective: &mut Objective,
        on: &mut Listener<'_>,
    ) -> Result<(), Halt<E>> {
        let params = simplify::Params {
            policy: Policy::Lazy,
            rules: Rules { topology, memoryless: memoryless::Params::default() },
            batch: simplify::BATCH,
            ahead: 1,
            search_rounds: SEARCH_ROUNDS,
            max_evaluations: 0,
            max_energy: None,
        };
        let before = objective.evaluations();
        let (done, total) = (self.outcome.evaluations, self.params.max_evaluations);
        let mut on = |step: Step<'_>| match step {
            Step::Progress { .. } => on(Step::Progress { done, total }),
            step => on(step),
        };
        let outcome = Simplifier::new(mesh, objective, params).run_to(n_faces, &mut on);
        self.outcome.evaluations += objective.evaluations() - before;
        match outcome.map_err(|fault| Halt::Fault(OptimizeError::from(fault).into()))?.stopped_by {
            simplify::StoppedBy::Caller => Err(Halt::By(StoppedBy::Caller)),
            _ => Ok(()),
        }
    }

    /// What is remembered of a mesh is of no use for this one.
    pub(super) fn forget(&mut self, mesh: &EditMesh) {
        let n_faces = self.n_faces.max(mesh.n_faces());
        let elsewhere = |memory: Memory| memory.elsewhere(mesh, n_faces, self.params);
        self.memory = self.memory.take().map(elsewhere);
    }

    /// Draws the mesh in all view sets.
    fn residual(&mut self, mesh: &EditMesh) -> Residual {
        let draw = || {
            let mut sum = vec![0.0; mesh.n_face_slots()];
            for set in self.sets {
                let scene = scene_as_drawn(mesh, &set.pictures, self.has_own_normals);
                let found = slopes(&scene, &set.reference, self.has_own_normals, None);
                sum.iter_mut().zip(&found.faces).for_each(|(all, one)| *all += one);
            }
            sum
        };
        let sum = self.tape.known(RESIDUAL, draw);
        self.outcome.evaluations += descent::cost_of_looks(mesh, self.sets.len());
        sum
    }
}

/// Splits edges in the middle where the pictures are worst, of a triangle's edges rather a long one, no two
/// at one triangle.
fn refine(mesh: &mut EditMesh, worst: Worst<'_>, rng: &mut Rng) -> Vec<EditRecord> {
    let wanted = (worst.share * mesh.n_vertices() as f64) as usize;
    let mut is_taken = vec![false; mesh.n_face_slots()];
    let mut splits = Vec::with_capacity(wanted);
    for (_, [a, b]) in by_gain(mesh, worst.residual, rng) {
        let faces = mesh.edge_faces(a, b);
        let is_free = |f: &FaceId| is_taken.get(f.index()) == Some(&false);
        if splits.len() == wanted {
            break;
        }
        if !faces.iter().all(is_free) {
            continue;
        }
        let middle = 0.5 * (mesh.position(a) + mesh.position(b));
        if let Some(split) = mesh.split(a, b, middle) {
            splits.push(EditRecord::Split(split));
            faces.iter().for_each(|f| is_taken[f.index()] = true);
        }
    }
    splits
}

/// Edges inside the surface, those whose split promises most first.
fn by_gain(mesh: &EditMesh, residual: &[f64], rng: &mut Rng) -> Vec<(f64, [VertexId; 2])> {
    let length = |[a, b]: [VertexId; 2]| mesh.position(a).distance(mesh.position(b));
    let sides = |[a, b, c]: [VertexId; 3]| [[a, b], [b, c], [c, a]];
    let mut edges = Vec::new();
    for face in mesh.faces() {
        for [a, b] in sides(mesh.vertices_of(face)).into_iter().filter(|[a, b]| a < b) {
            let faces = mesh.edge_faces(a, b);
            if faces.len() != 2 {
                continue;
            }
            let around = faces.iter().flat_map(|f| sides(mesh.vertices_of(*f)));
            let longest = around.map(length).fold(f64::MIN_POSITIVE, f64::max);
            let energy: f64 = faces.iter().map(|f| residual[f.index()]).sum();
            let noise = 1.0 + NOISE * rng.below(1 << 20) as f64 / f64::from(1 << 20);
            edges.push((noise * energy * length([a, b]) / longest, [a, b]));
        }
    }
    edges.sort_by(|one, other| other.0.total_cmp(&one.0));
    edges
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::shapes;

    #[test]
    fn the_worst_triangles_are_split_and_none_twice() {
        let mut mesh = EditMesh::new(shapes::torus(12, 8, 0.0)).unwrap();
        let (n_faces, n_vertices) = (mesh.n_faces(), mesh.n_vertices());
        let worst = mesh.faces().nth(40).unwrap();
        let mut faces = vec![1.0; mesh.n_face_slots()];
        faces[worst.index()] = 1e6;
        let splits = refine(&mut mesh, Worst { residual: &faces, share: 0.2 }, &mut Rng::new(1));
        mesh.validate().unwrap();
        assert_eq!(splits.len(), (0.2 * n_vertices as f64) as usize);
        assert_eq!(mesh.n_faces(), n_faces + 2 * splits.len());
        let EditRecord::Split(first) = &splits[0] else { panic!("{:?}", splits[0]) };
        assert!(first.halves.iter().any(|half| half.face == worst), "{first:?}");
        let mut touched: Vec<FaceId> = (splits.iter())
            .flat_map(|split| match split {
                EditRecord::Split(split) => split.halves.iter().map(|h| h.face),
                other => panic!("{other:?}"),
            })
            .collect();
        touched.sort_unstable();
        assert!(touched.windows(2).all(|w| w[0] != w[1]));
    }
}
