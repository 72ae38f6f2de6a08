//! Edits of every kind on a `Replay`, against `EditMesh`, bit by bit.

use glam::DVec3;
use proptest::prelude::*;

use super::{
    reference::{Extras, Rng, grid},
    round_trip::{assert_same, extras},
};
use crate::{
    mesh::{
        Corner, EdgeId, EdgeTable, EditMesh, EditRecord, Mesh, Revalue, Semantic, Split, Swap,
        WedgeId, shapes,
    },
    progressive::{ProgressiveError, Replay, decode_edit, encode_collapse, encode_edit},
};

/// A random edit of a random edge; `None` where it is refused.
fn random_edit(mesh: &mut EditMesh, rng: &mut Rng) -> Option<EditRecord> {
    let edges = EdgeTable::new(mesh);
    let edge = (edges.n_slots() > 0).then(|| EdgeId(rng.below(edges.n_slots()) as u32))?;
    let [a, b] = edges.ends(edge);
    let off = DVec3::new(rng.signed(), rng.signed(), rng.signed()) * 0.1;
    let middle = mesh.position(a).midpoint(mesh.position(b));
    let at = [mesh.position(a), mesh.position(b), middle, middle + off][rng.below(4)];
    let normal = off.normalize_or_zero().as_vec3().to_array();
    match rng.below(8) {
        0 => mesh.split(a, b, at).map(EditRecord::Split),
        1 | 2 => mesh.swap(a, b).map(EditRecord::Swap),
        3 => Some(EditRecord::Collapse(mesh.collapse(a, b, at))),
        4 => {
            let values = [(a, normal), (b, [0.0, -0.0, 1.0])];
            mesh.revalue(Semantic::Normal, &values).map(EditRecord::Revalue)
        }
        5 => {
            // Some of the corners of each end.
            let corner = |v| {
                let face = mesh.faces_around(v)[0];
                let k = mesh.vertices_of(face).iter().position(|w| *w == v).unwrap();
                (Corner::new(face, k), [normal[0], normal[1]])
            };
            let values = [a, b].map(corner);
            mesh.revalue_shared(Semantic::TexCoord(0), &values).map(EditRecord::Revalue)
        }
        _ => Some(EditRecord::Displacement(mesh.displace(b, at))),
    }
}

/// So many attempts at edits of a mesh: every mesh on the way, and the records between them.
pub(super) fn random_edits(start: &Mesh, n: usize, rng: &mut Rng) -> (Vec<Mesh>, Vec<EditRecord>) {
    let mut mesh = EditMesh::new(start.clone()).unwrap();
    let (mut meshes, mut records) = (vec![start.clone()], Vec::new());
    for _ in 0..n {
        if let Some(record) = random_edit(&mut mesh, rng) {
            records.push(record);
            meshes.push(mesh.snapshot());
        }
    }
    (meshes, records)
}

