//! What goes in comes out, bit by bit, at every level and in both directions.

use proptest::prelude::*;

use super::reference::{Extras, Rng, grid, sequence};
use crate::{
    mesh::{Collapse, Mesh},
    progressive::{ProgressiveError, Reader, Replay, Writer, decode_collapse, encode_collapse},
};

fn file_of(mesh: &Mesh, records: &[Collapse]) -> Vec<u8> {
    let mut writer = Writer::new(mesh).unwrap();
    for (i, record) in records.iter().enumerate() {
        if i == records.len() / 2 {
            writer.mark_level("half");
        }
        writer.push(record).unwrap();
    }
    writer.mark_level("last");
    writer.finish().unwrap()
}

/// Equality that tells −0 from 0.
#[track_caller]
pub(super) fn assert_same(found: &Mesh, expected: &Mesh) {
    assert_eq!(found, expected);
    let bits = |m: &Mesh| -> Vec<u64> {
        let values = m.layers.iter().flat_map(|l| &l.values).map(|v| u64::from(v.to_bits()));
        let positions = m.positions.iter().flat_map(glam::DVec3::to_array).map(f64::to_bits);
        positions.chain(values).collect()
    };
    assert_eq!(bits(found), bits(expected));
}

pub(super) fn extras() -> impl Strategy<Value = Extras> {
    any::<[bool; 4]>().prop_map(|[layers, materials, parts, ugly]| Extras {
        layers,
        materials,
        parts,
        ugly,
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]

    #[test]
    fn every_level_both_ways(seed in any::<u64>(), size in 2..7_usize, extras in extras()) {
        let mut rng = Rng(seed);
        let mesh = grid(size, extras, &mut rng);
        let (levels, records) = sequence(&mesh, 200, &mut rng);
        let file = file_of(&mesh, &records);
        prop_assert_eq!(&file, &file_of(&mesh, &records), "the same input gives the same bytes");
        let reader = Reader::open(&file).unwrap();

        let mut splits = reader.coarse_to_fine().unwrap();
        for (level, record) in levels.iter().zip(&records).rev() {
            let split = splits.next().unwrap().unwrap();
            prop_assert_eq!(&split, record);
            assert_same(&splits.to_mesh(), level);
        }
        prop_assert!(splits.next().is_none());

        let mut collapses = reader.fine_to_coarse().unwrap();
        assert_same(&collapses.to_mesh(), &mesh);
        for (record, level) in records.iter().zip(&levels[1..]) {
            prop_assert_eq!(&collapses.next().unwrap().unwrap(), record);
            assert_same(&collapses.to_mesh(), level);
        }
        prop_assert!(collapses.next().is_none());

        let coarsest = levels.last().unwrap().faces.len();
        for target in coarsest..=mesh.faces.len() + 1 {
            // Levels go from fine to coarse: the first that fits is the finest of them.
            let expected = levels.iter().find(|l| l.faces.len() <= target).unwrap();
            assert_same(&reader.extract(target as u32).unwrap(), expected);
        }
        if coarsest > 0 {
            let error = reader.extract(coarsest as u32 - 1).unwrap_err();
            let is_right = matches!(error, ProgressiveError::TooCoarse { .. });
            prop_assert!(is_right, "{}", error);
        }
        if !records.is_empty() {
            assert_same(&reader.extract_level("half").unwrap(), &levels[records.len() / 2]);
        }
        assert_same(&reader.extract_level("last").unwrap(), levels.last().unwrap());
    }

    #[test]
    fn replay_forth_and_back(seed in any::<u64>(), extras in extras()) {
        let mut rng = Rng(seed);
        let mesh = grid(4, extras, &mut rng);
        let (levels, records) = sequence(&mesh, 60, &mut rng);
        let mut replay = Replay::from_mesh(&mesh).unwrap();
        for (record, level) in records.iter().zip(&levels[1..]) {
            replay.apply(record).unwrap();
            assert_same(&replay.to_mesh(), level);
            prop_assert_eq!(replay.n_faces() as usize, level.faces.len());
            prop_assert_eq!(replay.n_vertices() as usize, level.positions.len());
        }
        for (record, level) in records.iter().zip(&levels).rev() {
            replay.undo(record).unwrap();
            assert_same(&replay.to_mesh(), level);
        }
    }

    #[test]
    fn records_stand_alone(seed in any::<u64>(), extras in extras()) {
        let mut rng = Rng(seed);
        let mesh = grid(5, extras, &mut rng);
        let (_, records) = sequence(&mesh, 60, &mut rng);
        let mut stream = Vec::new();
        for record in &records {
            encode_collapse(record, &mut stream);
        }
        let mut at = 0;
        for record in &records {
            let (found, n) = decode_collapse(&stream[at..]).unwrap();
            prop_assert_eq!(&found, record);
            at += n;
        }
        prop_assert_eq!(at, stream.len());
    }
}

/// A record that does not fit leaves the replay as it was.
#[test]
fn misfits_are_refused_and_change_nothing() {
    let mut rng = Rng(7);
    let mesh =
        grid(4, Extras { layers: true, materials: true, parts: true, ugly: false }, &mut rng);
    let (levels, records) = sequence(&mesh, 10, &mut rng);
    let change: [fn(&mut Collapse); 12] = [
        |c| c.keep = c.drop,
        |c| c.drop.0 = 9999,
        |c| c.keep_from.x += 1.0,
        |c| c.drop_from.y = -c.drop_from.y,
        |c| c.removed.clear(),
        |c| c.removed[0].vertices.swap(0, 1),
        |c| c.removed[0].wedges[1].0 += 1,
        |c| c.moved.push(crate::mesh::Corner(u32::MAX)),
        |c| c.moved.truncate(c.moved.len() - 1),
        |c| c.first_new_wedge.0 += 1,
        |c| c.new_wedges.push(0.5),
        |c| c.removed[0].face.0 += 1,
    ];
    let mut replay = Replay::from_mesh(&mesh).unwrap();
    for (record, level) in records.iter().zip(&levels) {
        for change in change {
            let mut wrong = record.clone();
            if wrong.removed.is_empty() || wrong.moved.is_empty() {
                continue;
            }
            change(&mut wrong);
            let error = replay.apply(&wrong).unwrap_err();
            assert!(matches!(error, ProgressiveError::Misfit { .. }));
            assert_same(&replay.to_mesh(), level);
        }
        replay.apply(record).unwrap();
        let mut wrong = record.clone();
        wrong.to.z += 1.0;
        assert!(replay.undo(&wrong).is_err());
    }
}

#[test]
fn a_file_without_records_is_the_mesh() {
    let mesh =
        grid(3, Extras { layers: true, materials: true, parts: true, ugly: true }, &mut Rng(1));
    let file = file_of(&mesh, &[]);
    let reader = Reader::open(&file).unwrap();
    assert_same(&reader.extract(u32::MAX).unwrap(), &mesh);
    assert_eq!(reader.header().levels[0].faces as usize, mesh.faces.len());
    let error = reader.extract_level("lod-9").unwrap_err().to_string();
    assert!(error.contains("'lod-9'; there are: last"), "{error}");
}

/// A fan whose hub keeps more corners than a mask holds.
#[test]
fn long_rings_are_coded_too() {
    let n = 100;
    let rim = (0..n).map(|i| f64::from(i) / f64::from(n) * std::f64::consts::TAU);
    let mut positions = vec![glam::DVec3::Z];
    positions.extend(rim.map(|a| glam::DVec3::new(a.cos(), a.sin(), 0.0)));
    let faces = (0..n).map(|i| [0, 1 + i as u32, 1 + (i as u32 + 1) % n as u32]).collect();
    let mesh = Mesh::from_parts(positions, faces);
    let mut plain = super::reference::Plain::of(&mesh);
    let mut rng = Rng(3);
    let mut records = Vec::new();
    for (keep, drop) in [(10, 11), (50, 51), (0, 70), (5, 0)] {
        records.push(plain.collapse(keep, drop, &mut rng));
    }
    let file = file_of(&mesh, &records);
    let reader = Reader::open(&file).unwrap();
    assert_same(&reader.extract(u32::MAX).unwrap(), &mesh);
    assert_same(&reader.extract(reader.header().n_base_faces).unwrap(), &plain.mesh());
}
