//! Decoding of the images that pictures show: those of base and emissive textures. PNG, JPEG and WebP
//! here, KTX2 in `ktx2.rs`.
//!
//! The content says what an image is, not its media type. Dimensions are held against the limits
//! before anything is decoded. An image that cannot be decoded is noted; its bytes stay.

use std::{collections::BTreeSet, io::Cursor, panic::catch_unwind, sync::Arc};

use image::{ImageFormat, ImageReader};
use rayon::prelude::*;

use super::{Limits, ktx2, soup::Notes};
use crate::mesh::{Image, Material, Mesh, Pixels};

/// What is decoded.
const FORMATS: [ImageFormat; 3] = [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP];
/// Larger images are halved until they are not: pictures have fewer pixels by far.
const MAX_DRAWN_SIDE: u32 = 4096;
/// What a decoder may allocate for a pixel: four channels of 16 bits, and half as much to work.
const BYTES_PER_PIXEL: u64 = 12;

/// The media type that the content shows.
pub(super) fn mime_of(bytes: &[u8]) -> Option<&'static str> {
    if ktx2::is_ktx2(bytes) {
        return Some(ktx2::MIME);
    }
    image::guess_format(bytes).ok().map(|format| format.to_mime_type())
}

/// What glTF holds.
const OF_GLTF: [&str; 4] = ["image/png", "image/jpeg", "image/webp", ktx2::MIME];

/// The media type of an image as glTF holds it, and other bytes where these are in another format: BMP, and TGA (which
/// only its name tells), become PNG.
///
/// # Errors
/// What it is and what to do, where it cannot be one of these. `n_pixels` counts those of all images that become others.
pub(super) fn for_gltf(
    bytes: &[u8],
    name: &str,
    limits: &Limits,
    n_pixels: &mut u64,
) -> Result<(&'static str, Option<Vec<u8>>), String> {
    let is_tga = name.to_ascii_lowercase().ends_with(".tga");
    let format = match mime_of(bytes) {
        Some(mime) if OF_GLTF.contains(&mime) => return Ok((mime, None)),
        Some("image/bmp") => ImageFormat::Bmp,
        None if is_tga => ImageFormat::Tga,
        other => {
            let format = other.unwrap_or("of an unknown format");
            return Err(format!("it is {format}: save it as PNG, JPEG, WebP or KTX2"));
        }
    };
    let [header, reader] = [(); 2].map(|()| limited(bytes, format, limits));
    let size = guarded(move || header.into_dimensions());
    let checked = size.and_then(|size| hold_to_limits(size, limits, n_pixels));
    let png = checked.and_then(|()| {
        guarded(move || {
            let mut png = Cursor::new(Vec::new());
            reader.decode()?.write_to(&mut png, ImageFormat::Png).map(|()| png.into_inner())
        })
    });
    let text = |reason| format!("it cannot be decoded ({reason}): save it as PNG");
    Ok((ImageFormat::Png.to_mime_type(), Some(png.map_err(text)?)))
}

/// Decodes the images of the materials' base and emissive textures.
pub(super) fn decode_shown_textures(mesh: &mut Mesh, limits: &Limits, notes: &mut Notes) {
    let glow = |m: &Material| m.emission().and_then(|light| light.texture);
    let uses = mesh.materials.iter().flat_map(|m| m.base_texture.into_iter().chain(glow(m)));
    let textures = uses.filter_map(|u| mesh.textures.get(u.texture as usize));
    let is_there = |i: &usize| mesh.images.get(*i).is_some_and(|image| !image.bytes.is_empty());
    let used: BTreeSet<usize> =
        textures.filter_map(|t| t.image.map(|i| i as usize)).filter(is_there).collect();
    let mut n_pixels = 0;
    let checked: Vec<(usize, Result<(), String>)> = used
        .into_iter()
        .map(|i| (i, check_size(&mesh.images[i].bytes, limits, &mut n_pixels)))
        .collect();
    let decoded: Vec<(usize, Result<Pixels, String>)> = checked
        .into_par_iter()
        .map(|(i, checked)| (i, checked.and_then(|()| decode(&mesh.images[i].bytes, limits))))
        .collect();
    for (i, pixels) in decoded {
        match pixels {
            Ok(pixels) => mesh.images[i].pixels = Some(Arc::new(pixels)),
            Err(reason) => note_unreadable(i, &mesh.images[i], &reason, limits, notes),
        }
    }
}

fn note_unreadable(index: usize, image: &Image, reason: &str, limits: &Limits, notes: &mut Notes) {
    let name: String = image.name.chars().take(64).collect();
    let reason: String = reason.chars().take(160).collect();
    let text = format!(
        "image {index} '{name}' cannot be decoded ({reason}): materials that use it are drawn in \
         the factors of their base colours alone; save it as PNG, JPEG, WebP or KTX2 \
         (Basis Universal) of at most {} pixels a side",
        limits.max_image_side
    );
    notes.add("image_unreadable", text);
}

