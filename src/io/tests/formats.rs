//! PLY, OBJ and STL in their variants, each against the same square.

use glam::DVec3;

use super::*;
use crate::mesh::{Semantic, WedgeId};

const PLY_PROPERTIES: &str = "comment x\nelement vertex 4\nproperty uchar flags\n\
    property double x\nproperty float y\nproperty short z\nproperty list uchar int extra\n\
    property uchar red\nproperty uchar green\nproperty uchar blue\n\
    element edge 1\nproperty int vertex1\n\
    element face 1\nproperty uchar kind\nproperty list uchar uint vertex_index\nend_header\n";

fn ply(encoding: &str, body: &[u8]) -> Vec<u8> {
    let head = format!("ply\nformat {encoding} 1.0\n{PLY_PROPERTIES}");
    [head.as_bytes(), body].concat()
}

/// The rows of the square as one polygon, in the order of [`PLY_PROPERTIES`].
fn ply_binary(big: bool) -> Vec<u8> {
    let mut body = Vec::new();
    let mut push = |le: &[u8]| {
        let mut bytes = le.to_vec();
        if big {
            bytes.reverse();
        }
        body.extend(bytes);
    };
    for [x, y] in [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0_f32]] {
        push(&[9]);
        push(&f64::from(x).to_le_bytes());
        push(&y.to_le_bytes());
        push(&(-2_i16).to_le_bytes());
        push(&[1]);
        push(&5_i32.to_le_bytes());
        for c in [255, 0, 188] {
            push(&[c]);
        }
    }
    push(&3_i32.to_le_bytes());
    push(&[1]);
    push(&[4]);
    (0..4_u32).for_each(|i| push(&i.to_le_bytes()));
    body
}

#[test]
fn ply_in_three_encodings() {
    let ascii = "9 0 0 -2 1 5 255 0 188\n9 1 0 -2 1 5 255 0 188\r\n9 1 1 -2 1 5\n255 0 188\n\
                 9 0 1 -2 1 5 255 0 188\n3\n1 4 0 1 2 3";
    let files = [
        ply("ascii", ascii.as_bytes()),
        ply("binary_little_endian", &ply_binary(false)),
        ply("binary_big_endian", &ply_binary(true)),
    ];
    for file in files {
        let Ingest { mesh, report, .. } = load("a.ply", &file).unwrap();
        assert_eq!(mesh.faces, vec![[0, 1, 2], [0, 2, 3]]);
        assert_eq!(mesh.positions[2], DVec3::new(1.0, 1.0, -2.0));
        let color = mesh.layer(Semantic::Color(0)).unwrap().get(WedgeId(0));
        assert_eq!(color[..2], [1.0, 0.0]);
        assert!((color[2] - 0.503).abs() < 1e-3, "sRGB 188 is about half the light");
        assert_eq!(color[3], 1.0);
        let codes: Vec<_> = report.notes.iter().map(|n| n.code).collect();
        let ignored = "property_ignored";
        assert_eq!(codes, [ignored, ignored, "element_ignored", ignored]);
        assert_eq!(report.notes[3].text, "face property 'kind' is not carried");
    }
}

#[test]
fn ply_strips_and_coordinates() {
    let text = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n\
        property float z\nproperty float nx\nproperty float ny\nproperty float nz\n\
        property float s\nproperty float t\nelement tristrips 1\n\
        property list int int vertex_indices\nend_header\n\
        0 0 0 0 0 1 0 0\n1 0 0 0 0 1 1 0\n0 1 0 0 0 0 0 1\n1 1 0 0 0 1 1 1\n\
        8 0 1 2 3 -1 0 1 3\n";
    let mesh = load("a.ply", text.as_bytes()).unwrap().mesh;
    assert_eq!(mesh.faces, vec![[0, 1, 2], [2, 1, 3], [0, 1, 3]]);
    assert_eq!(mesh.layer(Semantic::TexCoord(0)).unwrap().get(WedgeId(2)), &[0.0, 0.0]);
    let normal = mesh.layer(Semantic::Normal).unwrap().get(WedgeId(2));
    assert_eq!(normal, &[0.0, 0.0, 1.0], "a zero normal is computed");
}

