//! The device against the native twin where its fixed sizes end: deep lists, full pools, moves of
//! many triangles, more triangles than 16 bits count.

use glam::DVec3;
use proptest::{
    prelude::*,
    test_runner::{RngAlgorithm, TestRng},
};

use super::{
    super::{
        contract::{self, LOOKS, Look, displacement, sheets, square},
        evaluator::{Evaluator, RenderError},
        moves::Move,
        raster,
        scene::Scene,
        twin::Twin,
    },
    Device,
    tests::open,
};

/// Both evaluators, ready for the same scene.
struct Pair {
    scene: Scene,
    device: Device,
    twin: Twin,
}

impl Pair {
    /// None where there is no adapter.
    fn new(scene: Scene) -> Option<Self> {
        let gpu = open()?;
        let reference = raster::reference(&scene);
        let twin = Twin::new(&scene, &reference);
        let device = Device::new(gpu, &scene, reference).unwrap();
        Some(Self { scene, device, twin })
    }

    /// Judges the moves, then makes the last of them.
    fn step(&mut self, moves: &[Move]) {
        let expected = self.twin.evaluate(&self.scene, moves).unwrap();
        assert_eq!(self.device.evaluate(&self.scene, moves).unwrap(), expected);
        let (Some(mv), Some(delta)) = (moves.last(), expected.last()) else { return };
        assert_eq!(self.twin.commit(&mut self.scene.clone(), mv).unwrap(), *delta);
        assert_eq!(self.device.commit(&mut self.scene, mv).unwrap(), *delta);
    }

    /// Compares the pictures with a full re-render of the scene as it is now.
    fn check(&mut self) {
        let full = raster::reference(&self.scene).pictures;
        for (view, picture) in full.iter().enumerate() {
            assert!(self.twin.picture(&self.scene, view).unwrap() == *picture, "view {view}");
            assert!(self.device.picture(&self.scene, view).unwrap() == *picture, "view {view}");
        }
        assert_eq!(self.device.energy(), self.twin.energy());
    }
}

fn check_sheets(n: usize, n_steps: usize) {
    let Some(mut pair) = Pair::new(sheets(n, 0.7, 0.3)) else { return };
    let mut rng = TestRng::deterministic_rng(RngAlgorithm::ChaCha);
    pair.check();
    for _ in 0..n_steps {
        let moves = [(); 3].map(|()| contract::through_the_stack(&pair.scene, n, &mut rng));
        pair.step(&moves);
    }
    pair.check();
}

#[test]
fn sixty_sheets_over_one_another() {
    check_sheets(60, 6);
}

/// Sorting and walking lists of this length takes more steps than some drivers let a kernel make.
#[test]
fn two_hundred_and_fifty_sheets_over_one_another() {
    check_sheets(250, 2);
}

/// The longest lists that are taken: walking one for a move that goes behind all of them needs more
/// steps than drivers with a limit (65,535 on lavapipe) allow for an item of many pixels.
#[test]
fn kernels_that_a_driver_cuts_off_are_run_again_in_parts() {
    let n = 1000;
    let Some(mut pair) = Pair::new(sheets(n, 0.3, 0.01)) else { return };
    let last = 4 * (n as u32 - 1);
    let moved: Vec<_> =
        (last..last + 4).map(|v| (v, pair.scene.position(v) + DVec3::Z * 0.005)).collect();
    let mv = displacement(&pair.scene, &moved);
    let cells = pair.device.make_cells;
    pair.step(&[mv]);
    pair.check();
    eprintln!("{}: items of {cells} cells, then of {}", pair.device.name(), pair.device.make_cells);
}

#[test]
fn a_full_pool_is_built_anew_with_more_room() {
    // The sheets start smaller than a pixel and grow over the whole picture one after the other.
    let n = 20;
    let Some(mut pair) = Pair::new(sheets(n, 0.01, 0.3)) else { return };
    let room = pair.device.lists.params.n_pool;
    for k in 0..n {
        let first = 4 * k as u32;
        let grown = square(0.7, pair.scene.position(first).z);
        let moved: Vec<_> = (first..).zip(grown).collect();
        pair.step(&[displacement(&pair.scene, &moved)]);
    }
    assert!(pair.device.lists.params.n_pool > 4 * room, "the pool did not grow");
    pair.check();
}

#[test]
fn a_list_beyond_all_bounds_is_an_error_and_no_wrong_picture() {
    let Some(gpu) = open() else { return };
    let scene = sheets(5000, 0.1, 0.001);
    let reference = raster::reference(&scene);
    let Err(RenderError::Device(text)) = Device::new(gpu, &scene, reference).map(drop) else {
        panic!("5,000 triangles behind one pixel were taken");
    };
    assert!(text.contains("4,096"), "{text}");
}

/// A book of many pages around one spine: a move of the spine takes them all out of the picture,
/// every one of them behind the same pixels, and puts them back elsewhere.
#[test]
fn a_move_of_many_triangles_behind_the_same_pixels() {
    let n = 80;
    let mut positions = vec![DVec3::new(0.0, -0.7, 0.0), DVec3::new(0.0, 0.7, 0.0)];
    let page = |k: u32| (f64::from(k) / f64::from(n) - 0.5) * 0.4;
    positions.extend((0..n).map(|k| DVec3::new(0.9, 0.3 * page(k), page(k))));
    positions.extend([DVec3::splat(-0.6), DVec3::splat(0.6)]);
    let faces: Vec<_> = (0..n).map(|k| [0, 1, 2 + k]).collect();
    let look = Look { coloured: true, image_size: 128, ..LOOKS[0] };
    let Some(mut pair) = Pair::new(contract::scene_of(positions, faces, look)) else { return };
    for step in 0..3 {
        let offset = DVec3::new(-0.03, 0.01, 0.02) * f64::from(step % 3);
        let vertex = step % 2;
        let to = pair.scene.position(vertex) + offset;
        pair.step(&[displacement(&pair.scene, &[(vertex, to)])]);
    }
    pair.check();
}

#[test]
fn more_triangles_than_sixteen_bits_count() {
    let scene = contract::scene(133, LOOKS[0]);
    assert!(scene.faces.len() > 70_000);
    let Some(mut pair) = Pair::new(scene) else { return };
    let mut rng = TestRng::deterministic_rng(RngAlgorithm::ChaCha);
    for step in 0..6 {
        // The first and the last of them in turn.
        let first = if step % 2 == 0 { 100 } else { 66_000 };
        let pick = (first + rng.next_u32() as usize % 4000, 0);
        let offset = DVec3::splat(0.2 - 0.1 * f64::from(step % 3));
        pair.step(&[contract::random_move(&pair.scene, pick, offset).unwrap()]);
    }
    pair.check();
}
