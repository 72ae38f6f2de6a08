//! The real mesh makes the edits; the file must give every level back exactly.

use glam::DVec3;
use proptest::prelude::*;

use super::*;
use crate::mesh::{AttributeLayer, Collapse, EditMesh, Mesh, Semantic, Topology, VertexId};

/// A bumpy grid of `n`² quads; with wedges, every third column is a texture seam.
fn grid(n: u32, has_wedges: bool) -> Mesh {
    let at = |i: u32, j: u32| i * (n + 1) + j;
    let mut mesh = Mesh::default();
    for i in 0..=n {
        for j in 0..=n {
            let z = f64::from(i * 7 % 5) * 0.1 + f64::from(j * 3 % 4) / 9.0;
            mesh.positions.push(DVec3::new(f64::from(i), f64::from(j), z));
        }
    }
    for i in 0..n {
        for j in 0..n {
            mesh.faces.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
            mesh.faces.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
    }
    if has_wedges {
        let n_vertices = mesh.positions.len() as u32;
        let side = |f: usize| u32::from(f % 6 > 2) * n_vertices;
        mesh.face_wedges =
            mesh.faces.iter().enumerate().map(|(f, v)| v.map(|v| v + side(f))).collect();
        let values = (0..n_vertices * 4).map(|k| k as f32 * 0.37).collect();
        mesh.layers.push(AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values });
        mesh.face_materials = (0..mesh.faces.len() as u32).map(|f| f % 3).collect();
        let all = (0..mesh.faces.len() as u32).map(crate::mesh::FaceId).collect();
        mesh = mesh.subset(all).mesh;
    }
    mesh
}

/// Collapses what `picks` point at, where legal; returns the records and every level's mesh.
fn simplify(mesh: &Mesh, picks: &[(u32, u32, f64)]) -> (Vec<Collapse>, Vec<Mesh>) {
    let mut edit = EditMesh::new(mesh.clone()).unwrap();
    let (mut records, mut levels) = (Vec::new(), vec![mesh.clone()]);
    let mut ring = Vec::new();
    for &(v, nth, t) in picks {
        let a = VertexId(v % mesh.positions.len() as u32);
        edit.neighbours(a, &mut ring);
        if ring.is_empty() {
            continue;
        }
        let b = ring[nth as usize % ring.len()];
        if edit.may_collapse(a, b, Topology::Preserve) {
            let to = edit.position(a).lerp(edit.position(b), t) + DVec3::Z * (t / 3.0);
            records.push(edit.collapse(a, b, to));
            levels.push(edit.snapshot());
        }
    }
    (records, levels)
}

fn check(mesh: &Mesh, picks: &[(u32, u32, f64)]) {
    let (records, levels) = simplify(mesh, picks);
    assert_eq!(decode_records(&encode_records(&records)).unwrap(), records);

    let file = write(mesh, &records, &[("lod-0".into(), 7)]).unwrap();
    let reader = Reader::open(&file).unwrap();
    let mut level = reader.coarsest().unwrap();
    assert_eq!(&level.to_mesh(), levels.last().unwrap());
    // Coarse to fine, every level on the way, up to the original.
    let mut at = levels.len() - 1;
    let splits = reader
        .refine(&mut level, |level, _| {
            assert_eq!(level.to_mesh(), levels[at]);
            at = at.saturating_sub(1);
            true
        })
        .unwrap();
    assert_eq!(&level.to_mesh(), mesh);
    // And back, with the records that the file gave.
    for (split, wanted) in splits.iter().rev().zip(&levels[1..]) {
        level.collapse(split).unwrap();
        assert_eq!(&level.to_mesh(), wanted);
    }
    for target in [levels.last().unwrap().faces.len(), mesh.faces.len() - 1, mesh.faces.len()] {
        let wanted = levels.iter().find(|l| l.faces.len() <= target).unwrap();
        assert_eq!(&reader.extract(target).unwrap(), wanted);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn every_level_comes_back_exactly(
        has_wedges: bool,
        picks in prop::collection::vec((0_u32..100_000, 0_u32..8, 0.0..1.0), 1..60),
    ) {
        check(&grid(6, has_wedges), &picks);
    }

    #[test]
    fn damaged_files_are_refused_or_read_never_worse(at in 0.0..1.0, flip in 1_u8..=255, cut: bool) {
        let picks: Vec<_> = (0..40).map(|i| (i * 11, i, 0.5)).collect();
        let mesh = grid(6, true);
        let mut file = write(&mesh, &simplify(&mesh, &picks).0, &[]).unwrap();
        let at = (at * file.len() as f64) as usize;
        if cut { file.truncate(at) } else { file[at] ^= flip }
        let result = Reader::open(&file).and_then(|r| r.extract(mesh.faces.len()));
        prop_assert!(result.is_err(), "a damaged file was read");
    }

    #[test]
    fn any_bytes_decode_or_fail(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = decode_records(&bytes);
        let _ = Reader::open(&bytes);
    }
}
