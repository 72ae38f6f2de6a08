//! What every evaluator must do, run on each of them (`check_all`), with hand-made scenes.

use std::sync::Arc;

use glam::DVec3;
use proptest::{
    prelude::*,
    test_runner::{Config, RngAlgorithm, TestRng, TestRunner},
};

use super::{
    evaluator::{Evaluator, Reference},
    moves::{AddedFace, Move},
    paint::{Alpha, Paint, Sieve, Texels},
    raster,
    scene::{RenderParams, Scene, SceneFace, Shading, Surface},
    twin::Twin,
    view::{BoundingSphere, Projection, ViewParams, cameras, directions},
};

/// A bumpy sphere: `n` × `2n` quads, each cut in two; normals vary, silhouettes are not convex.
pub fn bumpy_sphere(n: usize) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let (mut positions, mut faces) = (Vec::new(), Vec::new());
    for i in 0..=n {
        for j in 0..2 * n {
            let (theta, phi) = (i as f64 / n as f64, j as f64 / n as f64);
            let (theta, phi) = (theta * std::f64::consts::PI, phi * std::f64::consts::PI);
            let r = 1.0 + 0.2 * libm::sin(5.0 * phi) * libm::sin(4.0 * theta);
            let (st, ct) = libm::sincos(theta);
            let (sp, cp) = libm::sincos(phi);
            positions.push(DVec3::new(st * cp, ct, st * sp) * r);
        }
    }
    let at = |i: usize, j: usize| (i * 2 * n + j % (2 * n)) as u32;
    for i in 0..n {
        for j in 0..2 * n {
            faces.push([at(i, j), at(i, j + 1), at(i + 1, j)]);
            faces.push([at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)]);
        }
    }
    (positions, faces)
}

/// How a test scene is drawn.
#[derive(Clone, Copy, Debug)]
#[expect(clippy::struct_excessive_bools, reason = "independent traits of a test scene")]
pub struct Look {
    pub image_size: u32,
    pub n_views: u32,
    pub shading: Shading,
    pub projection: Projection,
    pub interior_views: usize,
    pub coloured: bool,
    pub painted: bool,
    pub glows: bool,
    pub hides_back_faces: bool,
    /// The views show different channels.
    pub by_channel: bool,
    /// Not every pixel counts the same.
    pub is_weighed: bool,
}

const PLAIN: Look = Look {
    image_size: 64,
    n_views: 4,
    shading: Shading::Flat,
    projection: Projection::Perspective,
    interior_views: 0,
    coloured: false,
    painted: false,
    glows: false,
    hides_back_faces: false,
    by_channel: false,
    is_weighed: false,
};

pub const LOOKS: [Look; 10] = [
    PLAIN,
    Look {
        image_size: 128,
        n_views: 6,
        shading: Shading::Smooth,
        projection: Projection::Orthographic,
        interior_views: 3,
        coloured: true,
        ..PLAIN
    },
    Look {
        image_size: 104,
        n_views: 8,
        projection: Projection::Orthographic,
        interior_views: 8,
        coloured: true,
        ..PLAIN
    },
    Look { image_size: 256, n_views: 20, shading: Shading::Smooth, ..PLAIN },
    Look {
        image_size: 128,
        n_views: 4,
        interior_views: 1,
        coloured: true,
        painted: true,
        hides_back_faces: true,
        ..PLAIN
    },
    Look {
        image_size: 64,
        n_views: 6,
        shading: Shading::Smooth,
        projection: Projection::Orthographic,
        coloured: true,
        painted: true,
        hides_back_faces: true,
        ..PLAIN
    },
    Look {
        image_size: 64,
        n_views: 6,
        shading: Shading::Smooth,
        interior_views: 3,
        coloured: true,
        painted: true,
        by_channel: true,
        ..PLAIN
    },
    Look { image_size: 104, n_views: 6, painted: true, is_weighed: true, ..PLAIN },
    Look { is_weighed: true, ..PLAIN },
    Look {
        image_size: 128,
        n_views: 6,
        coloured: true,
        painted: true,
        glows: true,
        by_channel: true,
        ..PLAIN
    },
];

