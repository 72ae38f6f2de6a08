//! Whole runs on a small bumpy ball that was simplified crudely.

use std::ops::ControlFlow;

use glam::DVec3;

use super::{
    OptimizeError, Optimizer, Outcome, Params, Solver, StoppedBy, Turns, alternate,
    descent::{self, Destination, Unknowns},
};
use crate::{
    memoryless,
    mesh::{
        AttributeLayer, EditMesh, Image, Marks, Material, Mesh, Pixels, Sample, Semantic, Step,
        Texture, TextureUse, WedgeId, shapes,
    },
    metric::{
        Objective, Pictures, ViewSet, bounding_sphere, reference_pictures, scene_as_drawn, slopes,
        with_vertex_normals,
    },
    render::{
        RenderParams, Shading, Twin,
        view::{Projection, ViewParams, cameras, directions},
    },
    tape::{Answer, Tape},
};

const TURNS: Turns =
    Turns { evaluations: 1_000, n_others: 1, n_looked_at: 4, steps: [12, 6, 12], cycle: 0 };

/// A torus with bumps, and what 100 triangles are left of it.
pub fn models() -> (Mesh, Mesh) {
    models_of(shapes::torus(24, 16, 0.2), 100)
}

fn models_of(original: Mesh, n_faces: u32) -> (Mesh, Mesh) {
    let mut mesh = EditMesh::new(original.clone()).unwrap();
    let params = memoryless::Params::default();
    memoryless::simplify(&mut mesh, n_faces, &params, &mut |_| ControlFlow::Continue(()));
    (original, mesh.snapshot())
}

/// A mesh with a value for each vertex, which is a wave.
fn with_layer(mut mesh: Mesh, semantic: Semantic, width: usize, value: fn(f64) -> f64) -> Mesh {
    mesh.face_wedges.clone_from(&mesh.faces);
    let values = |p: &DVec3| [p.x, p.y, p.z, 1.0].map(|x| value(x) as f32);
    let values = mesh.positions.iter().flat_map(|p| values(p).into_iter().take(width)).collect();
    mesh.layers = vec![AttributeLayer { semantic, width, values }];
    mesh
}

/// With a texture of stripes, far from evenly laid out.
fn striped(mesh: Mesh) -> Mesh {
    let place = |x: f64| 0.5 + 0.3 * x + 0.05 * libm::sin(4.0 * x);
    let mut mesh = with_layer(mesh, Semantic::TexCoord(0), 2, place);
    let texel = |k: u32| [if (k % 64 / 8 + k / 512).is_multiple_of(2) { 60 } else { 250 }; 4];
    let pixels = Pixels { width: 64, height: 64, rgba: (0..64 * 64).flat_map(texel).collect() };
    mesh.images = vec![Image { pixels: Some(pixels.into()), ..Image::default() }];
    mesh.textures = vec![Texture { image: Some(0), ..Texture::default() }];
    let transform = TextureUse::IDENTITY;
    let base_texture = Some(TextureUse { texture: 0, tex_coord: 0, transform });
    mesh.materials = vec![Material { base_texture, ..Material::default() }];
    mesh
}

fn coloured(mesh: Mesh) -> Mesh {
    with_layer(mesh, Semantic::Color(0), 4, |x| 0.5 + 0.2 * libm::sin(3.0 * x))
}

pub fn pictures(original: &Mesh, shading: Shading) -> Pictures {
    pictures_of(original, shading, 64)
}

fn pictures_of(original: &Mesh, shading: Shading, image_size: u32) -> Pictures {
    let view_params = ViewParams {
        directions: directions(6).unwrap(),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 10.0,
    };
    let params = RenderParams {
        image_size,
        shading,
        ambient: 0.1,
        background: 128,
        interior_views: 0,
        hides_back_faces: false,
    };
    Pictures::of(original, params, cameras(&bounding_sphere(original), &view_params))
}

