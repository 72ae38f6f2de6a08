//! ZIP archives: materials and images of OBJ, files beside glTF, and hostile archives.

use std::io::Write;

use flate2::{Compression, write::DeflateEncoder};

use super::*;
use crate::{
    io::write_glb,
    mesh::{Material, Semantic, TextureUse, WedgeId, Wrap},
};

/// A file in an archive, with what the archive says of it.
#[derive(Clone)]
pub(super) struct Member {
    name: String,
    method: u16,
    flags: u16,
    size: u32,
    crc: u32,
    data: Vec<u8>,
}

pub(super) fn stored(name: &str, bytes: &[u8]) -> Member {
    let (name, size, crc) = (name.to_owned(), bytes.len() as u32, crc32fast::hash(bytes));
    Member { name, method: 0, flags: 0, size, crc, data: bytes.to_vec() }
}

pub(super) fn deflated(name: &str, bytes: &[u8]) -> Member {
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes).unwrap();
    Member { method: 8, data: encoder.finish().unwrap(), ..stored(name, bytes) }
}

/// The archive, by hand so that it can lie.
pub(super) fn pack(members: &[Member]) -> Vec<u8> {
    let (mut bytes, mut directory) = (Vec::new(), Vec::new());
    for m in members {
        let offset = (bytes.len() as u32).to_le_bytes();
        let short = |n: u16| n.to_le_bytes();
        let common = [
            &short(m.flags)[..],
            &short(m.method),
            &[0; 4],
            &m.crc.to_le_bytes(),
            &(m.data.len() as u32).to_le_bytes(),
            &m.size.to_le_bytes(),
            &short(m.name.len() as u16),
            &[0; 2],
        ]
        .concat();
        let local: [&[u8]; 5] = [b"PK\x03\x04", &[20, 0], &common, m.name.as_bytes(), &m.data];
        bytes.extend(local.concat());
        let central: [&[u8]; 6] =
            [b"PK\x01\x02", &[20, 0, 20, 0], &common, &[0; 10], &offset, m.name.as_bytes()];
        directory.extend(central.concat());
    }
    let n = (members.len() as u16).to_le_bytes();
    let size = (directory.len() as u32).to_le_bytes();
    let begin = (bytes.len() as u32).to_le_bytes();
    bytes.extend(directory);
    bytes.extend([&b"PK\x05\x06"[..], &[0; 4], &n, &n, &size, &begin, &[0; 2]].concat());
    bytes
}

/// Two triangles, the first of material a, the second of material b.
const OBJ: &str = "mtllib My Paint.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0.25 0.75\n\
                   usemtl a\nf 1/1 2/1 3/1\nusemtl b\nf 1/1 3/1 4/1\n";

fn codes(ingest: &Ingest) -> Vec<&'static str> {
    ingest.report.notes.iter().map(|n| n.code).collect()
}

/// [`OBJ`] with a material library, which the archive has in another directory and case.
fn read_obj(mtl: &str, others: &[Member]) -> Ingest {
    let own = [deflated("Model/x.obj", OBJ.as_bytes()), stored("lib/MY PAINT.MTL", mtl.as_bytes())];
    load("a.zip", &pack(&[&own, others].concat())).unwrap()
}

