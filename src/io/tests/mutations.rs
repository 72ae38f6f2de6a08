//! Damaged files: an error or a valid mesh, never a panic. The mutations are those of the fuzz
//! targets, bounded and the same in every run.

use proptest::prelude::*;

use super::{
    archives::{deflated, pack, stored},
    compressed, packed, *,
};
use crate::io::{GlbOptions, PlyPositions, write_glb, write_glb_with, write_obj, write_ply};

/// A few files of each format, small enough that most bytes matter.
fn seeds() -> Vec<(&'static str, Vec<u8>)> {
    let mesh = load("a.glb", &square_glb()).unwrap().mesh;
    let obj = "v 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nusemtl a\n\
               f 1/1/1 2//1 3 -1\n";
    let strips = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n\
        property uchar red\nelement tristrips 1\nproperty list int int vertex_indices\n\
        end_header\n0 0 7\n1 0 8\n0 1 9\n1 1 200\n5 0 1 2 3 -1\n";
    let corners = "ply\nformat ascii 1.0\ncomment TextureFile a\nelement face 2\n\
        property list uchar int vertex_indices\nproperty list uchar float texcoord\n\
        property int texnumber\nelement vertex 5\nproperty float x\nproperty float y\n\
        property float z\nproperty float nx\nproperty uchar lock\nend_header\n\
        5 0 1 2 3 4 10 0 0 1 0 1 1 0 1 .5 .5 0\n3 0 1 2 0 1\n\
        4 0 0 0 0\n4 4 0 0 1\n3 1 0 0 0\n0 4 0 0 0\n0 0 1 0 0\n";
    let mut stl = vec![b' '; 80];
    stl.extend(1_u32.to_le_bytes());
    stl.extend(bytes_of(&[0., 0., 1., 0., 0., 0., 1., 0., 0., 0., 1., 0.]));
    stl.extend([0, 0]);
    let text = "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n\
                vertex 0 1 0\nendloop\nendfacet\nendsolid s\n";
    let textured = textured_glb(&[png(), encoded(ImageFormat::Jpeg, [8, 8], [1; 3])], |json| {
        json["samplers"] = json!([{ "wrapS": 33071, "minFilter": 9987 }]);
        json["textures"][1] = json!({ "sampler": 0, "source": 0,
            "extensions": { "EXT_texture_webp": { "source": 1 } } });
        json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"] = 1.into();
        json["materials"][0]["normalTexture"] = json!({ "index": 0, "texCoord": 0 });
    });
    let textured_again = write_glb(&load("a.glb", &textured).unwrap().mesh).unwrap();
    let mtl = "newmtl a\nKd .5 1 0\nd .5\nmap_Kd -s 2 -o .5 .5 -clamp on -mm 0 1 a.png\n";
    let with_library = format!("mtllib a.mtl\n{obj}");
    let obj_files = [
        stored("a.obj", with_library.as_bytes()),
        stored("a.mtl", mtl.as_bytes()),
        deflated("a.png", &png()),
    ];
    let mut beside = square_json();
    beside["buffers"][0]["uri"] = "a.bin".into();
    let gltf_files =
        [stored("a.gltf", beside.to_string().as_bytes()), deflated("a.bin", &square_bin())];
    vec![
        ("a.zip", pack(&obj_files)),
        ("a.zip", pack(&gltf_files)),
        ("a.glb", compressed::seed()),
        ("a.glb", square_glb()),
        ("a.glb", textured),
        ("a.glb", textured_again),
        ("a.glb", write_glb(&mesh).unwrap()),
        ("a.gltf", square_json().to_string().into_bytes()),
        ("a.ply", write_ply(&mesh, PlyPositions::Double).unwrap()),
        ("a.ply", strips.into()),
        ("a.ply", corners.into()),
        ("a.obj", obj.into()),
        ("a.obj", write_obj(&mesh).unwrap()),
        ("a.stl", stl),
        ("a.stl", text.into()),
    ]
    .into_iter()
    .chain(packed::seeds())
    .collect()
}

/// One edit of the bytes.
fn mutate(bytes: &mut Vec<u8>, kind: u8, at: prop::sample::Index, value: u32) {
    if bytes.is_empty() {
        return;
    }
    let at = at.index(bytes.len());
    match kind % 6 {
        0 => bytes[at] = value as u8,
        1 => bytes[at] ^= 1 << (value % 8),
        2 => bytes.truncate(at),
        3 => bytes.insert(at, value as u8),
        4 => drop(bytes.drain(at..(at + value as usize % 16).min(bytes.len()))),
        // A whole word: counts, offsets, indices.
        _ => bytes.iter_mut().skip(at).zip(value.to_le_bytes()).for_each(|(b, v)| *b = v),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4000))]

    #[test]
    fn damaged_files_never_panic(
        seed in any::<prop::sample::Index>(),
        edits in prop::collection::vec(
            (any::<u8>(), any::<prop::sample::Index>(),
             prop_oneof![any::<u32>(), 0..20_u32, Just(u32::MAX), Just(u32::from(b'9'))]), 1..5),
    ) {
        let seeds = seeds();
        let (name, mut bytes) = seeds[seed.index(seeds.len())].clone();
        for (kind, at, value) in edits {
            mutate(&mut bytes, kind, at, value);
        }
        if let Ok(ingest) = load(name, &bytes) {
            // What was read can be written, and what was written can be read.
            let compressed = GlbOptions { quantize: true, compress: true };
            for options in [GlbOptions::default(), compressed] {
                let Ok(bytes) = write_glb_with(&ingest.mesh, options) else { continue };
                let images = ingest.mesh.images.iter().filter(|image| !image.bytes.is_empty());
                let n = if ingest.mesh.materials.is_empty() { 0 } else { images.count() };
                match load("a.glb", &bytes) {
                    Ok(again) => prop_assert_eq!(again.mesh.images.len(), n),
                    // Points may fall together in single precision, or on the grid.
                    Err(error) => prop_assert_eq!(error.code(), "NO_TRIANGLES"),
                }
            }
        }
    }

    #[test]
    fn any_bytes_never_panic(
        name in prop::sample::select(vec!["a.glb", "a.gltf", "a.ply", "a.obj", "a.stl", "a.zip", "a"]),
        bytes in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        let _ = load(name, &bytes);
    }
}