pub fn show(original: &Mesh, pictures: &Pictures, mesh: &EditMesh, has_normals: bool) -> Objective {
    let reference = reference_pictures(original, pictures);
    let scene = scene_as_drawn(mesh, pictures, has_normals);
    let twin = Twin::new(&scene, &reference);
    let objective = Objective::new(mesh, &pictures.palette, scene, Box::new(twin));
    let objective = objective.with_reference(reference);
    if has_normals { objective.with_own_normals() } else { objective }
}

/// What came of a run.
#[derive(Debug)]
struct Ran {
    outcome: Outcome,
    samples: Vec<Sample>,
    /// The mesh that the records make of the one before.
    replayed: Mesh,
    mesh: Mesh,
    /// View sets that were shown (see [`take_turns`]).
    turns: Vec<usize>,
}

/// Runs and checks what every run must keep: samples fall, records replay, pictures are exact.
fn check(params: &Params, shading: Shading, has_normals: bool) -> Ran {
    let (original, simplified) = models();
    let simplified = if has_normals { with_vertex_normals(simplified) } else { simplified };
    let pictures = pictures(&original, shading);
    let mut mesh = EditMesh::new(simplified.clone()).unwrap();
    let mut replay = EditMesh::new(simplified).unwrap();
    let mut objective = show(&original, &pictures, &mesh, has_normals);
    let mut samples = Vec::new();
    let outcome = Optimizer::new(&mut mesh, &mut objective, params.clone())
        .run(&mut |step| {
            match step {
                Step::Edit(edit) => replay.redo(edit),
                Step::Sample(sample) => samples.push(sample),
                Step::Moves(_) | Step::Progress { .. } => {}
            }
            ControlFlow::Continue(())
        })
        .unwrap();
    mesh.validate().unwrap();
    let fresh = show(&original, &pictures, &mesh, has_normals);
    assert_eq!(fresh.energy(), outcome.energy_after, "pictures and mesh differ");
    assert!(params.allows_uphill || samples.is_sorted_by_key(|s| std::cmp::Reverse(s.energy)));
    assert_eq!((mesh.n_faces(), mesh.n_vertices()), (100, 50));
    Ran { outcome, samples, replayed: replay.snapshot(), mesh: mesh.snapshot(), turns: Vec::new() }
}

fn budget(max_evaluations: u64) -> Params {
    Params { max_evaluations, sample_every: 500, edges_per_iteration: 16, ..Params::default() }
}

#[test]
fn the_energy_falls_and_the_records_tell_how() {
    let ran = check(&budget(30_000), Shading::Flat, false);
    assert_eq!(ran.outcome.stopped_by, StoppedBy::Evaluations);
    assert!(ran.outcome.energy_after * 10 < ran.outcome.energy_before * 7, "{:?}", ran.outcome);
    assert!(ran.replayed == ran.mesh);
    assert!(ran.samples.len() > 10 && ran.outcome.evaluations < 32_000);
    for name in ["vertex", "no-op 1", "swap 0", "split 1", "collapse 1"] {
        let tried = ran.outcome.moves.iter().find(|m| m.name == name);
        assert!(tried.is_some_and(|m| m.evaluations > 0), "{name}: {:?}", ran.outcome.moves);
    }
}

#[test]
fn the_same_seed_gives_the_same_mesh() {
    let [a, b, c] =
        [1, 1, 2].map(|seed| check(&Params { seed, ..budget(4_000) }, Shading::Flat, false));
    assert!(a.mesh == b.mesh && a.samples == b.samples);
    assert!(a.mesh != c.mesh);
}

#[test]
fn the_paper_s_way_works_too() {
    let params = Params {
        solver: Solver::Simplex,
        has_sweeps: false,
        allows_uphill: true,
        ..budget(12_000)
    };
    let plain = check(&params, Shading::Flat, false);
    assert!(plain.outcome.energy_after * 10 < plain.outcome.energy_before * 9);
    assert!(plain.replayed == plain.mesh);
}

#[test]
fn normals_of_their_own_are_optimized_with_the_places() {
    let still = check(&budget(6_000), Shading::Smooth, true);
    let params = Params { optimizes_normals: true, ..budget(6_000) };
    let free = check(&params, Shading::Smooth, true);
    assert!(free.replayed == free.mesh && still.replayed == still.mesh);
    assert!(free.outcome.energy_after < still.outcome.energy_after);
    check(&budget(3_000), Shading::Smooth, false);
}