#[test]
fn obj_with_its_materials_and_images() {
    let mtl = "newmtl a\r\nKa 1 1 1\r\nKd 0.5 0.25 1\r\nmap_Kd -s 2 3 -o 0.5 0.25 1 -clamp on \
               C:\\Tex\\red  Brick.png\r\nnewmtl b\nKd 0.5\n";
    let ingest = read_obj(mtl, &[deflated("textures/RED  brick.PNG", &png())]);
    assert_eq!(codes(&ingest), ["read_from_archive"]);
    let mesh = ingest.mesh;
    assert_eq!(mesh.face_materials, [0, 1]);
    assert_eq!(mesh.materials[0].base_color, [0.5, 0.25, 1.0, 1.0]);
    assert_eq!(mesh.materials[1].base_color, [0.5, 0.5, 0.5, 1.0]);
    assert_eq!(mesh.textures[0].wrap, [Wrap::Clamp; 2]);
    assert_eq!(&*mesh.images[0].bytes, &png()[..]);
    assert!(mesh.images[0].pixels.is_some());
    let found = mesh.materials[0].base_texture.unwrap();
    let uv = mesh.layer(Semantic::TexCoord(0)).unwrap().get(WedgeId(0));
    assert_eq!(uv, [0.25, 0.25], "v counts downwards");
    // Upwards it is 3 × 0.75 + 0.25.
    let seen = found.transform.map(|[a, b, c]| a * uv[0] + b * uv[1] + c);
    assert_eq!(seen, [2.0 * 0.25 + 0.5, 1.0 - 2.5]);
    let again = load("a.glb", &write_glb(&mesh).unwrap()).unwrap().mesh;
    assert_eq!(again.materials[0].base_texture, Some(found));
    assert_eq!((again.textures, again.images.len()), (mesh.textures, 1));
}

#[test]
fn what_an_obj_lacks_or_has_besides_is_noted() {
    let mtl = "Kd 1 0 0\nnewmtl a\nKd 0 0 0\nKd spectral x\nd 0.5\nTr 0\nmap_Kd -mm 0 1 gone.png\n\
               bump -bm 1 b.png\nmap_Kd\nnewmtl c\nmap_Kd c.png\n";
    let ingest = read_obj(mtl, &[]);
    let expected = [
        "mtl_line_ignored",
        "alpha_ignored",
        "map_option_ignored",
        "textures_not_evaluated",
        "mtl_line_ignored",
        "image_missing",
        "material_undefined",
        "read_from_archive",
    ];
    assert_eq!(codes(&ingest), expected);
    let text = &ingest.report.notes[0].text;
    assert_eq!(text, "lib/my paint.mtl, line 4: 'Kd spectral x' cannot be read");
    assert_eq!(ingest.mesh.materials[0].base_color[..3], [0.0; 3], "there is no image");
    assert!(ingest.mesh.images.is_empty(), "of materials that are not used nothing is read");
    let alone = load("a.zip", &pack(&[stored("x.obj", OBJ.as_bytes())])).unwrap();
    assert_eq!(alone.report.notes[0].text, "'My' is not in the archive; pack it with the model");
    let ingest =
        read_obj("newmtl a\nKd 0 0 0\nmap_Kd a.png\nnewmtl b\n", &[stored("a.png", &png())]);
    assert_eq!(codes(&ingest), ["black_factor_ignored", "read_from_archive"]);
    let shown = &ingest.mesh.materials[0];
    assert_eq!(shown.base_texture.unwrap().transform, TextureUse::IDENTITY);
    assert_eq!(shown.base_color, [1.0; 4]);
}

/// What a material gives off is kept; what is not evaluated is named where it says anything.
#[test]
fn emission_and_shading_of_obj() {
    let mtl = "newmtl a\nKd 0 0 0\nKe 2 1 0\nKs 0 0 0\nPm 0\nmap_Kd -s 2 3 -o 0.5 0.25 a.png\n\
               newmtl b\nKd 0 0 0\nKe 1\nmap_Ke a.png\nKs 0.5 0 0\nPr 0\n";
    let ingest = read_obj(mtl, &[stored("a.png", &png())]);
    let expected = [
        "textures_not_evaluated",
        "shading_not_evaluated",
        "black_factor_ignored",
        "emission_ignored",
        "read_from_archive",
    ];
    assert_eq!(codes(&ingest), expected);
    let mesh = ingest.mesh;
    let factors = |mesh: &Mesh| -> Vec<_> {
        mesh.materials.iter().map(|m| m.emission().map(|light| light.factor)).collect()
    };
    assert_eq!(factors(&mesh), [Some([2.0, 1.0, 0.0]), None]);
    let again = load("a.glb", &write_glb(&mesh).unwrap()).unwrap().mesh;
    assert_eq!(factors(&again), factors(&mesh));
    let fields = |m: &Material| (m.name.clone(), m.base_color, m.base_texture, m.double_sided);
    assert_eq!(fields(&again.materials[0]), fields(&mesh.materials[0]));
    assert_eq!(mesh.materials[0].source, again.materials[0].source);
}

