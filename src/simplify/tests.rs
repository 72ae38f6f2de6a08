//! A finely divided box: only its twelve edges matter to the pictures.

use std::ops::ControlFlow;

use glam::DVec3;

use super::{Outcome, Params, Policy, Rules, Simplifier, StoppedBy, candidates::Candidate};
use crate::{
    memoryless,
    mesh::{EdgeTable, EditMesh, Mesh, Step, Topology, VertexId},
    metric::{
        Objective, Pictures, bounding_sphere, energy_of_d2, reference_pictures, scene_of_edit_mesh,
    },
    render::{
        RenderParams, Shading, Twin,
        view::{Projection, ViewParams, cameras, directions},
    },
};

/// A cube of side 2 whose faces are grids of `n`² quads; closed, outward.
fn cube(n: i32) -> Mesh {
    let mut points: Vec<[i32; 3]> = Vec::new();
    let mut faces = Vec::new();
    let mut at = |p: [i32; 3]| {
        let known = points.iter().position(|q| *q == p);
        known.unwrap_or_else(|| {
            points.push(p);
            points.len() - 1
        }) as u32
    };
    for axis in 0..3 {
        for side in [0, n] {
            for i in 0..n {
                for j in 0..n {
                    let mut corner = |di: i32, dj: i32| {
                        let mut p = [0; 3];
                        p[axis] = side;
                        p[(axis + 1) % 3] = i + di;
                        p[(axis + 2) % 3] = j + dj;
                        at(p)
                    };
                    let [a, b, c, d] = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                    let quad = if side == n { [a, b, c, d] } else { [a, d, c, b] };
                    faces.push([quad[0], quad[1], quad[2]]);
                    faces.push([quad[0], quad[2], quad[3]]);
                }
            }
        }
    }
    let scale = 2.0 / f64::from(n);
    let positions = points.iter().map(|p| DVec3::from_array(p.map(f64::from)) * scale).collect();
    Mesh::from_parts(positions, faces)
}

fn pictures(mesh: &Mesh, shading: Shading) -> Pictures {
    let view_params = ViewParams {
        directions: directions(8).unwrap(),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 10.0,
    };
    let params = RenderParams {
        image_size: 128,
        shading,
        ambient: 0.1,
        background: 128,
        interior_views: 0,
        hides_back_faces: false,
    };
    Pictures::of(mesh, params, cameras(&bounding_sphere(mesh), &view_params))
}

/// What shows a mesh beside the original.
fn objective(pictures: &Pictures, original: &Mesh, mesh: &EditMesh) -> Objective {
    let reference = reference_pictures(original, pictures);
    let scene = scene_of_edit_mesh(mesh, pictures);
    let twin = Twin::new(&scene, &reference);
    Objective::new(mesh, &pictures.palette, scene, Box::new(twin))
}

fn params(policy: Policy, topology: Topology, ends: Ends) -> Params {
    Params {
        policy,
        rules: Rules { topology, memoryless: memoryless::Params::default() },
        batch: 8,
        ahead: 4,
        search_rounds: 2,
        max_evaluations: ends.max_evaluations,
        max_energy: ends.max_energy,
    }
}

/// When a run ends.
#[derive(Clone, Copy, Default)]
struct Ends {
    target: usize,
    max_evaluations: u64,
    max_energy: Option<u64>,
}

/// Returns the outcome, d2 in percent, evaluations and the mesh.
fn run(policy: Policy, ends: Ends) -> (Outcome, f64, u64, Mesh) {
    let original = cube(6);
    let pictures = pictures(&original, Shading::Flat);
    let mut mesh = EditMesh::new(original.clone()).unwrap();
    let mut objective = objective(&pictures, &original, &mesh);
    let params = params(policy, Topology::Preserve, ends);
    let mut edits = 0;
    let mut simplifier = Simplifier::new(&mut mesh, &mut objective, params);
    let outcome = simplifier
        .run_to(ends.target, &mut |step| {
            edits += u64::from(matches!(step, Step::Edit(_)));
            ControlFlow::Continue(())
        })
        .unwrap();
    assert_eq!(edits, outcome.collapses);
    assert!(mesh.validate().is_ok());
    // The pictures show the mesh, whatever was tried last.
    let shown = self::objective(&pictures, &original, &mesh);
    assert_eq!(objective.energy(), shown.energy());
    let d2 = objective.d2_percent();
    (outcome, d2, objective.evaluations(), mesh.snapshot())
}