#[test]
fn a_run_ends_where_it_is_asked_to() {
    let until = check(&Params { until: 0.9, ..budget(0) }, Shading::Flat, false).outcome;
    assert_eq!(until.stopped_by, StoppedBy::Energy);
    assert!(until.energy_after * 10 <= until.energy_before * 9);
    let (original, simplified) = models();
    let pictures = pictures(&original, Shading::Flat);
    let mut mesh = EditMesh::new(simplified).unwrap();
    let mut objective = show(&original, &pictures, &mesh, false);
    let mut n_edits = 0;
    let outcome = Optimizer::new(&mut mesh, &mut objective, budget(0)).run(&mut |step| {
        n_edits += u32::from(matches!(step, Step::Edit(_)));
        if n_edits >= 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert_eq!(outcome.unwrap().stopped_by, StoppedBy::Caller);
    assert_eq!(n_edits, 3);
}

#[test]
fn views_take_turns_and_the_last_word_is_told() {
    let (original, simplified) = models();
    let pictures = pictures(&original, Shading::Flat);
    let ran = take_turns(&original, simplified, &pictures, &budget(8_000), 0);
    // The view sets' judgement, a turn each, ends the run before its budget does.
    assert!(
        ran.turns.starts_with(&[0, 0, 1, 0]) && ran.turns.last() == Some(&0),
        "{:?}",
        ran.turns
    );
    assert!(ran.replayed == ran.mesh, "the edits that were told do not lead to the mesh");
    let now = show(&original, &pictures, &EditMesh::new(ran.mesh).unwrap(), false).energy();
    let (first, last) = (ran.samples[0], ran.samples[ran.samples.len() - 1]);
    assert_eq!((ran.outcome.energy_after, last.energy), (now, Some(now)));
    assert_eq!((first.evaluations, last.evaluations), (0, ran.outcome.evaluations));
    assert!(ran.samples.is_sorted_by_key(|s| s.evaluations));
    assert!(ran.outcome.evaluations < 9_000, "{:?}", ran.outcome);
    assert!(now * 10 < ran.outcome.energy_before * 9, "{:?}", ran.outcome);
}

#[test]
fn turns_are_repeatable_and_move_normals_where_asked() {
    let (original, simplified) = models();
    let pictures = pictures(&original, Shading::Smooth);
    let simplified = with_vertex_normals(simplified);
    let [still, free, again] = [false, true, true].map(|optimizes_normals| {
        let params = Params { optimizes_normals, ..budget(5_000) };
        take_turns(&original, simplified.clone(), &pictures, &params, 0)
    });
    assert!(free.mesh == again.mesh && free.samples == again.samples);
    assert!(free.replayed == free.mesh && still.replayed == still.mesh);
    assert!(free.outcome.energy_after < still.outcome.energy_after);
}

#[test]
fn texture_coordinates_and_colours_move_where_asked() {
    let torus = || shapes::torus(24, 16, 0.2);
    for dressed in [striped(torus()), coloured(torus())] {
        let (original, simplified) = models_of(dressed, 100);
        let pictures = pictures(&original, Shading::Flat);
        let [still, free, again] = [false, true, true].map(|optimizes_attributes| {
            let params = Params { optimizes_attributes, ..budget(5_000) };
            take_turns(&original, simplified.clone(), &pictures, &params, 0)
        });
        assert!(free.mesh == again.mesh && free.samples == again.samples);
        assert!(free.replayed == free.mesh && still.replayed == still.mesh);
        let [still_energy, energy] = [&still, &free].map(|ran| ran.outcome.energy_after);
        assert!(energy < still_energy, "{energy} instead of {still_energy}");
        let layer = |mesh: &Mesh| mesh.layers[0].clone();
        let (before, after) = (layer(&original), layer(&free.mesh));
        for at in 0..before.width {
            let numbers = |l: &AttributeLayer| -> Vec<f32> {
                l.values.iter().skip(at).step_by(l.width).copied().collect()
            };
            let end = |l: &AttributeLayer, pick: fn(f32, f32) -> f32| {
                numbers(l).into_iter().reduce(pick).unwrap()
            };
            let (low, high) = match before.semantic {
                Semantic::Color(_) if at < 3 => (0.0, 1.0),
                _ => (end(&before, f32::min), end(&before, f32::max)),
            };
            assert!(end(&after, f32::min) >= low && end(&after, f32::max) <= high, "{at}");
        }
    }
}

/// What differs is where the stripes are, or the colours: descents find most of it again. A triangle has 512 pixels, as
/// wherever descents are made.
#[test]
fn descents_find_coordinates_and_colours_again() {
    let torus = || shapes::torus(12, 8, 0.2);
    for (original, off) in [(striped(torus()), 0.015), (coloured(torus()), 0.1)] {
        let mut wrong = original.clone();
        let waves = |i: usize| if i.is_multiple_of(3) { off } else { -off };
        let values = wrong.layers[0].values.iter_mut().enumerate();
        values.for_each(|(i, value)| *value = (*value + waves(i)).clamp(0.0, 1.0));
        let pictures = pictures_of(&original, Shading::Flat, 128);
        let sets = [ViewSet::turned(&original, &pictures, bounding_sphere(&original).center, 0)];
        let energy = |mesh: &EditMesh| {
            let scene = scene_as_drawn(mesh, &sets[0].pictures, false);
            slopes(&scene, &sets[0].reference, false, None).energy
        };
        let after = |attributes| {
            let mut mesh = EditMesh::new(wrong.clone()).unwrap();
            let unknowns = Unknowns { has_own_normals: false, normals: false, attributes };
            let on = &mut |_| ControlFlow::Continue(());
            let found = descent::descend(&mesh, &sets, (0, 40), unknowns, on);
            descent::go(&mut mesh, &found.continue_value().unwrap());
            energy(&mesh)
        };
        let before = energy(&EditMesh::new(wrong.clone()).unwrap());
        let (still, free) = (after(false), after(true));

        assert!(free < 0.3 * before && free < 0.5 * still, "{before}, {still}, {free}");
    }
}

/// With locked vertices their values stay, too.
#[test]
fn values_at_locked_vertices_stay() {
    let (original, simplified) = models_of(striped(shapes::torus(24, 16, 0.2)), 100);
    let pictures = pictures(&original, Shading::Flat);
    let sets = [ViewSet::turned(&original, &pictures, bounding_sphere(&original).center, 0)];
    let is_locked = |v: usize| v.is_multiple_of(3);
    let locked = (0..simplified.positions.len()).map(is_locked).collect();
    let mesh = EditMesh::new(simplified.clone()).unwrap();
    let mut mesh = mesh.with_marks(Marks { locked, ..Marks::default() });
    let unknowns = Unknowns { has_own_normals: false, normals: false, attributes: true };
    let found =
        descent::descend(&mesh, &sets, (0, 12), unknowns, &mut |_| ControlFlow::Continue(()));
    let found = found.continue_value().unwrap();
    descent::go(&mut mesh, &found);
    let after = mesh.mesh();
    let layer = &after.layers[0];
    let (mut n_moved, mut n_kept) = (0, 0);
    for (face, (old, new)) in simplified.face_wedges.iter().zip(&after.face_wedges).enumerate() {
        for k in 0..3 {
            let stays = layer.get(WedgeId(old[k])) == layer.get(WedgeId(new[k]));
            let is_free = !is_locked(simplified.faces[face][k] as usize);
            assert!(stays || is_free, "a corner of a locked vertex");
            *if stays { &mut n_kept } else { &mut n_moved } += 1;
        }
    }
    assert!(n_moved > 100 && n_kept > 100, "{n_moved} moved, {n_kept} kept");
    // Nothing is lost on a tape.
    let mut bytes = Vec::new();
    found.write(&mut bytes);
    assert_eq!(Destination::read(&mut bytes.as_slice()), Some(found));
}

#[test]
fn cycles_keep_the_triangles_and_tell_the_edits_of_those_that_helped() {
    for shading in [Shading::Flat, Shading::Smooth] {
        let (original, simplified) = models();
        let pictures = pictures(&original, shading);
        let start = match shading {
            Shading::Flat => simplified,
            Shading::Smooth => with_vertex_normals(simplified),
        };
        let params = Params { optimizes_normals: true, ..budget(12_000) };
        let run = |cycle| take_turns(&original, start.clone(), &pictures, &params, cycle);
        let (plain, ran, again) = (run(0), run(4_000), run(4_000));
        assert!(ran.mesh == again.mesh && ran.samples == again.samples);
        assert!(ran.mesh != plain.mesh, "no cycle has helped");
        assert!(ran.replayed == ran.mesh, "the edits that were told do not lead to the mesh");
        assert!((99..=100).contains(&ran.mesh.faces.len()), "{}", ran.mesh.faces.len());
        assert!(ran.samples.iter().all(|s| (99..=100).contains(&s.triangles)), "{:?}", ran.samples);
        assert!(ran.samples.is_sorted_by_key(|s| s.evaluations));
        assert!((11_000..13_000).contains(&ran.outcome.evaluations), "{:?}", ran.outcome);
    }
}

/// Four cycles of the whole mesh, then some of its patches (which 100 triangles are too few for), and turns where there
/// are evaluations left. Not every cycle helps so small a mesh.
#[test]
fn later_cycles_go_patch_by_patch_and_tell_what_they_keep() {
    let (original, simplified) = models_of(shapes::torus(24, 16, 0.2), 300);
    let mut n_better = 0;
    for (seed, shading) in [Shading::Flat, Shading::Smooth].into_iter().cycle().take(8).enumerate()
    {
        let pictures = pictures(&original, shading);
        let start = match shading {
            Shading::Flat => simplified.clone(),
            Shading::Smooth => with_vertex_normals(simplified.clone()),
        };
        let seed = seed as u64 / 2;
        let params = Params { optimizes_normals: true, seed, ..budget(112_000) };
        let run = || take_turns(&original, start.clone(), &pictures, &params, 15_000);
        let ran = run();
        assert!(ran.replayed == ran.mesh, "the edits that were told do not lead to the mesh");
        assert!((290..=300).contains(&ran.mesh.faces.len()), "{}", ran.mesh.faces.len());
        // Of the start, four cycles of the whole mesh, the others, the end.
        let energies: Vec<_> = ran.samples.iter().map(|s| s.energy).collect();
        n_better += energies[4..energies.len() - 1].windows(2).filter(|e| e[0] != e[1]).count();
        if seed == 0 {
            let again = run();
            assert!(ran.mesh == again.mesh && ran.samples == again.samples);
        }
    }
    assert!(n_better > 0, "no patch was better");
}

/// Where topology is kept, a part has four triangles at least; this one is in the tube, whose radius is about .4.
#[test]
fn where_topology_is_free_cycles_take_away_what_nobody_sees() {
    let (original, mut start) = models();
    let middle = DVec3::X;
    let small = shapes::octahedron();
    let n_vertices = start.positions.len() as u32;
    start.positions.extend(small.positions.iter().map(|p| middle + 0.1 * *p));
    start.faces.extend(small.faces.iter().map(|face| face.map(|v| n_vertices + v)));
    let pictures = pictures(&original, Shading::Flat);
    let n_inside = [false, true].map(|closes_holes| {
        let params = Params { closes_holes, ..budget(20_000) };
        let ran = take_turns(&original, start.clone(), &pictures, &params, 4_000);
        assert!(ran.replayed == ran.mesh);
        let is_inside = |v: &u32| ran.mesh.positions[*v as usize].distance(middle) < 0.2;
        ran.mesh.faces.iter().filter(|face| face.iter().all(is_inside)).count()
    });
    assert!(n_inside[0] >= 4 && n_inside[1] < 4, "{n_inside:?}");
}

#[test]
fn a_cycle_that_does_not_help_leaves_no_trace() {
    let (original, simplified) = models();
    let pictures = pictures(&original, Shading::Flat);
    let good = take_turns(&original, simplified, &pictures, &budget(20_000), 0);
    // So short that nothing is optimized after a cycle's splits and collapses.
    let ran = take_turns(&original, good.mesh.clone(), &pictures, &budget(20_000), 100);
    assert_eq!(ran.outcome.stopped_by, StoppedBy::Converged);
    assert!(ran.replayed == ran.mesh && ran.mesh.faces == good.mesh.faces);
    let energy = ran.samples[ran.samples.len() - 1].energy;
    // The first sample, those of six cycles, the last.
    assert!(ran.samples.len() == 8 && ran.samples[1..].iter().all(|s| s.energy == energy));
}

#[test]
fn what_is_told_is_what_was_done_wherever_the_caller_breaks_off() {
    let (original, simplified) = models();
    let pictures = pictures(&original, Shading::Flat);
    let center = bounding_sphere(&original).center;
    let sets = [0, 1].map(|turn| ViewSet::turned(&original, &pictures, center, turn));
    for n_edits in [1, 60, 200, 400] {
        let mut mesh = EditMesh::new(simplified.clone()).unwrap();
        let mut replay = EditMesh::new(simplified.clone()).unwrap();
        let mut n_told = 0;
        let outcome = alternate::<OptimizeError>(
            &mut mesh,
            &budget(40_000),
            Turns { n_looked_at: 2, cycle: 3_000, ..TURNS },
            (&sets, &Tape::off()),
            &mut |set, mesh| Ok(show(&original, &sets[set].pictures, mesh, false)),
            &mut |step| {
                if let Step::Edit(edit) = step {
                    replay.redo(edit);
                    n_told += 1;
                }
                let is_over = n_told >= n_edits;
                if is_over { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            },
        );
        assert_eq!(outcome.unwrap().stopped_by, StoppedBy::Caller);
        assert!(replay.snapshot() == mesh.snapshot(), "broken off after {n_edits} edits");
    }
}

#[test]
fn turns_end_where_they_are_asked_to() {
    let (original, simplified) = models();
    let pictures = pictures(&original, Shading::Flat);
    let params = Params { until: 0.8, ..budget(1 << 20) };
    let outcome = take_turns(&original, simplified, &pictures, &params, 4_000).outcome;
    assert_eq!(outcome.stopped_by, StoppedBy::Energy);
    assert!(outcome.energy_after * 10 <= outcome.energy_before * 8, "{outcome:?}");
    assert!(outcome.energy_after * 10 >= outcome.energy_before * 6, "{outcome:?}");
}

/// Normals are the mesh's own if it has any.
fn take_turns(
    original: &Mesh,
    start: Mesh,
    pictures: &Pictures,
    params: &Params,
    cycle: u64,
) -> Ran {
    let has_normals = start.layer(Semantic::Normal).is_some();
    let center = bounding_sphere(original).center;
    let set = |turn| ViewSet::turned(original, pictures, center, turn);
    let sets: Vec<ViewSet> = (0..4).map(set).collect();
    let mut mesh = EditMesh::new(start.clone()).unwrap();
    let mut replay = EditMesh::new(start).unwrap();
    let (mut turns, mut samples) = (Vec::new(), Vec::new());
    let outcome = alternate::<OptimizeError>(
        &mut mesh,
        params,
        Turns { cycle, ..TURNS },
        (&sets, &Tape::off()),
        &mut |set, mesh| {
            turns.push(set);
            Ok(show(original, &sets[set].pictures, mesh, has_normals))
        },
        &mut |step| {
            match step {
                Step::Edit(edit) => replay.redo(edit),
                Step::Sample(sample) => samples.push(sample),
                Step::Moves(_) | Step::Progress { .. } => {}
            }
            ControlFlow::Continue(())
        },
    )
    .unwrap();
    mesh.validate().unwrap();
    Ran { outcome, samples, replayed: replay.snapshot(), mesh: mesh.snapshot(), turns }
}