/// Two triangles of the square, which show the second and the first of two images, and one image that is not there.
#[test]
fn ply_with_its_images() {
    let text = "ply\nformat ascii 1.0\ncomment TextureFile a 1.png\ncomment TextureFile b.png\n\
        comment TextureFile gone.png\nelement vertex 4\nproperty float x\nproperty float y\n\
        property float z\nelement face 2\nproperty list uchar int vertex_indices\n\
        property list uchar float texcoord\nproperty int texnumber\nend_header\n\
        0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2 6 0 0 1 0 1 1 1\n3 0 2 3 6 0 0 1 1 0 1 9\n";
    let other = encoded(ImageFormat::Png, [1, 1], [0; 3]);
    let members = [
        stored("x.ply", text.as_bytes()),
        stored("A 1.png", &png()),
        stored("textures/b.png", &other),
    ];
    let ingest = load("a.zip", &pack(&members)).unwrap();
    assert_eq!(codes(&ingest), ["image_missing", "read_from_archive"]);
    let mesh = ingest.mesh;
    // There is no tenth image.
    assert_eq!(mesh.face_materials, [1, 0]);
    let of = |m: &Material| m.base_texture.map(|at| (at.texture, at.transform));
    let shown: Vec<_> = mesh.materials.iter().map(of).collect();
    let identity = TextureUse::IDENTITY;
    assert_eq!(shown, [Some((0, identity)), Some((1, identity)), None]);
    assert_eq!((&mesh.images[0].bytes[..], &mesh.images[1].bytes[..]), (&png()[..], &other[..]));
    assert_eq!(mesh.n_wedges(), 4);
}

/// A `#` in a name begins no comment, in neither file.
/// The first face has coordinates of its corners, the second takes those of its vertices.
#[test]
fn ply_corners_without_coordinates_have_those_of_their_vertices() {
    let file = |lists: [&str; 2]| {
        let [first, second] = lists;
        let text = format!(
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
             property float s\nproperty float t\nelement face 2\nproperty list uchar int vertex_indices\n\
             property list uchar float texcoord\nend_header\n0 0 0 0.25 1\n1 0 0 0.5 1\n0 1 0 0.75 1\n1 1 0 1 1\n\
             3 0 1 2 {first}\n3 2 1 3 {second}\n"
        );
        let mesh = load("a.ply", text.as_bytes()).unwrap().mesh;
        let layer = mesh.layer(Semantic::TexCoord(0)).unwrap();
        let corners = mesh.face_wedges.as_flattened().iter().map(|w| layer.get(WedgeId(*w))[0]);
        corners.collect::<Vec<_>>()
    };
    assert_eq!(file(["6 .1 0 .2 0 .3 0", "0"]), [0.1, 0.2, 0.3, 0.75, 0.5, 1.0]);
    assert_eq!(file(["0", "0"]), [0.25, 0.5, 0.75, 0.75, 0.5, 1.0]);
}

#[test]
fn names_may_have_number_signs() {
    let obj = OBJ.replace("My Paint.mtl", "Paint #1.mtl");
    let obj = obj.replace("usemtl a", "usemtl Mat #1").replace("usemtl b", "usemtl Mat #2");
    let mtl = "\u{feff}newmtl Mat #1\nKd 1 0 0 # red\nnewmtl Mat #2\nmap_Kd tex #1.png\n";
    let members = [
        stored("x.obj", obj.as_bytes()),
        stored("Paint #1.mtl", mtl.as_bytes()),
        stored("tex #1.png", &png()),
    ];
    let ingest = load("a.zip", &pack(&members)).unwrap();
    assert_eq!(codes(&ingest), ["read_from_archive"]);
    let [red, shown] = &ingest.mesh.materials[..] else { panic!("{:?}", ingest.mesh.materials) };
    assert_eq!((red.base_color, red.base_texture), ([1.0, 0.0, 0.0, 1.0], None));
    assert!(shown.base_texture.is_some());
}

