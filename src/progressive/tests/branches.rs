//! Levels with edits of their own in files: out comes what went in, both ways.

use glam::DVec3;
use proptest::prelude::*;

use super::{
    edits::random_edits,
    reference::{Extras, Rng, grid, sequence},
    round_trip::{assert_same, extras},
};
use crate::{
    mesh::{EditMesh, EditRecord, Mesh, VertexId, shapes},
    progressive::{ProgressiveError, Reader, Writer},
};

/// Checks a level of a file against every mesh on the way and the edits between them.
#[track_caller]
fn check_level(reader: &Reader<'_>, name: &str, meshes: &[Mesh], records: &[EditRecord]) {
    let (first, last) = (&meshes[0], &meshes[records.len()]);
    let level = reader.level(name).unwrap();
    assert_eq!(level.n_edits() as usize, records.len());
    assert_eq!(level.is_by_records_alone(), records.is_empty());
    assert_eq!(level.faces as usize, first.faces.len());
    assert_eq!(level.n_final_faces() as usize, last.faces.len());
    if !records.is_empty() {
        assert_eq!(level.n_final_vertices() as usize, last.positions.len());
    }
    assert_same(&reader.extract_level_before_edits(name).unwrap(), first);
    assert_same(&reader.extract_level(name).unwrap(), last);
    let mut forward = reader.edits_forward(name).unwrap();
    let mut backward = reader.edits_backward(name).unwrap();
    assert_same(&backward.to_mesh(), last);
    for (record, mesh) in records.iter().zip(&meshes[1..]) {
        assert_eq!(&forward.next().unwrap().unwrap(), record);
        assert_same(&forward.to_mesh(), mesh);
    }
    for (record, mesh) in records.iter().zip(meshes).rev() {
        assert_eq!(&backward.next().unwrap().unwrap(), record);
        assert_same(&backward.to_mesh(), mesh);
    }
    assert!(forward.next().is_none() && backward.next().is_none());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    #[test]
    fn levels_are_edited_apart(seed in any::<u64>(), extras in extras(), n in 0..60_usize) {
        let mut rng = Rng(seed);
        let mesh = grid(4, extras, &mut rng);
        let (levels, collapses) = sequence(&mesh, n, &mut rng);
        let half = collapses.len() / 2;
        let names = [("start", 0), ("half", half), ("end", collapses.len())];
        let edits = names.map(|(_, at)| random_edits(&levels[at], 40, &mut rng));
        let mut writer = Writer::new(&mesh).unwrap();
        writer.mark_level("start");
        writer.begin_edits("start", &levels[0]).unwrap();
        // The edits of one level while collapses go on.
        let mut early = edits[0].1.iter();
        for (i, collapse) in collapses.iter().enumerate() {
            if i == half {
                writer.mark_level("half");
            }
            writer.push(collapse).unwrap();
            early.next().into_iter().for_each(|r| writer.push_edit(r.edit()).unwrap());
        }
        if collapses.is_empty() {
            writer.mark_level("half");
        }
        early.for_each(|record| writer.push_edit(record.edit()).unwrap());
        writer.mark_level("end");
        // And in any order afterwards.
        for i in [2, 1] {
            writer.begin_edits(names[i].0, &levels[names[i].1]).unwrap();
            edits[i].1.iter().for_each(|record| writer.push_edit(record.edit()).unwrap());
        }
        let file = writer.clone().finish().unwrap();
        prop_assert_eq!(&file, &writer.finish().unwrap());
        let reader = Reader::open(&file).unwrap();
        for (name, (meshes, records)) in names.iter().zip(&edits) {
            check_level(&reader, name.0, meshes, records);
        }
        assert_same(&reader.extract(u32::MAX).unwrap(), &mesh);
        assert_same(&reader.extract(reader.header().n_base_faces).unwrap(), &levels[levels.len() - 1]);
        let mut chain = reader.fine_to_coarse().unwrap();
        for (collapse, level) in collapses.iter().zip(&levels[1..]) {
            prop_assert_eq!(&chain.next().unwrap().unwrap(), collapse);
            assert_same(&chain.to_mesh(), level);
        }
    }
}

