//! The device against the contract and against the native twin.

use super::{
    super::{
        contract::{self, LOOKS},
        device,
        evaluator::{Evaluator, Reference},
        raster,
        scene::Scene,
    },
    Device, Gpu,
};

/// The first usable adapter; says so when there is none.
fn open() -> Option<Gpu> {
    let adapter = device::enumerate().into_iter().find(|a| device::describe(a).unfit.is_none());
    if adapter.is_none() {
        eprintln!("skipped: no Vulkan adapter");
    }
    Some(Gpu::open(&adapter?).expect("the adapter opens"))
}

fn make(scene: &Scene, reference: Reference) -> Box<dyn Evaluator> {
    let gpu = open().expect("there was an adapter a moment ago");
    Box::new(Device::new(gpu, scene, reference).expect("the lists are built"))
}

#[test]
fn the_device_keeps_the_contract() {
    if open().is_some() {
        contract::check_all(&make, 40);
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
