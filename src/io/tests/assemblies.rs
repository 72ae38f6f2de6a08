//! Parts and the tree of nodes: read, written, and what is left of them.

use super::*;
use crate::{
    io::{GlbLevel, GlbOptions, write_glb, write_lods},
    mesh::{FaceId, Node, Part},
};

/// The JSON chunk of a GLB.
pub(super) fn json_of(glb: &[u8]) -> Value {
    let n = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&glb[20..20 + n]).unwrap()
}

/// A ship that has a hull and, on a mast, two sails, one of them without a name; a lamp without
/// triangles; a buoy beside the ship. All show the square.
pub(super) fn ship() -> Vec<u8> {
    let mut json = square_json();
    json["scenes"] = json!([{ "nodes": [6, 0] }]);
    json["nodes"] = json!([
        { "name": "ship", "children": [1, 3, 5], "translation": [10, 0, 0] },
        { "name": "mast", "children": [2, 4], "scale": [2, 2, 2] },
        { "name": "sail \"1\"", "mesh": 0 },
        { "name": "hull", "mesh": 0, "translation": [0, 0, -1] },
        { "mesh": 0, "translation": [0, 1, 0] },
        { "name": "lamp" },
        { "name": "buoy", "mesh": 0 },
    ]);
    glb(&json, &square_bin())
}

fn node(name: &str, parent: Option<u32>) -> Node {
    Node { name: name.to_owned(), parent, transform: None }
}

#[test]
fn nodes_are_kept_by_name() {
    let Ingest { mesh, report, .. } = load("ship.glb", &ship()).unwrap();
    // Depth first, in the order of the file.
    let nodes = [
        node("buoy", None),
        node("ship", None),
        node("mast", Some(1)),
        node("sail \"1\"", Some(2)),
        node("", Some(2)),
        node("hull", Some(1)),
        node("lamp", Some(1)),
    ];
    assert_eq!(mesh.tree.nodes, nodes);
    let part = |node| Part { node, mesh: "square".to_owned(), skin: None };
    assert_eq!(mesh.tree.parts, [0, 3, 4, 5].map(part));
    assert_eq!(mesh.face_parts, [0, 0, 1, 1, 2, 2, 3, 3]);
    let names = [0, 1, 2, 3, 4].map(|part| mesh.tree.part_name(part));
    assert_eq!(names, ["buoy", "sail \"1\"", "square", "hull", "part 4"]);
    assert_eq!((report.nodes, report.parts, report.instances), (7, 4, 4));
    // The sails touch: points are joined across parts.
    assert_eq!(report.vertices, 4 * 4 - 2);
}

#[test]
fn every_part_is_a_node_in_its_place() {
    let mesh = load("ship.glb", &ship()).unwrap().mesh;
    let bytes = write_glb(&mesh).unwrap();
    let json = json_of(&bytes);
    // The lamp is left out, and so are the transforms.
    let nodes = json!([
        { "name": "buoy", "mesh": 0 },
        { "name": "ship", "children": [2, 5] },
        { "name": "mast", "children": [3, 4] },
        { "name": "sail \"1\"", "mesh": 1 },
        { "mesh": 2 },
        { "name": "hull", "mesh": 3 },
    ]);
    assert_eq!((&json["nodes"], &json["scenes"]), (&nodes, &json!([{ "nodes": [0, 1] }])));
    assert!(json["meshes"].as_array().unwrap().iter().all(|m| m["name"] == "square"));
    let again = load("ship.glb", &bytes).unwrap().mesh;
    assert_eq!((&again.positions, &again.face_parts), (&mesh.positions, &mesh.face_parts));
    assert_eq!(write_glb(&again).unwrap(), bytes, "nothing is left to change");
}

/// The names of the nodes that are left when only the triangles of these parts are.
#[track_caller]
fn check_left(parts: &[u32], names: &[&str]) {
    let mesh = load("ship.glb", &ship()).unwrap().mesh;
    let faces = (0..mesh.faces.len() as u32).map(FaceId);
    let left = mesh.subset(faces.filter(|f| parts.contains(&mesh.part_of(*f))).collect()).mesh;
    let sizes: Vec<u32> = (0..4).map(|part| if parts.contains(&part) { 2 } else { 0 }).collect();
    assert_eq!(left.part_sizes(), sizes);
    let json = json_of(&write_glb(&left).unwrap());
    let name = |node: &Value| node.get("name").map_or("", |name| name.as_str().unwrap()).to_owned();
    let found: Vec<_> = json["nodes"].as_array().unwrap().iter().map(name).collect();
    assert_eq!(found, names, "{parts:?}");
    assert_eq!(json["meshes"].as_array().unwrap().len(), parts.len());
}

