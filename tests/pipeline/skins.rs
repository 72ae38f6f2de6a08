//! A model that moves: levels go along with its joints as the original does.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat4, DQuat, DVec3};
use lookalike::{
    io::{Limits, read, write_glb},
    jobs::spec::{Effort, Output, Render, Spec},
    mesh::Mesh,
    metric::surface::{Ruler, SurfaceParams},
};
use serde_json::json;

use super::support::{check_levels, job};

const N_AROUND: usize = 40;
const N_ALONG: usize = 100;

/// A knobbly arm, two units long and bound to two joints, its texture cut along the back (a seam); in hundredths, under a
/// node that turns it up. A cube without a skin is held by the second joint.
fn arm() -> Vec<u8> {
    let mut file = File::default();
    let mut columns: [Vec<f32>; 3] = Default::default();
    let mut joints = Vec::new();
    for i in 0..=N_ALONG {
        for j in 0..=N_AROUND {
            let (along, around) = (i as f64 / N_ALONG as f64, j as f64 / N_AROUND as f64);
            // The two sides of the seam are at the same place, to the bit.
            let angle = (j % N_AROUND) as f64 / N_AROUND as f64 * std::f64::consts::TAU;
            let radius = 25.0 + 3.0 * (5.0 * angle).sin() * (40.0 * along).sin();
            let place = [radius * angle.cos(), 200.0 * along, radius * angle.sin()];
            columns[0].extend(place.map(|x| x as f32));
            columns[1].extend([around as f32, along as f32]);
            let bent = ((along - 0.35) / 0.3).clamp(0.0, 1.0);
            columns[2].extend([1.0 - bent as f32, bent as f32, 0.0, 0.0]);
            joints.extend([0, 1, 0, 0]);
        }
    }
    let mut triangles = Vec::new();
    for i in 0..N_ALONG {
        for j in 0..N_AROUND {
            let [a, b] = [i, i + 1].map(|i| i * (N_AROUND + 1) + j);
            triangles.extend([[a, b, b + 1], [a, b + 1, a + 1]]);
        }
    }
    let [positions, uv, shares] = columns;
    let body = json!({
        "POSITION": file.floats(&positions, "VEC3"), "TEXCOORD_0": file.floats(&uv, "VEC2"),
        "JOINTS_0": file.bytes(&joints, 5121, "VEC4", joints.len() / 4),
        "WEIGHTS_0": file.floats(&shares, "VEC4"),
    });
    let body = json!({ "attributes": body, "indices": file.indices(&triangles) });
    let corner = |k: usize| [0, 1, 2].map(|axis| if k >> axis & 1 == 1 { 10.0 } else { -10.0_f32 });
    let cube: Vec<f32> = (0..8).flat_map(corner).collect();
    let sides =
        [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let sides: Vec<_> =
        sides.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
    let cube = json!({
        "attributes": { "POSITION": file.floats(&cube, "VEC3") }, "indices": file.indices(&sides),
    });
    let half = 0.5_f64.sqrt();
    let rig = DMat4::from_scale_rotation_translation(
        DVec3::splat(0.01),
        DQuat::from_xyzw(half, 0.0, 0.0, half),
        DVec3::new(0.0, 1.0, 0.0),
    );
    let elbow = rig * DMat4::from_translation(DVec3::Y * 100.0);
    let matrices =
        [rig, elbow].map(|joint| (joint.inverse() * rig).to_cols_array().map(|x| x as f32));
    let matrices = file.floats(matrices.as_flattened(), "MAT4");
    file.finish(json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }],
        "nodes": [
            { "name": "rig", "children": [1, 2], "translation": [0, 1, 0], "scale": [0.01, 0.01, 0.01],
              "rotation": [half, 0, 0, half] },
            { "name": "shoulder", "children": [3] },
            { "name": "arm", "mesh": 0, "skin": 0 },
            { "name": "elbow", "children": [4], "translation": [0, 100, 0] },
            { "name": "held", "mesh": 1, "translation": [0, 120, 0] },
        ],
        "meshes": [{ "primitives": [body] }, { "primitives": [cube] }],
        "skins": [{ "joints": [1, 3], "inverseBindMatrices": matrices }],
    }))
}

/// A GLB under construction.
#[derive(Default)]
struct File {
    bin: Vec<u8>,
    views: Vec<serde_json::Value>,
    accessors: Vec<serde_json::Value>,
}

impl File {
    fn bytes(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        let offset = self.bin.len();
        self.bin.extend(bytes);
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        self.views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() }));
        let view = self.views.len() - 1;
        self.accessors.push(json!({
            "bufferView": view, "componentType": component, "type": kind, "count": count }));
        view
    }

    fn floats(&mut self, values: &[f32], kind: &str) -> usize {
        let width = match kind {
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            _ => 16,
        };
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.bytes(&bytes, 5126, kind, values.len() / width)
    }

    fn indices(&mut self, triangles: &[[usize; 3]]) -> usize {
        let flat = triangles.as_flattened();
        let bytes: Vec<u8> = flat.iter().flat_map(|i| (*i as u16).to_le_bytes()).collect();
        self.bytes(&bytes, 5123, "SCALAR", flat.len())
    }

    fn finish(self, mut json: serde_json::Value) -> Vec<u8> {
        json["buffers"] = json!([{ "byteLength": self.bin.len() }]);
        json["bufferViews"] = self.views.into();
        json["accessors"] = self.accessors.into();
        let mut text = json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let word = |n: usize| (n as u32).to_le_bytes();
        let length = 28 + text.len() + self.bin.len();
        let head = [&b"glTF\x02\0\0\0"[..], &word(length), &word(text.len()), b"JSON"].concat();
        [&head[..], &text, &word(self.bin.len()), b"BIN\0", &self.bin].concat()
    }
}