/// A grid, or now and then a closed surface.
fn start(extras: Extras, rng: &mut Rng) -> Mesh {
    match rng.below(4) {
        0 => shapes::torus(5, 4, 0.1),
        1 => grid(1, extras, rng),
        _ => grid(4, extras, rng),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn forth_and_back_as_the_edit_mesh(seed in any::<u64>(), extras in extras()) {
        let mut rng = Rng(seed);
        let mesh = start(extras, &mut rng);
        let (meshes, records) = random_edits(&mesh, 80, &mut rng);
        let mut replay = Replay::from_mesh(&mesh).unwrap();
        for (record, mesh) in records.iter().zip(&meshes[1..]) {
            replay.apply_edit(record.edit()).unwrap();
            assert_same(&replay.to_mesh(), mesh);
            prop_assert_eq!(replay.n_faces() as usize, mesh.faces.len());
            prop_assert_eq!(replay.n_vertices() as usize, mesh.positions.len());
        }
        for (record, mesh) in records.iter().zip(&meshes).rev() {
            replay.undo_edit(record.edit()).unwrap();
            assert_same(&replay.to_mesh(), mesh);
        }
        if let Some(record) = records.iter().find(|r| !matches!(r, EditRecord::Collapse(_))) {
            prop_assert!(replay.undo_edit(record.edit()).is_err(), "nothing is left to undo");
        }
    }

    #[test]
    fn records_of_all_kinds_stand_alone(seed in any::<u64>(), extras in extras()) {
        let mut rng = Rng(seed);
        let mesh = start(extras, &mut rng);
        let (_, records) = random_edits(&mesh, 80, &mut rng);
        let mut stream = Vec::new();
        records.iter().for_each(|record| encode_edit(record.edit(), &mut stream));
        let mut rest = &stream[..];
        for record in &records {
            let (found, n_bytes) = decode_edit(rest).unwrap();
            prop_assert_eq!(&found, record);
            if let EditRecord::Collapse(collapse) = record {
                let mut bytes = Vec::new();
                encode_collapse(collapse, &mut bytes);
                prop_assert_eq!(&bytes[..], &rest[..n_bytes]);
            }
            for n in 0..n_bytes {
                prop_assert!(decode_edit(&rest[..n]).is_err(), "{} of {} bytes", n, n_bytes);
            }
            rest = &rest[n_bytes..];
        }
        prop_assert!(rest.is_empty());
    }

    /// Bytes that are nearly a record give one that fits and can be undone, or an error that
    /// changes nothing.
    #[test]
    fn mutated_records_fit_or_change_nothing(seed in any::<u64>(), extras in extras()) {
        let mut rng = Rng(seed);
        let mesh = start(extras, &mut rng);
        let (meshes, records) = random_edits(&mesh, 30, &mut rng);
        let mut replay = Replay::from_mesh(&mesh).unwrap();
        for (record, before) in records.iter().zip(&meshes) {
            let mut bytes = Vec::new();
            encode_edit(record.edit(), &mut bytes);
            for _ in 0..20 {
                let mut mutant = bytes.clone();
                for _ in 0..=rng.below(2) {
                    let at = rng.below(mutant.len());
                    mutant[at] = [rng.next() as u8, mutant[at] ^ 1, mutant[at].wrapping_add(2)]
                        [rng.below(3)];
                }
                let Ok((mutant, _)) = decode_edit(&mutant) else { continue };
                let _ = replay.clone().undo_edit(mutant.edit());
                match replay.apply_edit(mutant.edit()) {
                    Ok(()) => replay.undo_edit(mutant.edit()).unwrap(),
                    Err(error) => {
                        let is_misfit = matches!(error, ProgressiveError::Misfit { .. });
                        prop_assert!(is_misfit, "{}", error);
                    }
                }
                assert_same(&replay.to_mesh(), before);
            }
            replay.apply_edit(record.edit()).unwrap();
        }
    }
}

/// A mesh with layers on which every kind of edit can be done, and a record of a kind.
fn one<T>(find: impl Fn(EditRecord) -> Option<T>) -> (Mesh, Replay, T) {
    for seed in 0.. {
        let mut rng = Rng(seed);
        let mesh =
            grid(4, Extras { layers: true, materials: true, parts: true, ugly: false }, &mut rng);
        let mut edited = EditMesh::new(mesh.clone()).unwrap();
        if let Some(record) = random_edit(&mut edited, &mut rng).and_then(&find) {
            let replay = Replay::from_mesh(&mesh).unwrap();
            return (mesh, replay, record);
        }
    }
    unreachable!()
}

/// Records that each change spoils are refused, in both directions, and change nothing.
fn check_spoiled<T: Clone>(
    (mesh, mut replay, record): (Mesh, Replay, T),
    wrap: fn(T) -> EditRecord,
    spoil: &[fn(&mut T)],
) {
    let good = wrap(record.clone());
    for (i, spoil) in spoil.iter().enumerate() {
        let mut wrong = record.clone();
        spoil(&mut wrong);
        let wrong = wrap(wrong);
        let error = replay.apply_edit(wrong.edit()).unwrap_err();
        assert!(matches!(error, ProgressiveError::Misfit { .. }), "{i}: {error}");
        assert_same(&replay.to_mesh(), &mesh);
        replay.apply_edit(good.edit()).unwrap();
        let after = replay.to_mesh();
        assert!(replay.undo_edit(wrong.edit()).is_err(), "{i}");
        assert_same(&replay.to_mesh(), &after);
        replay.undo_edit(good.edit()).unwrap();
    }
}

#[test]
fn spoiled_splits_are_refused() {
    let is_inner = |s: &Split| s.halves.len() == 2;
    let find = |record| match record {
        EditRecord::Split(s) => Some(s).filter(is_inner),
        _ => None,
    };
    check_spoiled(
        one(find),
        EditRecord::Split,
        &[
            |s| s.a = s.b,
            |s| s.vertex.0 += 1,
            |s| s.vertex.0 -= 1,
            |s| s.halves.swap(0, 1),
            |s| s.halves.clear(),
            |s| s.halves.truncate(1),
            |s| s.halves[1].face = s.halves[0].face,
            |s| s.halves[0].face.0 = u32::MAX,
            |s| s.halves[0].new_face.0 += 1,
            |s| s.halves[0].vertices.rotate_left(1),
            |s| s.halves[0].wedges[0].0 += 1,
            |s| s.halves[1].new_wedge.0 += 100,
            |s| s.first_new_wedge.0 += 1,
            |s| s.new_wedges.push(0.0),
            |s| s.new_wedges.clear(),
        ],
    );
}

#[test]
fn spoiled_swaps_are_refused() {
    let find = |record| match record {
        EditRecord::Swap(s) => Some(s),
        _ => None,
    };
    let spoil: [fn(&mut Swap); 9] = [
        |s| s.ends.swap(0, 1),
        |s| s.apexes.swap(0, 1),
        |s| s.apexes[0] = s.apexes[1],
        |s| s.ends[0].0 = u32::MAX,
        |s| s.corners.swap(0, 1),
        |s| s.corners[0] = s.corners[1],
        |s| s.corners[1] = Corner(u32::MAX),
        |s| s.wedges_from[0].0 += 1000,
        |s| s.wedges_to[1] = WedgeId(u32::MAX),
    ];
    check_spoiled(one(find), EditRecord::Swap, &spoil);
}

#[test]
fn spoiled_displacements_and_values_are_refused() {
    let find = |record| match record {
        EditRecord::Displacement(d) => Some(d).filter(|d| d.from != d.to),
        _ => None,
    };
    check_spoiled(
        one(find),
        EditRecord::Displacement,
        &[|d| d.vertex.0 = 9999, |d| (d.from, d.to) = (-d.from, -d.to)],
    );
    let find = |record| match record {
        EditRecord::Revalue(r) => Some(r),
        _ => None,
    };
    let spoil: [fn(&mut Revalue); 7] = [
        |r| r.rewedged.swap(0, 1),
        |r| r.rewedged[0].corner = Corner(u32::MAX),
        |r| (r.rewedged[0].from, r.rewedged[0].to) = (r.rewedged[0].to, r.rewedged[0].from),
        |r| r.rewedged[0].to.0 += 1000,
        |r| r.first_new_wedge.0 -= 1,
        |r| r.new_wedges.truncate(1),
        |r| r.new_wedges.extend([0.0; 4]),
    ];
    check_spoiled(one(find), EditRecord::Revalue, &spoil);
}

#[test]
fn edits_need_layers_for_wedges() {
    let mut replay = Replay::from_mesh(&shapes::octahedron()).unwrap();
    let (_, _, revalue) = one(|record| match record {
        EditRecord::Revalue(r) => Some(r),
        _ => None,
    });
    assert!(replay.apply_edit(&revalue).is_err());
    let unknown = [5 << 5, 0, 0, 0];
    let error = decode_edit(&unknown).unwrap_err().to_string();
    assert_eq!(error, "record: unknown kind of a record; the file is damaged");
}
