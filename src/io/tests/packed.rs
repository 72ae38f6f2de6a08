//! Draco geometry and KTX2 images that the formats' own encoders have written (`fixtures/README.md`).

use super::*;
use crate::{io::write_glb, mesh::Semantic};

const PLAIN: &[u8] = include_bytes!("fixtures/plain.glb");
const DRACO: [&[u8]; 2] = [
    include_bytes!("fixtures/draco_edgebreaker.glb"),
    include_bytes!("fixtures/draco_sequential.glb"),
];
const KTX2: [&[u8]; 2] =
    [include_bytes!("fixtures/etc1s.ktx2"), include_bytes!("fixtures/uastc.ktx2")];

/// A damaged file's start: any of the above.
pub(super) fn seeds() -> Vec<(&'static str, Vec<u8>)> {
    let ktx2 = KTX2.map(|bytes| ("a.glb", ktx2_glb(bytes.to_vec())));
    DRACO.map(|bytes| ("a.glb", bytes.to_vec())).into_iter().chain(ktx2).collect()
}

fn ktx2_glb(image: Vec<u8>) -> Vec<u8> {
    textured_glb(&[image], |json| {
        json["extensionsRequired"] = json!(["KHR_texture_basisu"]);
        json["textures"] = json!([{ "extensions": { "KHR_texture_basisu": { "source": 0 } } }]);
    })
}

/// The corners of all triangles with all they have, in an order that no encoder changes.
fn corners(mesh: &Mesh) -> Vec<Vec<f64>> {
    let mut corners = Vec::new();
    for (face, wedges) in mesh.faces.iter().zip(&mesh.face_wedges) {
        for (v, w) in face.iter().zip(wedges) {
            let mut corner = mesh.positions[*v as usize].to_array().to_vec();
            for layer in &mesh.layers {
                let values = &layer.values[*w as usize * layer.width..][..layer.width];
                corner.extend(values.iter().map(|v| f64::from(*v)));
            }
            corners.push(corner);
        }
    }
    let key = |corner: &Vec<f64>| (corner[0] * 6.0).round() * 10.0 + (corner[1] * 6.0).round();
    corners.sort_by(|a, b| key(a).total_cmp(&key(b)));
    corners
}

#[test]
fn draco_geometry_is_what_was_compressed() {
    let expected = load("a.glb", PLAIN).unwrap().mesh;
    assert!(expected.layer(Semantic::Color(0)).is_some());
    for bytes in DRACO {
        let found = load("a.glb", bytes).unwrap().mesh;
        assert_eq!((found.faces.len(), found.positions.len()), (72, 49));
        assert_eq!(found.layers.len(), expected.layers.len());
        for (a, b) in corners(&found).iter().zip(&corners(&expected)) {
            // 14 bits of a square of side 1; normals have 10 bits.
            for (k, (a, b)) in a.iter().zip(b).enumerate() {
                let tolerance = if k < 3 { 4e-5 } else { 4e-3 };
                assert!((a - b).abs() < tolerance, "component {k}: {a} instead of {b}");
            }
        }
    }
}

#[test]
fn damaged_draco_data_is_named() {
    for bytes in DRACO {
        let mut damaged = bytes.to_vec();
        let start = bytes.windows(5).position(|five| five == b"DRACO").unwrap();
        damaged[start + 11..][..64].fill(0xff);
        let error = error_of("a.glb", &damaged).to_string();
        assert!(error.contains("primitive 0, Draco data"), "{error}");
        let limits = Limits { max_triangles: 71, ..Limits::default() };
        let error = read("a.glb", bytes, &limits).err().unwrap().to_string();
        assert!(error.contains("71"), "{error}");
    }
}

#[test]
fn ktx2_images_are_drawn_and_carried() {
    for (bytes, tolerance) in KTX2.into_iter().zip([8, 4]) {
        let Ingest { mesh, report, .. } = load("a.glb", &ktx2_glb(bytes.to_vec())).unwrap();
        assert!(report.notes.is_empty(), "{:?}", report.notes);
        let pixels = mesh.images[0].pixels.as_ref().unwrap();
        assert_eq!((pixels.width, pixels.height), (16, 8));
        for (i, found) in pixels.rgba.as_chunks::<4>().0.iter().enumerate() {
            let (x, y) = (i as i32 % 16, i as i32 / 16);
            let expected = [60 * (x / 4), 200 * (y / 4), 128, if x < 8 { 255 } else { 128 }];
            for (found, expected) in found.iter().zip(expected) {
                assert!((i32::from(*found) - expected).abs() <= tolerance, "{x} {y}: {found}");
            }
        }
        let written = write_glb(&mesh).unwrap();
        let again = load("a.glb", &written).unwrap().mesh;
        assert_eq!(&*again.images[0].bytes, bytes);
        assert!(String::from_utf8_lossy(&written).contains("KHR_texture_basisu"));
    }
}

#[test]
fn damaged_ktx2_images_are_named() {
    let sized = |width: u32| {
        let mut bytes = KTX2[0].to_vec();
        bytes[20..24].copy_from_slice(&width.to_le_bytes());
        bytes
    };
    // As much room as that would be made for the level.
    let unpacked_to = |size: u64| {
        let mut bytes = KTX2[1].to_vec();
        bytes[96..104].copy_from_slice(&size.to_le_bytes());
        bytes
    };
    for (bytes, said) in [
        (KTX2[0][..24].to_vec(), "header is cut off"),
        (KTX2[0][..100].to_vec(), "it is damaged"),
        (sized(u32::MAX), "over the limit of 16384"),
        (sized(0), "it is damaged"),
        (unpacked_to(129), "its 16 × 8 pixels take 129 bytes, it says"),
        (unpacked_to(u64::MAX), "its 16 × 8 pixels take 18446744073709551615 bytes"),
    ] {
        let report = load("a.glb", &ktx2_glb(bytes)).unwrap().report;
        let text: Vec<_> = report.notes.iter().map(|n| (n.code, n.text.as_str())).collect();
        assert!(text.iter().any(|(c, t)| *c == "image_unreadable" && t.contains(said)), "{text:?}");
    }
}
