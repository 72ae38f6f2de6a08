//! Images: what is decoded, what is refused, and what is said about it.

use std::io::Cursor;

use image::{ImageBuffer, ImageFormat, Luma, LumaA, Rgba};

use super::*;
use crate::{io::Note, mesh::Pixels};

/// The square with one image, read under the given limits.
fn read_with(image: Vec<u8>, limits: &Limits) -> (Option<Pixels>, Vec<Note>) {
    let bytes = textured_glb(std::slice::from_ref(&image), |_| {});
    let ingest = read("a.glb", &bytes, limits).unwrap();
    let read = &ingest.mesh.images[0];
    assert_eq!(&*read.bytes, &image[..], "the bytes stay");
    (read.pixels.as_ref().map(|pixels| (**pixels).clone()), ingest.report.notes)
}

/// The pixels of an image without notes.
#[track_caller]
fn check(image: Vec<u8>, [width, height]: [u32; 2], first: [u8; 4], tolerance: u8) {
    let (pixels, notes) = read_with(image, &Limits::default());
    let pixels = pixels.unwrap();
    assert_eq!((notes, pixels.width, pixels.height), (Vec::new(), width, height));
    assert_eq!(pixels.rgba.len(), 4 * (width * height) as usize);
    let near = pixels.rgba.iter().zip(first).all(|(a, b)| a.abs_diff(b) <= tolerance);
    assert!(near, "{:?}", &pixels.rgba[..4]);
}

fn bytes<P: image::PixelWithColorType>(pixel: P) -> Vec<u8>
where
    [P::Subpixel]: image::EncodableLayout,
{
    let mut bytes = Cursor::new(Vec::new());
    ImageBuffer::from_pixel(2, 5, pixel).write_to(&mut bytes, ImageFormat::Png).unwrap();
    bytes.into_inner()
}

#[test]
fn every_kind_of_pixel_becomes_four_bytes() {
    check(png(), [3, 2], [200, 100, 50, 255], 0);
    check(bytes(Luma([7_u8])), [2, 5], [7, 7, 7, 255], 0);
    check(bytes(LumaA([7_u8, 9])), [2, 5], [7, 7, 7, 9], 0);
    check(bytes(Rgba([1_u8, 2, 3, 4])), [2, 5], [1, 2, 3, 4], 0);
    check(bytes(Rgba([257_u16, 514, 65_535, 0])), [2, 5], [1, 2, 255, 0], 0);
    check(bytes(Luma([771_u16])), [2, 5], [3, 3, 3, 255], 0);
    check(encoded(ImageFormat::Jpeg, [16, 9], [90; 3]), [16, 9], [90, 90, 90, 255], 2);
    check(encoded(ImageFormat::WebP, [4, 4], [9, 8, 7]), [4, 4], [9, 8, 7, 255], 0);
    check(palette_png(), [2, 1], [10, 20, 30, 255], 0);
}

/// A PNG by hand: header fields, palette if any, and stored (uncompressed) rows.
fn raw_png(header: [u8; 13], palette: &[u8], rows: &[u8]) -> Vec<u8> {
    let chunk = |kind: &[u8; 4], content: &[u8]| {
        let body = [&kind[..], content].concat();
        let parts: [&[u8]; 3] =
            [&(content.len() as u32).to_be_bytes(), &body, &crc32fast::hash(&body).to_be_bytes()];
        parts.concat()
    };
    let length = rows.len() as u16;
    let (mut a, mut b) = (1_u32, 0_u32);
    for byte in rows {
        a = (a + u32::from(*byte)) % 65_521;
        b = (b + a) % 65_521;
    }
    let parts: [&[u8]; 5] = [
        &[0x78, 0x01, 1],
        &length.to_le_bytes(),
        &(!length).to_le_bytes(),
        rows,
        &(b << 16 | a).to_be_bytes(),
    ];
    let chunks = [
        b"\x89PNG\r\n\x1a\n".to_vec(),
        chunk(b"IHDR", &header),
        if palette.is_empty() { Vec::new() } else { chunk(b"PLTE", palette) },
        chunk(b"IDAT", &parts.concat()),
        chunk(b"IEND", b""),
    ];
    chunks.concat()
}

