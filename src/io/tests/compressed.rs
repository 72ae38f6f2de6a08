//! Compressed buffer views, encoded by the encoders of the crate that decodes them.

use meshopt::{
    EncodeExpMode, encode_filter_color, encode_filter_exp, encode_filter_oct, encode_filter_quat,
    encode_index_buffer, encode_index_sequence, encode_vertex_buffer_level,
};

use super::*;
use crate::mesh::{Semantic, WedgeId};

const EXT: &str = "EXT_meshopt_compression";
const KHR: &str = "KHR_meshopt_compression";
const INDICES: [u32; 6] = [0, 1, 2, 2, 1, 3];

/// A file that is all compressed views.
struct Writer {
    extension: &'static str,
    views: Vec<Value>,
    bin: Vec<u8>,
}

impl Writer {
    fn put(&mut self, encoded: &[u8], stride: usize, count: usize, mode: &str, filter: &str) {
        let extension = json!({ "buffer": 0, "byteOffset": self.bin.len(),
            "byteLength": encoded.len(), "byteStride": stride, "count": count, "mode": mode,
            "filter": filter });
        self.bin.extend(encoded);
        self.views.push(json!({ "buffer": 1, "byteLength": stride * count,
            "extensions": { self.extension: extension } }));
    }

    fn attribute<T>(&mut self, elements: &[T], filter: &str) {
        let version = i32::from(self.extension == KHR);
        let encoded = encode_vertex_buffer_level(elements, 2, Some(version)).unwrap();
        self.put(&encoded, size_of::<T>(), elements.len(), "ATTRIBUTES", filter);
        self.views.last_mut().unwrap()["byteStride"] = size_of::<T>().into();
    }
}