#[test]
fn what_does_not_show_goes_first() {
    for policy in [Policy::Lazy, Policy::Mixed, Policy::Eager] {
        let (outcome, d2, _, mesh) = run(policy, Ends { target: 12, ..Ends::default() });
        assert_eq!(outcome.stopped_by, StoppedBy::Target, "{policy:?}");
        assert_eq!(mesh.faces.len(), 12);
        // A cube again: what is left of the difference is the snapping of edges to the lattice.
        assert!(d2 < 0.7, "{policy:?}: d2 {d2}%");
    }
}

#[test]
fn budgets_are_kept_and_said() {
    let (outcome, _, evaluations, mesh) =
        run(Policy::Eager, Ends { target: 12, max_evaluations: 5000, ..Ends::default() });
    assert_eq!(outcome.stopped_by, StoppedBy::Evaluations);
    assert!(mesh.faces.len() > 12 && evaluations < 5600, "{evaluations}");
}

#[test]
fn a_target_below_what_topology_allows_is_not_reached() {
    let (outcome, _, _, mesh) = run(Policy::Lazy, Ends { target: 1, ..Ends::default() });
    assert_eq!(outcome.stopped_by, StoppedBy::NoLegalCollapse);
    assert_eq!(mesh.faces.len(), 4, "a tetrahedron is the last closed surface");
}

#[test]
fn no_collapse_lifts_the_energy_above_what_is_allowed() {
    let n_pixels = 8 * 128 * 128;
    for policy in [Policy::Lazy, Policy::Eager] {
        for percent in [0.1, 2.0] {
            let most = energy_of_d2(percent, n_pixels);
            let ends = Ends { target: 4, max_energy: Some(most), ..Ends::default() };
            let (outcome, d2, _, mesh) = run(policy, ends);
            assert_eq!(outcome.stopped_by, StoppedBy::Energy, "{policy:?}, {percent}%");
            assert!(d2 <= percent, "{policy:?}: {d2}% of {percent}%");
            // The collapse that was not made.
            let target = mesh.faces.len() - 2;
            let (_, d2, ..) = run(policy, Ends { target, ..Ends::default() });
            assert!(d2 > percent, "{policy:?}: {d2}% of {percent}% and one more");
        }
    }
}

#[test]
fn where_topology_is_free_a_rise_is_for_each_triangle_that_goes() {
    // Three triangles at the edge (0, 1).
    let positions = [DVec3::ZERO, DVec3::X, DVec3::Y, -DVec3::Y, DVec3::Z];
    let original = Mesh::from_parts(positions.to_vec(), vec![[0, 1, 2], [1, 0, 3], [0, 1, 4]]);
    let shown = pictures(&original, Shading::Flat);
    let check = |topology, ends: [u32; 2], delta, expected: f64| {
        let mut mesh = EditMesh::new(original.clone()).unwrap();
        let mut objective = objective(&shown, &original, &mesh);
        let edge = EdgeTable::new(&mesh).find(VertexId(ends[0]), VertexId(ends[1])).unwrap();
        let params = params(Policy::Lazy, topology, Ends::default());
        let simplifier = Simplifier::new(&mut mesh, &mut objective, params);
        let found = simplifier.per_triangle(&Candidate { edge, to: DVec3::ZERO, delta });
        assert!((found - expected).abs() < 1e-15, "{topology:?} {ends:?}: {found}");
    };
    check(Topology::Free, [0, 1], 10, 2.0 / 3.0);
    check(Topology::Free, [0, 2], 10, 2.0);
    // What is won is won, whatever it takes away.
    check(Topology::Free, [0, 2], -10, 1.0);
    check(Topology::Preserve, [0, 2], 10, 1.0);
}
