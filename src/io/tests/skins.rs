//! Skins: what is read of them, and what is not.

use glam::{DMat4, DVec3};

use super::*;
use crate::{
    io::{GlbOptions, write_glb, write_glb_with},
    mesh::{Semantic, WedgeId, skin},
};

/// The square, bound to two joints below a node that moves and scales; the mesh hangs there too. A second square without
/// a skin hangs from the second joint.
///
/// ```text
/// rig (10 up, 100 times as large) ── root ── tip (0.01 to the right) ── hat: the square
///   └─ body: the square with a skin
/// ```
fn skinned(edit: impl FnOnce(&mut Value)) -> Vec<u8> {
    let (mut json, mut bin) = (square_json(), square_bin());
    let joints: [[u8; 4]; 4] = [[0, 1, 0, 0], [0, 1, 0, 0], [1, 0, 0, 0], [1, 1, 0, 0]];
    let shares = [[0.75, 0.25, 0., 0.], [0., 2., 0., 0.], [0.5, 0.5, 0., 0.], [0.25, 0.5, 0., 0.]];
    bin.extend(joints.as_flattened());
    bin.extend(bytes_of(shares.as_flattened()));
    // What brings the square from where it was bound, with the rig's transform, to its joints.
    let rig = DMat4::from_translation(DVec3::Y * 10.0) * DMat4::from_scale(DVec3::splat(100.0));
    let tip = rig * DMat4::from_translation(DVec3::X * 0.01);
    for joint in [rig, tip] {
        let joint_from_mesh = joint.inverse() * rig;
        bin.extend(bytes_of(&joint_from_mesh.to_cols_array().map(|x| x as f32)));
    }
    json["nodes"] = json!([
        { "name": "rig", "children": [1, 2], "translation": [0, 10, 0], "scale": [100, 100, 100] },
        { "name": "root", "children": [3] },
        { "name": "body", "mesh": 0, "skin": 0 },
        { "name": "tip", "children": [4], "translation": [0.01, 0, 0] },
        { "name": "hat", "mesh": 1 },
    ]);
    json["skins"] = json!([{ "name": "bones", "joints": [1, 3], "inverseBindMatrices": 4 }]);
    let square = json["meshes"][0].clone();
    json["meshes"] = json!([square, square]);
    let attributes = &mut json["meshes"][0]["primitives"][0]["attributes"];
    (attributes["JOINTS_0"], attributes["WEIGHTS_0"]) = (2.into(), 3.into());
    let lengths = [(60, 16), (76, 64), (140, 128)];
    for (offset, length) in lengths {
        let view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": length });
        json["bufferViews"].as_array_mut().unwrap().push(view);
    }
    for (view, component, count, kind) in
        [(2, 5121, 4, "VEC4"), (3, 5126, 4, "VEC4"), (4, 5126, 2, "MAT4")]
    {
        json["accessors"].as_array_mut().unwrap().push(json!({
            "bufferView": view, "componentType": component, "count": count, "type": kind,
        }));
    }
    json["buffers"][0]["byteLength"] = bin.len().into();
    edit(&mut json);
    glb(&json, &bin)
}

#[test]
fn a_skin_is_read_as_it_was_bound() {
    let Ingest { mesh, report, .. } = load("x.glb", &skinned(|_| ())).unwrap();
    let codes: Vec<_> = report.notes.iter().map(|n| n.code).collect();
    assert_eq!(codes, ["skins_carried"]);
    let tree = &mesh.tree;
    let moved: Vec<_> = tree.nodes.iter().map(|n| (&*n.name, n.transform.is_some())).collect();
    let want = [("rig", true), ("root", true), ("tip", true), ("hat", false), ("body", false)];
    assert_eq!(moved, want);
    assert_eq!(
        tree.nodes[0].transform.clone().map(Value::Object),
        Some(json!({
            "translation": [0.0, 10.0, 0.0], "scale": [100.0, 100.0, 100.0],
        }))
    );
    let [bones, hat] = &tree.skins[..] else { panic!("{:?}", tree.skins) };
    assert_eq!((&*bones.name, &bones.joints[..], bones.numbers()), ("bones", &[1, 2][..], 0..2));
    assert_eq!((&hat.joints[..], hat.numbers()), (&[2][..], 2..3), "it hangs from the tip");
    let layer = mesh.layer(Semantic::Skin).unwrap();
    let skins: Vec<_> =
        mesh.face_wedges.as_flattened().iter().map(|w| layer.get(WedgeId(*w))).collect();
    let settled = |shares: &[(u32, f64)]| skin::settled(shares.iter().copied());
    let body = [
        settled(&[(0, 0.75), (1, 0.25)]),
        settled(&[(1, 1.0)]),
        settled(&[(0, 0.5), (1, 0.5)]),
        settled(&[(1, 1.0)]),
    ];
    let faces = [[0, 1, 2], [2, 1, 3]];
    let at = faces.as_flattened().iter();
    let hats = [settled(&[(2, 1.0)]); 6];
    // The hat comes first: its node is visited first.
    let want: Vec<_> = hats.into_iter().chain(at.map(|v: &usize| body[*v])).collect();
    assert_eq!(skins, want);
    let farthest = mesh.positions.iter().map(|p| p.length()).fold(0.0, f64::max);
    assert!((farthest - DVec3::new(101.0, 110.0, 0.0).length()).abs() < 1e-3, "{farthest}");
}

