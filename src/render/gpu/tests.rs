//! The device against the contract and against the native twin.

use std::io::Write as _;

use glam::DVec3;
use proptest::{
    prelude::*,
    test_runner::{RngAlgorithm, TestRng},
};

use super::{
    super::{
        contract::{self, LOOKS, Look},
        device,
        evaluator::{Evaluator, Reference},
        moves::Move,
        raster,
        scene::Scene,
        twin::Twin,
    },
    BAND_CELLS, Device, Gpu, SHARED,
};

/// The first usable adapter; says so when there is none.
pub(super) fn open() -> Option<Gpu> {
    let adapter = device::enumerate().into_iter().find(|a| device::describe(a).unfit.is_none());
    if adapter.is_none() {
        let _ = writeln!(std::io::stderr(), "skipped: no Vulkan adapter");
    }
    Some(Gpu::open(&adapter?).expect("the adapter opens"))
}

fn make(scene: &Scene, reference: Reference, lane_bits: u32) -> Device {
    let gpu = open().expect("there was an adapter a moment ago");
    Device::with_lanes(gpu, scene, reference, lane_bits).expect("the lists are built")
}

#[test]
fn the_device_keeps_the_contract() {
    if open().is_some() {
        contract::check_all(&|scene, reference| Box::new(make(scene, reference, 0)), 40);
    }
}

/// As GPUs are used, on whatever there is.
#[test]
fn the_device_keeps_the_contract_where_lanes_share_items() {
    if open().is_some() {
        contract::check_all(&|scene, reference| Box::new(make(scene, reference, SHARED)), 10);
    }
}

#[test]
fn the_first_picture_is_the_rasters() {
    let Some(gpu) = open() else { return };
    let scene = contract::scene(12, LOOKS[1]);
    let reference = raster::reference(&scene);
    let mut device = Device::new(gpu, &scene, reference.clone()).unwrap();
    assert_eq!(device.energy(), 0);
    for view in 0..scene.n_views() {
        assert!(device.picture(&scene, view).unwrap() == reference.pictures[view], "view {view}");
    }
}

/// A seeded sequence of moves of the scene as it is now.
pub(super) fn random_moves(scene: &Scene, rng: &mut TestRng, n: usize) -> Vec<Move> {
    let mut moves = Vec::new();
    for _ in 0..4 * n {
        let pick = (rng.next_u32() as usize, rng.next_u32() as usize);
        let offset = [0; 3].map(|_: i32| f64::from(rng.next_u32() % 2001) / 10_000.0 - 0.1);
        moves.extend(contract::random_move(scene, pick, DVec3::from_array(offset)));
        if moves.len() == n {
            break;
        }
    }
    moves
}

/// Device and twin side by side: batches of several sizes, then a few commits, again and again.
fn check_against_twin(look: Look, n: usize, sizes: &[usize], n_rounds: usize) {
    for lane_bits in [0, SHARED] {
        check_lanes_against_twin(lane_bits, look, n, sizes, n_rounds);
    }
}

fn check_lanes_against_twin(
    lane_bits: u32,
    look: Look,
    n: usize,
    sizes: &[usize],
    n_rounds: usize,
) {
    if open().is_none() {
        return;
    }
    let mut scene = contract::scene(n, look);
    let reference = raster::reference(&scene);
    let mut twin = Twin::new(&scene, &reference);
    let mut device = make(&scene, reference, lane_bits);
    let mut rng = TestRng::deterministic_rng(RngAlgorithm::ChaCha);
    for round in 0..n_rounds {
        for size in sizes {
            let moves = random_moves(&scene, &mut rng, *size);
            let expected = twin.evaluate(&scene, &moves).unwrap();
            assert_eq!(device.evaluate(&scene, &moves).unwrap(), expected, "round {round}");
        }
        for mv in random_moves(&scene, &mut rng, 1) {
            let mut twins_scene = scene.clone();
            let expected = twin.commit(&mut twins_scene, &mv).unwrap();
            assert_eq!(device.commit(&mut scene, &mv).unwrap(), expected, "round {round}");
        }
        assert_eq!(device.energy(), twin.energy());
        for view in 0..scene.n_views() {
            let same = device.picture(&scene, view).unwrap() == twin.picture(&scene, view).unwrap();
            assert!(same, "round {round}, view {view}");
        }
    }
}

#[test]
fn a_batch_that_a_device_does_not_bind_is_judged_in_parts() {
    if open().is_none() {
        return;
    }
    let scene = contract::scene(12, LOOKS[0]);
    let reference = raster::reference(&scene);
    let mut twin = Twin::new(&scene, &reference);
    let mut device = make(&scene, reference, SHARED);
    // What one move needs, and little more.
    device.gpu.max_binding = 1 << 16;
    let moves = random_moves(&scene, &mut TestRng::deterministic_rng(RngAlgorithm::ChaCha), 200);
    let words = device.pack(&scene, &moves, BAND_CELLS);
    assert!(device.n_results(words.items.len()) * 4 > 1 << 16, "too few to be parted");
    assert_eq!(device.evaluate(&scene, &moves).unwrap(), twin.evaluate(&scene, &moves).unwrap());
}

#[test]
fn device_and_twin_agree_under_flat_shading() {
    check_against_twin(LOOKS[0], 12, &[1, 7, 64, 300], 3);
    check_against_twin(LOOKS[2], 12, &[7], 20);
}

#[test]
fn device_and_twin_agree_on_what_glows() {
    check_against_twin(LOOKS[9], 12, &[1, 7, 64], 3);
}

#[test]
fn device_and_twin_agree_under_smooth_shading() {
    check_against_twin(LOOKS[1], 12, &[1, 7, 64, 300], 3);
}