/// The scene of a bumpy sphere.
pub fn scene(n: usize, look: Look) -> Scene {
    let (positions, faces) = bumpy_sphere(n);
    scene_of(positions, faces, look)
}

/// Its pictures, and where pixels have weights, any.
pub fn reference(scene: &Scene, look: Look) -> Reference {
    let mut reference = raster::reference(scene);
    if look.is_weighed {
        let weight = |k: u32| (k.wrapping_mul(2_654_435_761) >> 28) as u8 + 1;
        let weigh = |p: &Vec<u8>| (0..p.len() as u32).map(weight).collect();
        reference.weights = reference.pictures.iter().map(weigh).collect();
    }
    reference
}

/// The scene of any triangles.
pub fn scene_of(positions: Vec<DVec3>, faces: Vec<[u32; 3]>, look: Look) -> Scene {
    let sphere = BoundingSphere::of(positions.iter().copied());
    scene_within(&sphere, positions, faces, look)
}

/// [`scene_of`] whose pictures show a sphere, whatever is beside it.
pub fn scene_within(
    sphere: &BoundingSphere,
    positions: Vec<DVec3>,
    faces: Vec<[u32; 3]>,
    look: Look,
) -> Scene {
    let view_params = ViewParams {
        directions: directions(look.n_views).unwrap(),
        fov_degrees: 60.0,
        projection: look.projection,
        light_degrees: 10.0,
    };
    let mut views = cameras(sphere, &view_params);
    // Not every view counts as much.
    views.iter_mut().zip([3, 1, 0]).for_each(|(view, weight)| view.weight = weight);
    let n_channels = if look.by_channel { 3 } else { 1 };
    views.iter_mut().zip((0..n_channels).cycle()).for_each(|(view, k)| view.channel = k);
    let params = RenderParams {
        image_size: look.image_size,
        shading: look.shading,
        ambient: 0.1,
        background: 128,
        interior_views: look.interior_views,
        hides_back_faces: look.hides_back_faces,
    };
    let albedo = |f: usize| if look.coloured { [(f * 7 % 256) as u8, 255, 90] } else { [255; 3] };
    let channels = |albedo: u8| [albedo, 255 - albedo, albedo / 2];
    let surface = |f: usize, corners: [u32; 3]| Surface {
        is_unlit: look.painted && f.is_multiple_of(7),
        is_single_sided: !f.is_multiple_of(3),
        albedo: albedo(f).map(channels),
        paint: look.painted.then(|| {
            let paint = paint(f, corners.map(|v| positions[v as usize]));
            Paint { map: paint.map * u32::from(n_channels), ..paint }
        }),
    };
    let faces = faces.into_iter().enumerate();
    let faces =
        faces.map(|(f, v)| Some(SceneFace { vertices: v, surface: surface(f, v) })).collect();
    Scene::new(params, views, Arc::new(texels(u32::from(n_channels), look.glows)), positions, faces)
}

/// Four textures: a repeated one, one that is not square and held at its edges along one axis, one with holes that a
/// threshold makes, and one that is dithered; each of so many channels. If it
/// `glows`, the first and the last give something off.
fn texels(n_channels: u32, glows: bool) -> Texels {
    let noise = |k: u32| (k.wrapping_mul(2_654_435_761) >> 24) as u8;
    let mut texels = Texels::default();
    let mut add = |bits: [u32; 2], is_clamped, alpha: Option<Alpha>, glows: bool| {
        for from in (0..n_channels).map(|channel| 1000 * channel) {
            let n = 1 << (bits[0] + bits[1]);
            let some = |from: u32| (from..from + n).map(noise).collect::<Vec<u8>>();
            let glow = glows.then(|| some(from + n));
            texels.add(bits, some(from), is_clamped, alpha.clone(), glow);
        }
    };
    add([6, 6], [false; 2], None, glows);
    add([5, 3], [true, false], None, false);
    for (sieve, glows) in [(Sieve::Below(100), false), (Sieve::Dithered, glows)] {
        let alpha = Alpha { values: (7..16 * 16 + 7).map(noise).collect(), sieve };
        add([4, 4], [false; 2], Some(alpha), glows);
    }
    texels
}