/// The square with an attribute for each filter; its indices are view 5.
fn compressed_glb(extension: &'static str, mode: &str, edit: impl FnOnce(&mut Value)) -> Vec<u8> {
    let mut writer = Writer { extension, views: Vec::new(), bin: Vec::new() };
    let positions = [[0.0, 0.0, 0.0_f32], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
    let exponential = encode_filter_exp(&positions, 15, EncodeExpMode::SharedVector);
    writer.attribute(&exponential, "EXPONENTIAL");
    writer.attribute(&encode_filter_oct::<i8>(&[[0.0, 0.0, -1.0, 0.0]; 4], 8), "OCTAHEDRAL");
    writer.attribute(&[[0_u16, 65_535], [65_535, 0], [0, 0], [13_107, 0]], "NONE");
    writer.attribute(&encode_filter_quat(&[[0.0, 1.0, 0.0, 0.0]; 4], 12), "QUATERNION");
    writer.attribute(&encode_filter_color::<u16>(&[[1.0, 0.0, 0.5, 1.0]; 4], 12), "COLOR");
    let (encoded, stride) = match mode {
        "TRIANGLES" => (encode_index_buffer(&INDICES, 4).unwrap(), 2),
        _ => (encode_index_sequence(&INDICES, 4).unwrap(), 4),
    };
    writer.put(&encoded, stride, 6, mode, "NONE");
    let accessor = |view: usize, component: u32, kind: &str, count: u32| {
        json!({ "bufferView": view, "componentType": component, "type": kind, "count": count,
                "normalized": ![0, 5].contains(&view) })
    };
    let mut json = square_json();
    json["extensionsUsed"] = json!([extension]);
    json["extensionsRequired"] = json!([extension, "KHR_mesh_quantization"]);
    json["meshes"][0]["primitives"][0] = json!({ "indices": 5, "attributes": { "POSITION": 0,
        "NORMAL": 1, "TEXCOORD_0": 2, "COLOR_0": 3, "COLOR_1": 4 } });
    json["accessors"] = json!([
        accessor(0, 5126, "VEC3", 4),
        accessor(1, 5120, "VEC3", 4),
        accessor(2, 5123, "VEC2", 4),
        accessor(3, 5122, "VEC4", 4),
        accessor(4, 5123, "VEC4", 4),
        accessor(5, if stride == 2 { 5123 } else { 5125 }, "SCALAR", 6),
    ]);
    json["buffers"] = json!([{ "byteLength": writer.bin.len() },
        { "byteLength": 1000, "extensions": { extension: { "fallback": true } } }]);
    json["bufferViews"] = writer.views.into();
    edit(&mut json);
    glb(&json, &writer.bin)
}

pub(super) fn seed() -> Vec<u8> {
    compressed_glb(EXT, "TRIANGLES", |_| {})
}

#[test]
fn every_mode_and_filter_is_read() {
    for (extension, mode) in [(EXT, "TRIANGLES"), (EXT, "INDICES"), (KHR, "TRIANGLES")] {
        let Ingest { mesh, report, .. } =
            load("a.glb", &compressed_glb(extension, mode, |_| {})).unwrap();
        assert_eq!(report.notes, [], "{extension}, {mode}");
        let plain = load("a.glb", &square_glb()).unwrap().mesh;
        assert_eq!(mesh.positions, plain.positions);
        // The codec of triangles may turn them.
        for (found, expected) in mesh.faces.iter().zip(&plain.faces) {
            let turns = [0, 1, 2].map(|k| [0, 1, 2].map(|i| found[(i + k) % 3]));
            assert!(turns.contains(expected), "{found:?}");
        }
        let wedge =
            WedgeId(mesh.face_wedges[1][mesh.faces[1].iter().position(|v| *v == 3).unwrap()]);
        for (semantic, expected) in [
            (Semantic::Normal, &[0.0, 0.0, -1.0][..]),
            (Semantic::TexCoord(0), &[0.2, 0.0]),
            (Semantic::Color(0), &[0.0, 1.0, 0.0, 0.0]),
            (Semantic::Color(1), &[1.0, 0.0, 0.5, 1.0]),
        ] {
            let values = mesh.layer(semantic).unwrap().get(wedge);
            let near = values.iter().zip(expected).all(|(a, b)| (a - b).abs() < 0.01);
            assert!(near, "{semantic:?}: {values:?}");
        }
    }
}

/// What is not compressed, or not used, is not looked at.
#[test]
fn other_views_stay_as_they_are() {
    let bytes = compressed_glb(EXT, "INDICES", |json| {
        json["bufferViews"][4]["extensions"][EXT]["mode"] = "FUTURE".into();
        json["meshes"][0]["primitives"][0]["attributes"].as_object_mut().unwrap().remove("COLOR_1");
        json["bufferViews"][3]["extensions"] = json!({ "ACME_other": { "count": "x" } });
        json["bufferViews"][3]["buffer"] = 0.into();
    });
    assert_eq!(load("a.glb", &bytes).unwrap().mesh.layers.len(), 3);
}

#[test]
fn bad_compression_is_an_error() {
    let rows: [(usize, &str, Value, &str, &str); 14] = [
        (0, "mode", "FUTURE".into(), "MALFORMED_FILE", "no compression of mode 'FUTURE'"),
        (0, "mode", "INDICES".into(), "MALFORMED_FILE", "with a stride of 12"),
        (0, "byteStride", 0.into(), "MALFORMED_FILE", "with a stride of 0"),
        (0, "byteStride", 260.into(), "MALFORMED_FILE", "with a stride of 260"),
        (0, "filter", "OCTAHEDRAL".into(), "MALFORMED_FILE", "no filter 'OCTAHEDRAL'"),
        (0, "filter", "QUATERNION".into(), "MALFORMED_FILE", "no filter 'QUATERNION'"),
        (0, "count", u64::MAX.into(), "MALFORMED_FILE", "elements of 12 bytes in a view of 48"),
        (0, "count", json!(-1), "MALFORMED_FILE", "JSON, line 1"),
        (0, "byteLength", 1.into(), "MALFORMED_FILE", "take 4 compressed bytes or more, not 1"),
        (0, "byteLength", 9.into(), "MALFORMED_FILE", "its compressed data is bad"),
        (0, "byteOffset", 1.into(), "MALFORMED_FILE", "its compressed data is bad"),
        (0, "byteOffset", u64::MAX.into(), "TRUNCATED_FILE", "buffer view 0"),
        (0, "buffer", 1.into(), "MALFORMED_FILE", "neither a URI nor a binary chunk"),
        (5, "filter", "EXPONENTIAL".into(), "MALFORMED_FILE", "for mode 'TRIANGLES'"),
    ];
    for (view, key, value, code, says) in rows {
        let edit = |json: &mut Value| json["bufferViews"][view]["extensions"][EXT][key] = value;
        let error = error_of("a.glb", &compressed_glb(EXT, "TRIANGLES", edit));
        assert_eq!(error.code(), code, "{error}");
        assert!(error.to_string().contains(says), "'{error}' does not say '{says}'");
    }
    let view = |json: &mut Value, view: usize, stride: u64, count: u64| {
        json["bufferViews"][view]["byteLength"] = (stride * count).into();
        json["bufferViews"][view]["extensions"][EXT]["count"] = count.into();
    };
    let uneven = compressed_glb(EXT, "TRIANGLES", |json| view(json, 5, 2, 5));
    assert!(error_of("a.glb", &uneven).to_string().contains("5 elements are no multiple of 3"));
    let many = compressed_glb(EXT, "INDICES", |json| view(json, 5, 4, 1 << 40));
    assert!(error_of("a.glb", &many).to_string().contains("compressed bytes or more"));
    let limits = Limits { max_bytes: 60, ..Limits::default() };
    let source = compressed_glb(EXT, "TRIANGLES", |_| {});
    assert_eq!(read("a.glb", &source, &limits).unwrap_err().code(), "OVER_LIMIT");
}