#[test]
fn nodes_that_lead_to_no_triangle_go() {
    check_left(&[0], &["buoy"]);
    check_left(&[2], &["ship", "mast", ""]);
    check_left(&[0, 3], &["buoy", "ship", "hull"]);
}

/// Without names there is nothing to keep: as if the format had no nodes.
#[test]
fn a_node_without_names_costs_nothing() {
    let mut json = square_json();
    json["meshes"][0].as_object_mut().unwrap().remove("name");
    let Ingest { mesh, report, .. } = load("a.glb", &glb(&json, &square_bin())).unwrap();
    assert!(mesh.tree.nodes.is_empty() && mesh.tree.parts.is_empty() && mesh.face_parts.is_empty());
    assert_eq!((report.nodes, report.parts), (0, 1));
    let json = json_of(&write_glb(&mesh).unwrap());
    assert_eq!(json["nodes"], json!([{ "mesh": 0 }]));
}

/// A tree from elsewhere may name nodes twice or not at all: the triangles are written all the same.
#[test]
fn broken_trees_are_written_flat() {
    let mut mesh = load("ship.glb", &ship()).unwrap().mesh;
    let tree = std::sync::Arc::make_mut(&mut mesh.tree);
    (tree.parts[0].node, tree.parts[1].node) = (99, 4);
    tree.nodes[4].parent = Some(5);
    let json = json_of(&write_glb(&mesh).unwrap());
    // Parts 1 and 2 share a node, part 0 has none, and node 4 is below one that comes later.
    let nodes = json!([
        { "name": "ship", "children": [2] },
        { "mesh": 1 },
        { "name": "hull", "mesh": 3 },
        { "mesh": 0 },
        { "mesh": 2 },
    ]);
    assert_eq!((&json["nodes"], &json["scenes"][0]["nodes"]), (&nodes, &json!([0, 1, 3, 4])));
    let again = load("ship.glb", &write_glb(&mesh).unwrap()).unwrap().mesh;
    assert_eq!(again.faces.len(), mesh.faces.len());
    mesh.face_parts[0] = 4;
    assert!(write_glb(&mesh).unwrap_err().to_string().contains("a part that is not there"));
}

/// The scene shows the finest level, which names the others; materials and images are there once.
#[test]
fn levels_share_a_file() {
    let fine = load("a.glb", &textured_glb(&[png()], |_| {})).unwrap().mesh;
    let coarse = fine.subset(vec![FaceId(1)]).mesh;
    let level = |name, mesh, screen_coverage| GlbLevel { name, mesh, screen_coverage };
    let levels = [level("lod-1", &fine, 0.25), level("lod-0", &coarse, 0.0)];
    for options in [GlbOptions::default(), GlbOptions { compress: true, quantize: false }] {
        let bytes = write_lods(&levels, options).unwrap();
        let json = json_of(&bytes);
        let top = &json["nodes"][1];
        assert_eq!(json["scenes"], json!([{ "nodes": [1] }]));
        assert_eq!((&top["name"], &top["children"]), (&json!("lod-1"), &json!([0])));
        assert_eq!(top["extensions"]["MSFT_lod"]["ids"], json!([3]));
        assert_eq!(top["extras"]["MSFT_screencoverage"], json!([0.25, 0.0]));
        assert_eq!(
            (&json["nodes"][3]["name"], &json["nodes"][3]["children"]),
            (&json!("lod-0"), &json!([2]))
        );
        let count = |list: &str| json[list].as_array().unwrap().len();
        assert_eq!(["meshes", "materials", "textures", "images"].map(count), [2, 1, 1, 1]);
        let used = json["extensionsUsed"].as_array().unwrap();
        assert!(used.contains(&json!("MSFT_lod")));
        let required =
            json.get("extensionsRequired").map_or(0, |list| list.as_array().unwrap().len());
        assert_eq!(required, if options.compress { 2 } else { 0 });
        let again = load("lods.glb", &bytes).unwrap();
        assert_eq!(again.mesh.faces.len(), fine.faces.len());
        assert_eq!(
            again.report.notes.iter().map(|n| n.code).collect::<Vec<_>>(),
            ["levels_ignored"]
        );
    }
    assert!(write_lods(&[], GlbOptions::default()).is_err());
    let alone = json_of(&write_lods(&levels[..1], GlbOptions::default()).unwrap());
    assert!(alone["nodes"][1].get("extensions").is_none() && alone.get("extensionsUsed").is_none());
}