/// The textures and plain surfaces by turns; coordinates run beyond the texture on all sides, and every ninth
/// triangle has some that are far away.
fn paint(f: usize, corners: [DVec3; 3]) -> Paint {
    let far = if f.is_multiple_of(9) { 300.0 } else { 1.0 };
    let uv = corners.map(|p| [(p.x * 1.7 * far) as f32, (p.y + 0.3 * p.z) as f32]);
    // A texture that is not there leaves a surface plain.
    Paint { map: f as u32 % 5, uv }
}

/// Collapses the edge (keep, drop) of a live face to `to`, by brute force over all faces.
pub fn collapse_move(scene: &Scene, keep: u32, drop: u32, to: DVec3) -> Move {
    let mut mv = Move { moved: [(keep, to)].into_iter().collect(), ..Move::default() };
    let live = || scene.faces.iter().enumerate().filter_map(|(i, f)| f.map(|f| (i as u32, f)));
    let touches = |f: &SceneFace| f.vertices.contains(&keep) || f.vertices.contains(&drop);
    let mut affected: Vec<u32> =
        live().filter(|(_, f)| touches(f)).flat_map(|(_, f)| f.vertices).collect();
    affected.sort_unstable();
    affected.dedup();
    let smooth = scene.params.shading == Shading::Smooth;
    for (id, f) in live() {
        let redraw = smooth && f.vertices.iter().any(|v| affected.binary_search(v).is_ok());
        if !(touches(&f) || redraw) {
            continue;
        }
        mv.removed.push(id);
        if f.vertices.contains(&keep) && f.vertices.contains(&drop) {
            continue;
        }
        let vertices = f.vertices.map(|v| if v == drop { keep } else { v });
        mv.added.push(AddedFace { face: id, vertices, surface: f.surface });
    }
    if smooth {
        mv.normals = new_normals(scene, &mv, &affected);
    }
    mv
}

/// Displaces vertices under flat shading, by brute force over all faces.
pub fn displacement(scene: &Scene, moved: &[(u32, DVec3)]) -> Move {
    let mut mv = Move { moved: moved.iter().copied().collect(), ..Move::default() };
    for (id, f) in scene.faces.iter().enumerate() {
        let touches = |f: &SceneFace| moved.iter().any(|m| f.vertices.contains(&m.0));
        let Some(f) = f.filter(touches) else { continue };
        mv.removed.push(id as u32);
        mv.added.push(AddedFace { face: id as u32, vertices: f.vertices, surface: f.surface });
    }
    mv
}

/// Parallel squares over one another, each of side 2 · `half`, together `height` high, coloured so
/// that each differs from the next. Vertices 4 k to 4 k + 3 are those of square k; two more keep the
/// cameras in place.
pub fn sheets(n: usize, half: f64, height: f64) -> Scene {
    let (mut positions, mut faces) = (Vec::new(), Vec::new());
    for k in 0..n {
        positions.extend(square(half, height * (k as f64 / n as f64 - 0.5)));
        let at = 4 * k as u32;
        faces.extend([[at, at + 1, at + 2], [at, at + 2, at + 3]]);
    }
    positions.extend([DVec3::splat(-0.8), DVec3::splat(0.8)]);
    scene_of(positions, faces, Look { coloured: true, ..LOOKS[0] })
}