/// What viewers show of a file where the elbow is bent: all triangles, in world space, and as they were bound there.
struct Posed {
    mesh: Mesh,
    /// Where the vertices of the file that were at the same place are now, by that place.
    by_place: BTreeMap<[u32; 3], BTreeSet<[u32; 3]>>,
}

fn posed(glb: &[u8], bend_degrees: f64) -> Posed {
    let file = gltf::Gltf::from_slice_without_validation(glb).unwrap();
    let bin = file.blob.as_deref();
    let mut world_from_node = BTreeMap::new();
    let mut stack: Vec<_> =
        file.scenes().flat_map(|s| s.nodes()).map(|n| (n, DMat4::IDENTITY)).collect();
    let mut drawn = Vec::new();
    while let Some((node, above)) = stack.pop() {
        let local = node.transform().matrix().map(|column| column.map(f64::from));
        let mut world = above * DMat4::from_cols_array_2d(&local);
        if node.name() == Some("elbow") {
            world *= DMat4::from_rotation_x(bend_degrees.to_radians());
        }
        world_from_node.insert(node.index(), world);
        stack.extend(node.children().map(|child| (child, world)));
        drawn.extend(node.mesh().map(|mesh| (mesh, node.skin(), world)));
    }
    let mut out = Posed { mesh: Mesh::default(), by_place: BTreeMap::new() };
    for (mesh, skin, world) in drawn {
        let joints: Vec<DMat4> = skin
            .iter()
            .flat_map(|skin| {
                let inverse = skin.reader(|_| bin).read_inverse_bind_matrices().unwrap();
                let inverse: Vec<_> = inverse
                    .map(|m| DMat4::from_cols_array_2d(&m.map(|c| c.map(f64::from))))
                    .collect();
                let worlds = skin.joints().map(|j| world_from_node[&j.index()]);
                worlds.zip(inverse).map(|(world, inverse)| world * inverse).collect::<Vec<_>>()
            })
            .collect();
        for primitive in mesh.primitives() {
            let reader = primitive.reader(|_| bin);
            let places: Vec<[f32; 3]> = reader.read_positions().unwrap().collect();
            let moves: Vec<DMat4> = match reader.read_joints(0) {
                None => vec![world; places.len()],
                Some(indices) => indices
                    .into_u16()
                    .zip(reader.read_weights(0).unwrap().into_f32())
                    .map(|(j, w)| {
                        assert!((w.iter().sum::<f32>() - 1.0).abs() < 1e-6, "{w:?}");
                        let all = (0..4).map(|k| joints[usize::from(j[k])] * f64::from(w[k]));
                        all.fold(DMat4::ZERO, |a, b| a + b)
                    })
                    .collect(),
            };
            let first = out.mesh.positions.len() as u32;
            for (place, m) in places.iter().zip(&moves) {
                let p = m.transform_point3(DVec3::from_array(place.map(f64::from)));
                let bits = |p: [f32; 3]| p.map(f32::to_bits);
                out.by_place.entry(bits(*place)).or_default().insert(bits(p.as_vec3().to_array()));
                out.mesh.positions.push(p);
            }
            let indices: Vec<u32> = reader.read_indices().unwrap().into_u32().collect();
            out.mesh.faces.extend(indices.as_chunks::<3>().0.iter().map(|t| t.map(|i| first + i)));
        }
    }
    out
}

fn distance(a: &Mesh, b: &Mesh) -> f64 {
    let params = SurfaceParams { samples: 20_000, ..SurfaceParams::default() };
    Ruler::new(a, params).mean(b).unwrap()
}

fn check(file: &str, level: &[u8], original: &[u8]) {
    let [still, bent] = [0.0, 80.0].map(|degrees| {
        let [a, b] = [original, level].map(|glb| posed(glb, degrees));
        let torn = b.by_place.values().filter(|places| places.len() > 1).count();
        // Of a quantized cube and arm, corners may share a place by chance.
        assert_eq!(torn, 0, "{file}: {torn} of {} places are torn", b.by_place.len());
        distance(&a.mesh, &b.mesh)
    });
    let moved = distance(&posed(original, 0.0).mesh, &posed(original, 80.0).mesh);
    eprintln!("{file}: {still:.5} still, {bent:.5} bent; what moves, by {moved:.3}");
    assert!(moved > 0.1 && still < 0.02 && bent < 1.5 * still, "{file}: {still} {bent} {moved}");
}

#[test]
fn levels_move_as_the_original_does() {
    let input = arm();
    let render = Render { n_views: 12, image_size: 128, ..Render::default() };
    for output in [Output::default(), Output { quantize: true, compress: false }] {
        let spec = Spec {
            effort: Effort::Fast,
            render: render.clone(),
            output,
            ..Spec::new(vec![1600, 500])
        };
        let done = job(&spec, "arm.glb", &input, "cpu");
        assert!(done.has_note("SKINS_CARRIED"), "{:?}", done.notes);
        if output == Output::default() {
            check_levels(&done);
        }
        for file in ["lod-0.glb", "lod-1.glb", "lods.glb"] {
            let mesh = read(file, &done.files[file], &Limits::default()).unwrap().mesh;
            // Quantized places are not read by everybody: as singles, from what was read of them.
            let singles = write_glb(&mesh).unwrap();
            check(file, if output.quantize { &singles } else { &done.files[file] }, &input);
            assert_eq!(
                mesh.tree.skins.len(),
                2,
                "{file}: that of the arm and that of what is held"
            );
        }
    }
}