/// A chain without collapses, and more edits than a block holds.
#[test]
fn a_mesh_that_another_tool_simplified_is_edited() {
    let mut rng = Rng(5);
    let mesh = shapes::torus(20, 14, 0.1);
    let mut edited = EditMesh::new(mesh.clone()).unwrap();
    let mut writer = Writer::new(&mesh).unwrap();
    writer.mark_level("lod-0");
    writer.begin_edits("lod-0", &mesh).unwrap();
    for _ in 0..9_000 {
        let vertex = VertexId(rng.below(mesh.positions.len()) as u32);
        let to = edited.position(vertex) + DVec3::splat(rng.signed() * 0.01);
        writer.push_edit(&edited.displace(vertex, to)).unwrap();
    }
    assert_same(&writer.edit_replay().unwrap().to_mesh(), &edited.snapshot());
    let file = writer.finish().unwrap();
    let reader = Reader::open(&file).unwrap();
    let header = reader.header();
    assert_eq!((header.n_records, header.n_base_faces), (0, 560));
    assert_eq!(header.levels[0].edits.as_ref().unwrap().blocks.len(), 3);
    assert_same(&reader.extract_level("lod-0").unwrap(), &edited.snapshot());
    assert_same(&reader.extract_level_before_edits("lod-0").unwrap(), &mesh);
}

#[test]
fn edits_come_in_order_and_begin_at_the_level() {
    let mut rng = Rng(9);
    let mesh =
        grid(3, Extras { layers: true, materials: false, parts: false, ugly: false }, &mut rng);
    let (levels, collapses) = sequence(&mesh, 4, &mut rng);
    let mut edited = EditMesh::new(mesh.clone()).unwrap();
    let edits = [DVec3::X, DVec3::Y].map(|to| edited.displace(VertexId(0), to));
    let mut writer = Writer::new(&mesh).unwrap();
    let error = |result: Result<(), ProgressiveError>| result.unwrap_err().to_string();
    writer.mark_level("a");
    collapses.iter().for_each(|c| writer.push(c).unwrap());
    writer.mark_level("b");
    assert!(error(writer.push_edit(&edits[0])).contains("no level's edits have begun"));
    assert_eq!(error(writer.begin_edits("c", &mesh)), "no level is named 'c'; there are: a, b");
    assert!(error(writer.begin_edits("a", &levels[4])).contains("another mesh"));
    assert!(error(writer.begin_edits("b", &mesh)).contains("another mesh"));
    writer.begin_edits("a", &mesh).unwrap();
    assert!(error(writer.begin_edits("a", &mesh)).contains("has edits already"));
    assert!(error(writer.push_edit(&edits[1])).contains("does not fit"));
    writer.push_edit(&edits[0]).unwrap();
    writer.begin_edits("b", &levels[4]).unwrap();
    writer.end_edits().unwrap();
    assert!(error(writer.begin_edits("a", &mesh)).contains("has edits already"));
    let file = writer.finish().unwrap();
    let reader = Reader::open(&file).unwrap();
    assert_eq!(reader.level("a").unwrap().n_edits(), 1);
    assert_eq!(reader.level("b").unwrap().edits, None);
}

/// An edited level is given for a target where the collapses alone have no more triangles.
#[test]
fn the_nearest_level_is_the_edited_one_if_it_fits() {
    let mut rng = Rng(2);
    let mesh =
        grid(5, Extras { layers: false, materials: false, parts: false, ugly: false }, &mut rng);
    let (levels, collapses) = sequence(&mesh, 12, &mut rng);
    let mut writer = Writer::new(&mesh).unwrap();
    collapses[..6].iter().for_each(|c| writer.push(c).unwrap());
    writer.mark_level("edited");
    collapses[6..].iter().for_each(|c| writer.push(c).unwrap());
    writer.mark_level("plain");
    writer.begin_edits("edited", &levels[6]).unwrap();
    let mut moved = EditMesh::new(levels[6].clone()).unwrap();
    let edit = moved.displace(VertexId(3), DVec3::ONE);
    writer.push_edit(&edit).unwrap();
    let file = writer.finish().unwrap();
    let reader = Reader::open(&file).unwrap();
    let coarsest = levels[12].faces.len();
    for target in coarsest..=mesh.faces.len() + 1 {
        let (found, level) = reader.extract_nearest(target as u32).unwrap();
        let plain = reader.extract(target as u32).unwrap();
        if plain.faces.len() == levels[6].faces.len() {
            assert_eq!(level.unwrap().name, "edited");
            assert_same(&found, &moved.snapshot());
        } else {
            assert!(level.is_none());
            assert_same(&found, &plain);
        }
    }
    let error = reader.extract_nearest(coarsest as u32 - 1).unwrap_err();
    assert!(matches!(error, ProgressiveError::TooCoarse { .. }));
}