/// The corners of a square of side 2 · `half` at a height.
pub fn square(half: f64, z: f64) -> [DVec3; 4] {
    [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
        .map(|(x, y)| DVec3::new(half * x, half * y, z))
}

/// Moves a square of the stack through it to another depth.
pub fn through_the_stack(scene: &Scene, n: usize, rng: &mut TestRng) -> Move {
    let first = 4 * (rng.next_u32() % n as u32);
    let lift = DVec3::Z * (f64::from(rng.next_u32() % 601) / 1000.0 - 0.3);
    let moved: Vec<_> = (first..first + 4).map(|v| (v, scene.position(v) + lift)).collect();
    displacement(scene, &moved)
}

fn new_normals(
    scene: &Scene,
    mv: &Move,
    affected: &[u32],
) -> smallvec::SmallVec<[(u32, DVec3); 0]> {
    let place = |v: u32| mv.moved.iter().find(|m| m.0 == v).map_or(scene.position(v), |m| m.1);
    affected
        .iter()
        .map(|&v| {
            let around = mv.added.iter().filter(|a| a.vertices.contains(&v));
            let sum: DVec3 = around
                .map(|a| a.vertices.map(place))
                .map(|p| (p[1] - p[0]).cross(p[2] - p[0]))
                .sum();
            (v, sum.normalize_or_zero())
        })
        .collect()
}

/// A random collapse: any edge of any live face, placed near its middle.
pub fn random_move(scene: &Scene, pick: (usize, usize), offset: DVec3) -> Option<Move> {
    let live: Vec<_> = scene.faces.iter().flatten().collect();
    let face = live.get(pick.0 % live.len().max(1))?;
    let (a, b) = (face.vertices[pick.1 % 3], face.vertices[(pick.1 + 1) % 3]);
    if a == b {
        return None;
    }
    let to = (scene.position(a) + scene.position(b)) * 0.5 + offset;
    let mv = collapse_move(scene, a, b, to);
    (mv.added.len() < 200).then_some(mv)
}

fn pictures(evaluator: &mut dyn Evaluator, scene: &Scene) -> Vec<Vec<u8>> {
    (0..scene.n_views()).map(|v| evaluator.picture(scene, v).unwrap()).collect()
}

/// Random edits: the accumulated change equals a full re-render, to the bit, throughout.
fn check(make: &dyn Fn(&Scene, Reference) -> Box<dyn Evaluator>, look: Look, n_edits: u32) {
    let mut runner = TestRunner::new_with_rng(
        Config { cases: 1, max_shrink_iters: 0, failure_persistence: None, ..Config::default() },
        TestRng::deterministic_rng(RngAlgorithm::ChaCha),
    );
    let picks = prop::collection::vec(
        ((0_usize..100_000, 0_usize..3), prop::array::uniform3(-0.15_f64..0.15)),
        n_edits as usize,
    );
    runner
        .run(&picks, |picks| {
            let mut scene = scene(12, look);
            let reference = reference(&scene, look);
            let mut evaluator = make(&scene, reference.clone());
            prop_assert_eq!(evaluator.energy(), 0);
            for (step, (pick, offset)) in picks.into_iter().enumerate() {
                let Some(mv) = random_move(&scene, pick, DVec3::from_array(offset)) else {
                    continue;
                };
                // Judging does not change anything, and a batch judges like one.
                let batch = vec![mv.clone(); 5];
                let judged = evaluator.evaluate(&scene, &batch).unwrap();
                let before = evaluator.energy();
                let delta = evaluator.commit(&mut scene, &mv).unwrap();
                prop_assert_eq!(judged, vec![delta; 5]);
                prop_assert_eq!(evaluator.energy(), before.saturating_add_signed(delta));
                if step % 20 == 19 {
                    let shown = pictures(evaluator.as_mut(), &scene);
                    let full = raster::reference(&scene).pictures;
                    prop_assert_eq!(
                        raster::energy(&scene.views, &reference, &full),
                        evaluator.energy()
                    );
                    prop_assert!(shown == full, "pictures differ after {} edits", step);
                }
            }
            Ok(())
        })
        .unwrap();
}

/// Lists far longer than any fixed size: sixty sheets over one another, moved through the stack.
fn check_deep(make: &dyn Fn(&Scene, Reference) -> Box<dyn Evaluator>, n_edits: u32) {
    let n = 60;
    let mut scene = sheets(n, 0.7, 0.3);
    let reference = raster::reference(&scene);
    let mut evaluator = make(&scene, reference.clone());
    let mut rng = TestRng::deterministic_rng(RngAlgorithm::ChaCha);
    for _ in 0..n_edits {
        let mv = through_the_stack(&scene, n, &mut rng);
        let judged = evaluator.evaluate(&scene, std::slice::from_ref(&mv)).unwrap();
        assert_eq!(judged, [evaluator.commit(&mut scene, &mv).unwrap()]);
        let full = raster::reference(&scene).pictures;
        assert_eq!(raster::energy(&scene.views, &reference, &full), evaluator.energy());
        assert!(pictures(evaluator.as_mut(), &scene) == full);
    }
}

/// The whole contract, for every look.
pub fn check_all(make: &dyn Fn(&Scene, Reference) -> Box<dyn Evaluator>, n_edits: u32) {
    for look in LOOKS {
        check(make, look, n_edits);
    }
    check_deep(make, n_edits / 10);
}

#[test]
fn the_native_twin_keeps_the_contract() {
    check_all(&|scene, reference| Box::new(Twin::new(scene, &reference)), 260);
}

/// A collapse and a displacement by turns, of whatever is left.
fn any_edit(scene: &Scene, step: u32, rng: &mut TestRng) -> Option<Move> {
    let offset = [0; 3].map(|_: i32| f64::from(rng.next_u32() % 2001) / 20_000.0 - 0.05);
    let (pick, offset) = ((rng.next_u32() as usize, 0), DVec3::from_array(offset));
    if step.is_multiple_of(2) {
        return random_move(scene, pick, offset);
    }
    let v = scene.faces.iter().flatten().nth(pick.0 % 4000)?.vertices[0];
    let to = scene.position(v).lerp(DVec3::ZERO, 0.01) + offset;
    Some(displacement(scene, &[(v, to)]))
}

#[test]
fn ten_thousand_edits_equal_a_full_re_render() {
    for look in [LOOKS[0], LOOKS[5]] {
        let mut scene = scene(60, look);
        let reference = raster::reference(&scene);
        let mut twin = Twin::new(&scene, &reference);
        let mut rng = proptest::test_runner::TestRng::deterministic_rng(RngAlgorithm::ChaCha);
        let (mut n_edits, mut accumulated) = (0, 0);
        for step in 0.. {
            let Some(mv) = any_edit(&scene, step, &mut rng) else { continue };
            accumulated += twin.commit(&mut scene, &mv).unwrap();
            n_edits += 1;
            if n_edits == 10_000 {
                break;
            }
        }
        let full = raster::reference(&scene).pictures;
        let energy = raster::energy(&scene.views, &reference, &full);
        assert_eq!((accumulated, twin.energy()), (energy as i64, energy));
        assert!(pictures(&mut twin, &scene) == full);
    }
}

#[test]
fn fragment_lists_hold_what_a_re_render_puts_there() {
    let scene = scene(6, LOOKS[0]);
    let mut lists = super::fragments::FragmentLists::new(64, 128, (&[0; 64 * 64], None));
    let mut expected = vec![Vec::new(); 64 * 64];
    raster::for_each_fragment(&scene, 0, |_| true, &mut |i, j, f| {
        lists.insert(i, j, f);
        expected[(j * 64 + i) as usize].push(f);
    });
    for (pixel, list) in expected.iter_mut().enumerate() {
        list.sort_by_key(|f| (f.z, f.face));
        assert_eq!(&lists.list(pixel as i32 % 64, pixel as i32 / 64), list);
    }
}