/// Old packs have BMP and TGA, which no GLB may hold.
#[test]
fn images_that_no_glb_may_hold_become_png_or_are_left_out() {
    let picture = image::RgbImage::from_fn(3, 2, |x, y| image::Rgb([x as u8, y as u8, 9]));
    let saved = |format| {
        let mut bytes = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    };
    for (name, bytes) in
        [("a.bmp", saved(image::ImageFormat::Bmp)), ("A.TGA", saved(image::ImageFormat::Tga))]
    {
        let ingest = read_obj(&format!("newmtl a\nmap_Kd {name}\n"), &[stored(name, &bytes)]);
        let [found] = &ingest.mesh.images[..] else { panic!("{name}: {:?}", ingest.report) };
        assert_eq!(found.mime, "image/png");
        assert_eq!(image::load_from_memory(&found.bytes).unwrap().into_rgb8(), picture, "{name}");
        assert_eq!(found.pixels.as_ref().map(|p| (p.width, p.height)), Some((3, 2)));
        let again = load("x.glb", &write_glb(&ingest.mesh).unwrap()).unwrap();
        assert_eq!(again.mesh.images[0].mime, "image/png");
    }
    // Says that it is 16,384 pixels wide and high.
    let mut huge = saved(image::ImageFormat::Bmp);
    huge[18..26].copy_from_slice([16_384_u32.to_le_bytes(); 2].as_flattened());
    for (name, bytes) in
        [("a.gif", &b"GIF89a"[..]), ("a.tga", b"no"), ("a.png", b"nothing"), ("a.bmp", &huge)]
    {
        let ingest = read_obj(&format!("newmtl a\nmap_Kd {name}\n"), &[stored(name, bytes)]);
        assert!(ingest.mesh.images.is_empty() && ingest.mesh.textures.is_empty(), "{name}");
        assert!(codes(&ingest).contains(&"image_unreadable"), "{name}: {:?}", codes(&ingest));
    }
}

/// Directories decide where the name alone does not; those that lead outside lead nowhere.
#[test]
fn namesakes_are_told_apart() {
    let other = encoded(ImageFormat::Png, [1, 1], [0; 3]);
    let images = [stored("one/a.png", &png()), stored("two/a.png", &other)];
    for (name, expected) in [("two/a.png", 1), ("a.png", 0), ("../../one/A.PNG", 0)] {
        let mtl = format!("newmtl a\nmap_Kd {name}\nnewmtl b\nmap_Kd {name}\n");
        let mesh = read_obj(&mtl, &images).mesh;
        assert_eq!(mesh.images[0].bytes[..], images[expected].data[..], "{name}");
        assert_eq!(mesh.textures.len(), 1);
    }
}

#[test]
fn gltf_with_its_buffers_and_images() {
    let mut json = square_json();
    json["buffers"][0]["uri"] = "data%20of/the%20square.bin".into();
    json["images"] = json!([{ "uri": "../a.png" }, { "uri": "b.png" }]);
    json["textures"] = json!([{ "source": 0 }]);
    json["materials"] = json!([{ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }]);
    json["meshes"][0]["primitives"][0]["material"] = 0.into();
    let files = [
        stored("__MACOSX/._square.gltf", b"?"),
        deflated("s/square.gltf", json.to_string().as_bytes()),
        deflated("s/data of/The Square.bin", &square_bin()),
        stored("s/a.png", &png()),
    ];
    let ingest = load("a.zip", &pack(&files)).unwrap();
    assert_eq!(codes(&ingest), ["image_missing", "read_from_archive"]);
    assert!(ingest.mesh.images[0].pixels.is_some());
    assert_eq!(ingest.mesh.faces, load("a.glb", &square_glb()).unwrap().mesh.faces);
    let text =
        load("a.zip", &pack(&[stored("a.glb", &square_glb())])).unwrap().report.notes[0].clone();
    assert_eq!(text.text, "'a.glb' in the archive is read as GLB");
}

