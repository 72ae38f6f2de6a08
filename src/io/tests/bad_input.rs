//! Bad input: each gives an error that names file, place and remedy.

use super::*;

#[track_caller]
fn check(name: &str, bytes: &[u8], code: &str, says: &str) {
    let error = error_of(name, bytes);
    let text = error.to_string();
    assert_eq!(error.code(), code, "{text}");
    assert!(text.starts_with(name), "{text}");
    assert!(text.contains(says), "'{text}' does not say '{says}'");
}

#[track_caller]
fn check_square(change: impl FnOnce(&mut Value), code: &str, says: &str) {
    let mut json = square_json();
    change(&mut json);
    check("square.glb", &glb(&json, &square_bin()), code, says);
}

#[test]
fn empty_truncated_and_unknown() {
    check("a.glb", b"", "EMPTY_FILE", "empty");
    check("a.glb", b"no glTF", "UNKNOWN_FORMAT", "not a GLB file");
    check("a.xyz", b"\0\0", "UNKNOWN_FORMAT", "unknown format");
    let whole = square_glb();
    for cut in [4, 11, 19, 27, 100, whole.len() - 1] {
        check("a.glb", &whole[..cut], "TRUNCATED_FILE", "cut short");
    }
    let mut old = whole.clone();
    old[4] = 1;
    check("a.glb", &old, "MALFORMED_FILE", "version 1 instead of 2");
    check("a.gltf", b"{\"asset\":", "MALFORMED_FILE", "JSON, line 1");
}

#[test]
fn gltf_references_and_ranges() {
    let accessor = |json: &mut Value, key: &str, value: Value| json["accessors"][1][key] = value;
    check_square(|j| j["nodes"][0]["mesh"] = 7.into(), "INDEX_OUT_OF_RANGE", "index 7");
    check_square(|j| j["scenes"][0]["nodes"] = json!([3]), "INDEX_OUT_OF_RANGE", "1 nodes");
    check_square(|j| j["scene"] = 4.into(), "INDEX_OUT_OF_RANGE", "1 scenes");
    check_square(|j| accessor(j, "bufferView", 9.into()), "INDEX_OUT_OF_RANGE", "buffer views");
    check_square(|j| accessor(j, "count", 7.into()), "TRUNCATED_FILE", "indices");
    check_square(|j| accessor(j, "byteOffset", u64::MAX.into()), "TRUNCATED_FILE", "indices");
    check_square(|j| accessor(j, "type", "VEC3".into()), "MALFORMED_FILE", "Scalar");
    check_square(|j| accessor(j, "componentType", 5126.into()), "MALFORMED_FILE", "unsigned");
    check_square(|j| j["bufferViews"][0]["byteLength"] = 4096.into(), "TRUNCATED_FILE", "view 0");
    check_square(|j| j["bufferViews"][0]["byteStride"] = 4.into(), "MALFORMED_FILE", "stride of 4");
    check_square(|j| j["buffers"][0]["byteLength"] = 4096.into(), "TRUNCATED_FILE", "buffer 0");
    let material = |j: &mut Value| j["meshes"][0]["primitives"][0]["material"] = 0.into();
    check_square(material, "INDEX_OUT_OF_RANGE", "0 materials");
    let position = |j: &mut Value| j["accessors"][0]["count"] = 3.into();
    check_square(position, "INDEX_OUT_OF_RANGE", "'square', primitive 0: triangle 1: index 3");
}

#[test]
fn gltf_trees() {
    let nodes = |nodes: Value| move |j: &mut Value| j["nodes"] = nodes;
    check_square(nodes(json!([{ "children": [0] }])), "MALFORMED_FILE", "node 0: it is reached");
    let cycle = json!([{ "children": [1] }, { "children": [2] }, { "children": [1] }]);
    check_square(nodes(cycle), "MALFORMED_FILE", "node 1: it is reached twice");
    // 64 levels that each name the next one twice would be 2^64 instances.
    let doubling = (1..65).map(|i| json!({ "children": [i, i] }));
    let doubling: Value = doubling.chain([json!({ "mesh": 0 })]).collect();
    check_square(nodes(doubling), "MALFORMED_FILE", "reached twice");
    check_square(nodes(json!([{}])), "NO_TRIANGLES", "no node of the scene");
}

#[test]
fn what_this_build_cannot_read_is_named_with_a_remedy() {
    let require = |name: &'static str| move |j: &mut Value| j["extensionsRequired"] = json!([name]);
    for (name, remedy) in [
        ("EXT_mesh_gpu_instancing", "one node per instance"),
        ("ACME_secret", "without this extension"),
    ] {
        check_square(require(name), "UNSUPPORTED_FEATURE", name);
        check_square(require(name), "UNSUPPORTED_FEATURE", remedy);
    }
    let external = |j: &mut Value| j["buffers"][0]["uri"] = "../etc/square.bin".into();
    check_square(external, "UNSUPPORTED_FEATURE", "../etc/square.bin");
}