/// A quad with negative indices, coordinates on some faces only, two materials and a line that
/// continues.
#[test]
fn obj_polygons_materials_and_attributes() {
    let text = "# square\nmtllib x.mtl\no thing\nv 0 0 0\nv 1 0 0 \nv 1 1 0\nv 0 1 0\r\n\
        vt 0 0\nvt 1 0.25\nvn 0 0 2\nf -4 -3 -2 \\\n -1\nusemtl red paint\nf 1/1/1 2/2/1 3//1\n\
        usemtl blue\nf 2 3 4\nusemtl red paint\nf 1 2 4\nl 1 2\nf 1 2\n";
    let Ingest { mesh, report, .. } = load("dir/a.OBJ", text.as_bytes()).unwrap();
    assert_eq!(mesh.faces, vec![[0, 1, 2], [0, 2, 3], [0, 1, 2], [1, 2, 3], [0, 1, 3]]);
    assert_eq!(mesh.face_materials, [0, 0, 1, 2, 1]);
    let names: Vec<_> = mesh.materials.iter().map(|m| m.name.as_str()).collect();
    assert_eq!(names, ["", "red paint", "blue"]);
    let wedge = WedgeId(mesh.face_wedges[2][1]);
    assert_eq!(mesh.layer(Semantic::TexCoord(0)).unwrap().get(wedge), &[1.0, 0.75]);
    assert_eq!(mesh.layer(Semantic::Normal).unwrap().get(wedge), &[0.0, 0.0, 2.0]);
    let plain = WedgeId(mesh.face_wedges[0][1]);
    assert_eq!(mesh.layer(Semantic::Normal).unwrap().get(plain), &[0.0, 0.0, 1.0]);
    let codes: Vec<_> = report.notes.iter().map(|n| n.code).collect();
    assert_eq!(codes, ["mtllib_ignored", "short_faces"]);
}

/// A byte-order mark, comments that end with a backslash, and a last line that does.
#[test]
fn obj_comments_and_marks() {
    let text = "\u{feff}v 0 0 0 # at c:\\here\\\nv 1 0 0#x\n # C:\\models\\\nv 0 1 0\n\
        usemtl Mat #1\nf 1 2 3 # one\nusemtl Mat #2\nv 1 1 0\nf 2 \\\n4 3 \\";
    let Ingest { mesh, .. } = load("a.obj", text.as_bytes()).unwrap();
    assert_eq!(mesh.faces, vec![[0, 1, 2], [1, 3, 2]]);
    let names: Vec<_> = mesh.materials.iter().map(|m| m.name.as_str()).collect();
    assert_eq!(names, ["Mat #1", "Mat #2"]);
    assert_eq!(mesh.face_materials, [0, 1]);
}

/// An L, from OBJ and from PLY whose vertices come before and after its polygon: it is covered once.
#[test]
fn concave_polygons() {
    let corners = "4 0 0\n4 1 0\n1 1 0\n1 4 0\n0 4 0\n0 0 0\n";
    let lines = corners.trim_end().replace('\n', "\nv ");
    let obj = format!("v {lines}\nf 1 2 3 4 5 6\n");
    let vertex = "element vertex 6\nproperty float x\nproperty float y\nproperty float z\n";
    let face = "element face 1\nproperty list uchar int vertex_indices\n";
    let (head, row) = ("ply\nformat ascii 1.0\n", "6 0 1 2 3 4 5\n");
    let before = format!("{head}{vertex}{face}end_header\n{corners}{row}");
    let after = format!("{head}{face}{vertex}end_header\n{row}{corners}");
    for (name, text) in [("a.obj", obj), ("a.ply", before), ("a.ply", after)] {
        let mesh = load(name, text.as_bytes()).unwrap().mesh;
        let areas = mesh.faces.iter().map(|t| {
            let [a, b, c] = t.map(|v| mesh.positions[v as usize]);
            (b - a).cross(c - a).z / 2.0
        });
        assert!(areas.clone().all(|area| area > 0.0), "{:?}", mesh.faces);
        assert_eq!((mesh.faces.len(), areas.sum::<f64>()), (4, 7.0));
    }
}