fn reader<'a>(bytes: &'a [u8], limits: &Limits) -> Result<ImageReader<Cursor<&'a [u8]>>, String> {
    let format = image::guess_format(bytes).map_err(|e| e.to_string())?;
    if !FORMATS.contains(&format) {
        return Err(format!("{} is not decoded", format.to_mime_type()));
    }
    Ok(limited(bytes, format, limits))
}

fn limited<'a>(
    bytes: &'a [u8],
    format: ImageFormat,
    limits: &Limits,
) -> ImageReader<Cursor<&'a [u8]>> {
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    let mut of_decoder = image::Limits::default();
    of_decoder.max_image_width = Some(limits.max_image_side);
    of_decoder.max_image_height = Some(limits.max_image_side);
    of_decoder.max_alloc = Some(limits.max_image_pixels.saturating_mul(BYTES_PER_PIXEL));
    reader.limits(of_decoder);
    reader
}

/// Holds the dimensions in the image's header against the limits; `n_pixels` counts those of all.
fn check_size(bytes: &[u8], limits: &Limits, n_pixels: &mut u64) -> Result<(), String> {
    let size = if ktx2::is_ktx2(bytes) {
        ktx2::dimensions(bytes)?
    } else {
        let reader = reader(bytes, limits)?;
        guarded(move || reader.into_dimensions())?
    };
    hold_to_limits(size, limits, n_pixels)
}

fn hold_to_limits(
    (width, height): (u32, u32),
    limits: &Limits,
    n_pixels: &mut u64,
) -> Result<(), String> {
    let own = u64::from(width) * u64::from(height);
    let rules = [
        (width.max(height).into(), limits.max_image_side.into(), "pixels a side"),
        (own, limits.max_image_pixels, "pixels"),
        (n_pixels.saturating_add(own), limits.max_all_image_pixels, "pixels of all images"),
    ];
    for (count, limit, what) in rules {
        if count > limit {
            return Err(format!("{count} {what} are over the limit of {limit}"));
        }
    }
    *n_pixels += own;
    Ok(())
}

/// Eight bits a channel, no side over [`MAX_DRAWN_SIDE`].
fn decode(bytes: &[u8], limits: &Limits) -> Result<Pixels, String> {
    let mut pixels = if ktx2::is_ktx2(bytes) {
        guarded(|| ktx2::decode(bytes))?
    } else {
        let reader = reader(bytes, limits)?;
        let image = guarded(move || reader.decode())?.into_rgba8();
        let (width, height) = image.dimensions();
        Pixels { width, height, rgba: image.into_raw() }
    };
    if pixels.width == 0 || pixels.height == 0 {
        return Err("it has no pixels".to_owned());
    }
    while pixels.width.max(pixels.height) > MAX_DRAWN_SIDE {
        pixels = halved(&pixels);
    }
    Ok(pixels)
}

/// A decoder that panics cannot decode: arithmetic is checked here, which its authors need not
/// have tried.
fn guarded<T, E: ToString>(
    decode: impl FnOnce() -> Result<T, E> + std::panic::UnwindSafe,
) -> Result<T, String> {
    match catch_unwind(decode) {
        Ok(result) => result.map_err(|error| error.to_string()),
        Err(_) => Err("the decoder failed".to_owned()),
    }
}

/// Half as large (rounded up): each pixel is the mean of two by two, of encoded values.
fn halved(from: &Pixels) -> Pixels {
    let (width, height) = (from.width.div_ceil(2), from.height.div_ceil(2));
    let row_bytes = from.width as usize * 4;
    let mut rgba = vec![0; width as usize * height as usize * 4];
    rgba.par_chunks_exact_mut(width as usize * 4).enumerate().for_each(|(y, row)| {
        let rows = [2 * y, (2 * y + 1).min(from.height as usize - 1)]
            .map(|y| &from.rgba[y * row_bytes..][..row_bytes]);
        for (x, pixel) in row.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            let columns = [2 * x, (2 * x + 1).min(from.width as usize - 1)];
            for (channel, value) in pixel.iter_mut().enumerate() {
                let at = |row: &[u8], x: usize| u32::from(row[x * 4 + channel]);
                let sum: u32 = rows.iter().flat_map(|row| columns.map(|x| at(row, x))).sum();
                *value = ((sum + 2) / 4) as u8;
            }
        }
    });
    Pixels { width, height, rgba }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_round_up_and_average() {
        let gray = |values: &[u8]| values.iter().flat_map(|v| [*v; 4]).collect();
        let from = Pixels { width: 3, height: 2, rgba: gray(&[0, 1, 10, 2, 3, 20]) };
        let expected = Pixels { width: 2, height: 1, rgba: gray(&[2, 15]) };
        assert_eq!(halved(&from), expected);
        assert_eq!(halved(&expected).rgba, gray(&[9]));
    }
}