#[test]
fn positions_that_are_not_finite() {
    for bad in [f32::NAN, f32::INFINITY] {
        let mut bin = square_bin();
        bin[28..32].copy_from_slice(&bad.to_le_bytes());
        let bytes = glb(&square_json(), &bin);
        check("a.glb", &bytes, "NON_FINITE_POSITION", "'square', primitive 0: vertex 2");
    }
    let obj = b"v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n";
    check("a.obj", obj, "NON_FINITE_POSITION", "line 2: vertex 1");
    let ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
               property float z\nelement face 1\nproperty list uchar int vertex_indices\n\
               end_header\n0 0 0\n1 0 0\n0 inf 0\n3 0 1 2\n";
    check("a.ply", ply.as_bytes(), "NON_FINITE_POSITION", "element vertex: vertex 2");
}

#[test]
fn nothing_but_degenerate_triangles() {
    let obj = b"v 0 0 0\nv 1 0 0\nv 1 0 0\nf 1 2 3\nf 1 2 2\n";
    check("a.obj", obj, "NO_TRIANGLES", "each of its 2 triangles");
    check("a.obj", b"v 0 0 0\n", "NO_TRIANGLES", "no surface");
    let on_a_line = b"v 0 0 0\nv 0.1 0.3 0\nv 0.2 0.6 0\nv 0.5 1.5 0\nf 1 2 3\nf 2 3 4\n";
    check("a.obj", on_a_line, "NO_TRIANGLES", "are on a line");
    // One of three: it stays, and is told of.
    let mixed = [&on_a_line[..], b"v 9 0 0\nf 1 2 5\n"].concat();
    let Ingest { mesh, report, .. } = load("a.obj", &mixed).unwrap();
    let told = report.notes.iter().find(|n| n.code == "triangles_without_area").unwrap();
    assert_eq!((mesh.faces.len(), &told.text[..1]), (3, "2"));
}

#[test]
fn limits_hold_before_anything_is_allocated() {
    let limited = |limits: Limits| read("a.glb", &square_glb(), &limits).unwrap_err();
    let limits = Limits::default();
    for (limits, what) in [
        (Limits { max_bytes: 100, ..limits }, "bytes"),
        (Limits { max_triangles: 1, ..limits }, "triangles"),
        (Limits { max_vertices: 3, ..limits }, "vertices"),
        (Limits { max_json_objects: 2, ..limits }, "objects"),
    ] {
        let error = limited(limits);
        assert_eq!(error.code(), "OVER_LIMIT");
        assert!(error.to_string().contains(what), "{error}");
    }
    // A sparse accessor needs no bytes for its base: only the limit holds its count back.
    let mut json = square_json();
    json["accessors"][0]["count"] = 4_000_000_000_u64.into();
    json["accessors"][0]["bufferView"].take();
    json["accessors"][0]["sparse"] = json!({ "count": 1,
        "indices": { "bufferView": 1, "componentType": 5123 }, "values": { "bufferView": 0 } });
    check("a.glb", &glb(&json, &square_bin()), "OVER_LIMIT", "4000000000 vertices");
    let ply = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n\
                property float x\nelement face 1\nend_header\n0123";
    check("a.ply", ply, "TRUNCATED_FILE", "4000000000 rows");
    let mut stl = vec![0; 84];
    stl[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    check("a.stl", &stl, "TRUNCATED_FILE", "4294967295 binary facets: 214748364834 bytes");
    check("a", &stl, "UNKNOWN_FORMAT", "unknown format");
    check("a.stl", &[b'?'; 99], "UNKNOWN_FORMAT", "not a STL file");
}

#[test]
fn text_formats_name_the_line() {
    check("a.obj", b"v 0 0\n", "MALFORMED_FILE", "line 1: 3 numbers are needed, 2 are there");
    check("a.obj", b"v 0 0 0\nf 1 2 3\n", "INDEX_OUT_OF_RANGE", "line 2: index 2");
    check("a.obj", b"v 0 0 0\nf -2 1 1\n", "INDEX_OUT_OF_RANGE", "index -2");
    check("a.obj", b"v 0 0 0\nf 0 0 0\n", "INDEX_OUT_OF_RANGE", "index 0");
    check("a.obj", b"v 0 0 0\nf a b c\n", "MALFORMED_FILE", "cannot read 'a'");
    let head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nelement face 1\n\
                property list uchar int vertex_indices\nend_header\n";
    let ply = |rest: &str| format!("{head}{rest}").into_bytes();
    check("a.ply", &ply("0\n3 0 0 1\n"), "INDEX_OUT_OF_RANGE", "line 9 (element face, row 0)");
    check("a.ply", &ply("zero\n3 0 0 0\n"), "MALFORMED_FILE", "line 8 (element vertex, row 0)");
    check("a.ply", &ply("0\n3 0 0\n"), "TRUNCATED_FILE", "element face, row 0");
    check("a.ply", b"ply\nformat ascii 1.0\n", "MALFORMED_FILE", "end_header");
    check("a.ply", b"ply\nelement vertex x\n", "MALFORMED_FILE", "header, line 2");
    let twice = head.replace("element face", "element vertex 1\nproperty float x\nelement face");
    check("a.ply", twice.as_bytes(), "MALFORMED_FILE", "header, line 5: there is an element");
    let stl = b"solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0\n";
    check("a.stl", stl, "MALFORMED_FILE", "line 4");
}