/// Again read, the file says the same; quantized, but for rounding.
#[test]
fn skins_are_written_as_they_were_read() {
    let mesh = load("x.glb", &skinned(|_| ())).unwrap().mesh;
    let again = load("x.glb", &write_glb(&mesh).unwrap()).unwrap().mesh;
    assert_eq!(again.layers, mesh.layers);
    let skins = |mesh: &Mesh| {
        let singles = |m: &[f64; 16]| m.map(|x| x as f32);
        let of = |s: &crate::mesh::Skin| s.joint_from_world.iter().map(singles).collect();
        mesh.tree.skins.iter().map(of).collect::<Vec<Vec<_>>>()
    };
    assert_eq!(skins(&again), skins(&mesh));
    let names = |mesh: &Mesh| {
        let of = |j: &u32| mesh.tree.nodes[*j as usize].name.clone();
        mesh.tree.skins.iter().map(|s| s.joints.iter().map(of).collect()).collect::<Vec<Vec<_>>>()
    };
    assert_eq!(names(&again), [vec!["root", "tip"], vec!["tip"]]);
    // In thousandths, and in any order: compressed triangles are sorted anew.
    let thousandths = |mesh: &Mesh| {
        let layer = mesh.layer(Semantic::Skin).unwrap();
        let corners = mesh.face_wedges.as_flattened().iter().map(|w| layer.get(WedgeId(*w)));
        let round = |values: &[f32]| values.iter().map(|v| (v * 1e3).round() as i32).collect();
        let mut all: Vec<Vec<i32>> = corners.map(round).collect();
        all.sort_unstable();
        all
    };
    for compress in [false, true] {
        let file = write_glb_with(&mesh, GlbOptions { compress, quantize: true }).unwrap();
        let small = load("x.glb", &file).unwrap().mesh;
        assert_eq!(names(&small), names(&mesh));
        assert_eq!(thousandths(&small), thousandths(&mesh));
    }
}

#[test]
fn broken_skins_are_refused_or_mended() {
    type Edit = fn(&mut Value);
    let refused: [(Edit, &str); 5] = [
        (|json| json["nodes"][2]["skin"] = 7.into(), "skins"),
        (|json| json["skins"][0]["joints"] = json!([1]), "joints"),
        (|json| json["accessors"][4]["count"] = 1.into(), "matrices"),
        (|json| json["accessors"][4]["type"] = "VEC4".into(), "MAT4"),
        (|json| json["accessors"][2]["type"] = "VEC3".into(), "VEC4"),
    ];
    for (edit, what) in refused {
        let error = error_of("x.glb", &skinned(edit)).to_string();
        assert!(error.to_lowercase().contains(&what.to_lowercase()), "{what}: {error}");
    }
    let mended: [(Edit, &[&str]); 4] = [
        // Joints outside the scene.
        (|json| json["skins"][0]["joints"] = json!([1, 77]), &["skins_ignored"]),
        // No weights: all goes along with the first joint.
        (
            |json| {
                let attributes = json["meshes"][0]["primitives"][0]["attributes"].as_object_mut();
                attributes.unwrap().remove("WEIGHTS_0");
            },
            &["skin_mended", "skins_carried"],
        ),
        // Flattened joints have no inverse.
        (|json| json["nodes"][3]["scale"] = json!([0, 1, 1]), &["skins_carried"]),
        (|json| json["nodes"][1]["scale"] = json!([0, 0, 0]), &["skins_carried"]),
    ];
    for (edit, want) in mended {
        let Ingest { mesh, report, .. } = load("x.glb", &skinned(edit)).unwrap();
        let mut codes: Vec<_> = report.notes.iter().map(|n| n.code).collect();
        codes.sort_unstable();
        assert_eq!(codes, want);
        load("x.glb", &write_glb(&mesh).unwrap()).unwrap();
    }
}
