//! The real models, where they are: counts against their table, reports against snapshots.

use std::{io::Write as _, path::PathBuf};

use super::*;

/// File, triangles, vertices as stored, distinct points, boundary edges, components,
/// non-manifold edges, duplicates, degenerate: measured by other programs with instances placed
/// and coincident points joined.
const TABLE: [(&str, [u64; 8]); 12] = [
    ("stanford_bunny.glb", [69_451, 34_834, 34_834, 223, 1, 0, 0, 0]),
    ("stanford_bunny.ply", [69_451, 35_947, 34_834, 223, 1, 0, 0, 0]),
    ("armadillo.glb", [86_482, 43_243, 43_243, 0, 1, 0, 0, 0]),
    ("stanford_dragon.glb", [871_414, 437_645, 435_545, 0, 1, 0, 0, 108]),
    ("flight_helmet.glb", [94_722, 55_392, 47_561, 296, 82, 0, 0, 0]),
    ("barramundi_fish.glb", [3_864, 2_188, 1_938, 0, 3, 0, 0, 0]),
    ("spot_cow.glb", [5_856, 3_225, 2_930, 0, 1, 0, 0, 0]),
    ("frog_vertex_colours.glb", [48_348, 26_755, 24_176, 0, 1, 0, 0, 0]),
    ("corset.glb", [18_324, 11_505, 9_774, 1_144, 75, 0, 0, 0]),
    ("two_cylinder_engine.glb", [121_496, 84_657, 60_041, 13_308, 86, 0, 0, 11_160]),
    ("dutch_ship.glb", [69_162, 64_544, 41_222, 12_234, 1_191, 19, 0, 0]),
    ("house_scene.glb", [10_497, 13_141, 6_805, 4_392, 550, 3_666, 2_506, 0]),
];

/// The bytes of a model, or `None` with a word about it.
pub(super) fn model(name: &str) -> Option<Vec<u8>> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/models").join(name);
    let bytes = std::fs::read(&path).ok();
    if bytes.is_none() {
        let _ = writeln!(std::io::stderr(), "skipped: {} is not there", path.display());
    }
    bytes
}

#[test]
fn counts_agree_with_the_table() {
    let mut rows = Vec::new();
    for (name, expected) in TABLE {
        let Some(bytes) = model(name) else { continue };
        let r = load(name, &bytes).unwrap().report;
        let found = [
            r.triangles_in_file,
            r.vertices_in_file,
            r.vertices,
            r.boundary_edges,
            r.components,
            r.non_manifold_edges,
            r.duplicate_faces,
            r.degenerate_dropped,
        ];
        rows.push((name, found, expected));
    }
    let wrong: Vec<_> = rows.iter().filter(|(_, found, expected)| found != expected).collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn reports_are_as_they_were() {
    for (name, _) in TABLE {
        let Some(bytes) = model(name) else { continue };
        insta::assert_debug_snapshot!(name, load(name, &bytes).unwrap().report);
    }
}

#[test]
fn the_bunny_is_the_same_in_both_formats() {
    let (Some(glb), Some(ply)) = (model("stanford_bunny.glb"), model("stanford_bunny.ply")) else {
        return;
    };
    let (glb, ply) = (load("b.glb", &glb).unwrap().mesh, load("b.ply", &ply).unwrap().mesh);
    assert_eq!(glb.positions, ply.positions);
    assert_eq!(glb.faces, ply.faces);
}