#[track_caller]
fn check_members(members: &[Member], code: &str, says: &str) {
    let error = error_of("a.zip", &pack(members));
    let text = error.to_string();
    assert_eq!(error.code(), code, "{text}");
    assert!(text.starts_with("a.zip") && text.contains(says), "'{text}' does not say '{says}'");
}

#[test]
fn archives_that_cannot_be_read() {
    let obj = stored("x.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    let changed = |change: fn(&mut Member)| {
        let mut member = deflated("x.obj", &obj.data);
        change(&mut member);
        [member]
    };
    check_members(&[], "MALFORMED_FILE", "it holds no .glb");
    check_members(&[stored("x.txt", b"v")], "MALFORMED_FILE", "it holds no .glb");
    let two = [obj.clone(), stored("y.stl", b"")];
    check_members(&two, "MALFORMED_FILE", "it holds 2 models, x.obj, y.stl among them");
    check_members(&[stored("x.obj", b"")], "EMPTY_FILE", "a.zip/x.obj: the file is empty");
    let bad = [stored("x.obj", b"v 0 0 0\nf 1 2 3\n")];
    check_members(&bad, "INDEX_OUT_OF_RANGE", "a.zip/x.obj: line 2");
    let nested = [stored("x.obj", &pack(std::slice::from_ref(&obj)))];
    check_members(&nested, "UNSUPPORTED_FEATURE", "an archive in an archive");
    let password = changed(|m| m.flags = 1);
    check_members(&password, "UNSUPPORTED_FEATURE", "without a password");
    let method = changed(|m| m.method = 12);
    check_members(&method, "UNSUPPORTED_FEATURE", "'x.obj' in the archive");
    for change in [
        (|m| m.crc ^= 1) as fn(&mut Member),
        |m| m.size += 1,
        |m| m.size -= 1,
        |m| m.size = 0,
        |m| m.data.truncate(9),
        |m| m.data[0] = 7,
    ] {
        check_members(&changed(change), "MALFORMED_FILE", "it cannot be unpacked");
    }
    let whole = pack(&[obj]);
    for cut in [4, 30, whole.len() - 1] {
        assert_eq!(error_of("a.zip", &whole[..cut]).code(), "MALFORMED_FILE", "{cut}");
    }
}

#[test]
fn bombs_are_refused_before_they_go_off() {
    let spaces = vec![b' '; 16 << 20];
    let bomb = deflated("x.obj", &spaces);
    assert!(bomb.data.len() < spaces.len() / 1000);
    check_members(
        std::slice::from_ref(&bomb),
        "OVER_LIMIT",
        "16777216 unpacked bytes are over the limit",
    );
    // One that says it is small ends where it said.
    let quiet = Member { size: 1000, ..bomb };
    check_members(&[quiet], "MALFORMED_FILE", "it cannot be unpacked");
    // What each file may have is what all have together.
    let mut mtl = String::new();
    let mut members =
        vec![deflated("x.obj", b"mtllib x.mtl\nv 0 0 0\nusemtl 0\nusemtl 1\nusemtl 2")];
    for i in 0..3 {
        mtl = format!("{mtl}newmtl {i}\nmap_Kd {i}.png\n");
        members.push(deflated(&format!("{i}.png"), &spaces[..800_000]));
    }
    members.push(deflated("x.mtl", mtl.as_bytes()));
    check_members(&members, "OVER_LIMIT", "'2.png' in the archive");
    let many: Vec<Member> = (0..4097).map(|i| stored(&format!("{i}"), b"")).collect();
    check_members(&many, "OVER_LIMIT", "4097 files are over the limit of 4096");
    let limits = Limits { max_bytes: 400, ..Limits::default() };
    let error = read("a.zip", &pack(&[deflated("x.obj", &spaces[..401])]), &limits).unwrap_err();
    assert_eq!(error.code(), "OVER_LIMIT", "{error}");
}