fn palette_png() -> Vec<u8> {
    let header = [0, 0, 0, 2, 0, 0, 0, 1, 8, 3, 0, 0, 0];
    raw_png(header, &[1, 2, 3, 10, 20, 30], &[0, 1, 1])
}

/// An 8-bit grey image of the stated size without its pixels.
fn giant_png(width: u32, height: u32) -> Vec<u8> {
    let mut header = [0; 13];
    header[..4].copy_from_slice(&width.to_be_bytes());
    header[4..8].copy_from_slice(&height.to_be_bytes());
    header[8] = 8;
    raw_png(header, &[], &[0, 0])
}

#[test]
fn what_cannot_be_decoded_is_noted_and_kept() {
    let mut cut = png();
    cut.truncate(cut.len() - 20);
    let mut ktx = b"\xABKTX 20\xBB\r\n\x1A\n".to_vec();
    ktx.resize(80, 0);
    let limits = Limits::default();
    let small = Limits { max_image_pixels: 5, ..limits };
    let few = Limits { max_all_image_pixels: 5, ..limits };
    for (image, limits, said) in [
        (cut, limits, "cannot be decoded"),
        (png()[..40].to_vec(), limits, "cannot be decoded"),
        (ktx, limits, "cannot be decoded"),
        (b"GIF89a\x01\0\x01\0\0\0\0".to_vec(), limits, "image/gif is not decoded"),
        (giant_png(u32::MAX >> 1, u32::MAX >> 1), limits, "cannot be decoded"),
        (giant_png(16_385, 1), limits, "cannot be decoded"),
        (giant_png(16_384, 4_097), limits, "67125248 pixels are over the limit of 67108864"),
        (giant_png(16_384, 4_096), limits, "cannot be decoded"),
        (png(), small, "6 pixels are over the limit of 5"),
        (png(), few, "6 pixels of all images are over the limit of 5"),
    ] {
        let (pixels, notes) = read_with(image, &limits);
        assert!(pixels.is_none(), "{said}");
        let [note] = &notes[..] else { panic!("{notes:?}") };
        assert_eq!(note.code, "image_unreadable");
        let ends = [
            note.text.starts_with("image 0 '' cannot be decoded ("),
            note.text.ends_with("(Basis Universal) of at most 16384 pixels a side"),
            note.text.contains(said),
        ];
        assert_eq!(ends, [true; 3], "{}", note.text);
    }
}

/// The content decides, whatever the media type.
#[test]
fn a_wrong_media_type_does_not_matter() {
    let image = png();
    let bytes = textured_glb(&[image], |json| json["images"][0]["mimeType"] = "image/jpeg".into());
    let Ingest { mesh, report, .. } = load("a.glb", &bytes).unwrap();
    assert_eq!(mesh.images[0].mime, "image/jpeg");
    assert!(mesh.images[0].pixels.is_some() && report.notes.is_empty());
}

#[test]
fn large_images_are_halved() {
    let image = encoded(ImageFormat::Png, [8_193, 3], [10, 20, 30]);
    check(image, [2_049, 1], [10, 20, 30, 255], 0);
    check(encoded(ImageFormat::Png, [2, 4_096], [9; 3]), [2, 4_096], [9, 9, 9, 255], 0);
}

#[test]
fn only_base_textures_are_decoded() {
    let bytes = textured_glb(&[png(), png(), png()], |json| {
        json["materials"][0]["normalTexture"] = json!({ "index": 1 });
    });
    let mesh = load("a.glb", &bytes).unwrap().mesh;
    let decoded: Vec<bool> = mesh.images.iter().map(|image| image.pixels.is_some()).collect();
    assert_eq!(decoded, [true, false, false]);
}