/// An L as one polygon, a triangle that has other coordinates at one of its corners, and one that has none and takes
/// those of the vertices, which give way elsewhere.
#[test]
fn ply_coordinates_of_corners() {
    let head = "ply\nformat ascii 1.0\ncomment TextureFile a.png\nelement vertex 7\n\
        property float x\nproperty float y\nproperty float z\nproperty uchar lock\n\
        property float s\nproperty float t\nelement face 3\nproperty list uchar float texcoord\n\
        property list uchar int vertex_indices\nproperty int texnumber\nend_header\n";
    let outline = [[4, 0], [4, 1], [1, 1], [1, 4], [0, 4], [0, 0]];
    let rows: Vec<String> = outline.iter().map(|[x, y]| format!("{x} {y} 0 0 9 9\n")).collect();
    let uvs: Vec<String> = outline.iter().map(|[x, y]| format!("{x} {y} ")).collect();
    let (rows, uvs) = (rows.concat(), uvs.concat());
    let text = format!(
        "{head}{rows}9 9 0 1 9 9\n12 {uvs}6 0 1 2 3 4 5 0\n6 8 8 4 1 9 9 3 0 1 6 0\n0 3 1 3 6 0\n"
    );
    let Ingest { mesh, marks, report } = load("a.ply", text.as_bytes()).unwrap();
    let layer = mesh.layer(Semantic::TexCoord(0)).unwrap();
    for (face, wedges) in mesh.faces.iter().zip(&mesh.face_wedges).take(4) {
        for (vertex, wedge) in face.iter().zip(wedges) {
            let p = mesh.positions[*vertex as usize];
            assert_eq!(layer.get(WedgeId(*wedge)), &[p.x as f32, 1.0 - p.y as f32]);
        }
    }
    assert_eq!(layer.get(WedgeId(mesh.face_wedges[4][0])), &[8.0, -7.0]);
    // Six of the L; two of the next triangle, which has those of the L at vertex 1; two of the last one, whose third
    // has the same as the next one's.
    assert_eq!(mesh.n_wedges(), 6 + 2 + 2);
    assert_eq!(layer.get(WedgeId(mesh.face_wedges[5][0])), &[9.0, -8.0]);
    assert_eq!(mesh.faces.len(), 6);
    assert_eq!(marks.locked.iter().filter(|locked| **locked).count(), 1);
    let codes: Vec<_> = report.notes.iter().map(|n| n.code).collect();
    assert_eq!(codes, ["texcoord_filled", "texture_files_ignored"]);
}

#[test]
fn obj_vertex_colours() {
    let text = "v 0 0 0\nv 1 0 0 1 0 0\nv 0 1 0 0 1 0\nv 2 2 2\nf 1 2 3\n";
    let mesh = load("a.obj", text.as_bytes()).unwrap().mesh;
    let colors = mesh.layer(Semantic::Color(0)).unwrap();
    assert_eq!(colors.get(WedgeId(0)), &[1.0; 4]);
    assert_eq!(colors.get(WedgeId(1)), &[1.0, 0.0, 0.0, 1.0]);
}

#[test]
fn stl_in_both_kinds() {
    let facets =
        [[[0., 0., 0.], [1., 0., 0.], [1., 1., 0.]], [[0., 0., 0.], [1., 1., 0.], [0., 1., 0.]]];
    let mut text = "solid square\n".to_owned();
    let mut binary = b"solid but binary".to_vec();
    binary.resize(80, b' ');
    binary.extend(2_u32.to_le_bytes());
    for facet in facets {
        text += "facet normal 0 0 1\n outer loop\n";
        binary.extend(bytes_of(&[0.0; 3]));
        for [x, y, z] in facet {
            text = format!("{text}  vertex {x} {y} {z}\r\n");
            binary.extend(bytes_of(&[x, y, z]));
        }
        text += " endloop\nendfacet\n";
        binary.extend([0, 0]);
    }
    text += "endsolid square\n";
    let from_text = load("a.stl", text.as_bytes()).unwrap().mesh;
    assert_eq!(from_text.faces, vec![[0, 1, 2], [0, 2, 3]]);
    assert_eq!(load("a.stl", &binary).unwrap().mesh, from_text);
    assert_eq!(load("unnamed", &binary).unwrap().report.notes[0].code, "format_by_content");
    let capitals = format!("\u{feff}\n {}", text.to_ascii_uppercase());
    assert_eq!(load("a.stl", capitals.as_bytes()).unwrap().mesh, from_text);
    let longer = load("a.stl", &[&binary[..], b"facet"].concat()).unwrap();
    assert_eq!((longer.mesh, longer.report.notes[0].code), (from_text, "trailing_bytes"));
    let shorter = error_of("a.stl", &binary[..binary.len() - 1]);
    assert!(shorter.to_string().contains("2 binary facets: 184 bytes are needed but 183 are"));
    let cut = text.replace("  vertex 0 1 0\r\n", "");
    assert!(error_of("a.stl", cut.as_bytes()).to_string().contains("2 vertices instead of 3"));
}

/// Point 4 coincides with point 0, which is not locked and matters less; point 3 is of no triangle.
#[test]
fn ply_locks_and_weights() {
    let text = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n\
        property float z\nproperty uchar lock\nproperty float weight\nelement face 2\n\
        property list uchar int vertex_indices\nend_header\n\
        0 0 0 0 0.5\n1 0 0 2 99\n0 1 0 0 nan\n5 5 5 1 1\n0 0 0 1 3\n3 0 1 2\n3 4 2 1\n";
    let Ingest { mesh, marks, report } = load("a.ply", text.as_bytes()).unwrap();
    assert_eq!(mesh.positions.len(), 3);
    assert_eq!((marks.locked, marks.weights), (vec![true, true, false], vec![3.0, 16.0, 1.0]));
    let codes: Vec<_> = report.notes.iter().map(|n| n.code).collect();
    assert_eq!(codes, ["weight_clamped"]);
}
