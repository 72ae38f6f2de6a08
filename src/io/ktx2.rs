//! KTX2 images of Basis Universal textures (KHR_texture_basisu): ETC1S and UASTC.
//!
//! Only their finest level is read. The decoder is the crate `basisu`, without C++.

use basisu::{DecodeFlags, TargetFormat, Transcoder};

use crate::mesh::Pixels;

/// Media type.
pub(super) const MIME: &str = "image/ktx2";
/// The first bytes of a file (KTX 2.0, section 3.1).
const IDENTIFIER: [u8; 12] = *b"\xabKTX 20\xbb\r\n\x1a\n";
/// Where width and height are (section 3, `pixelWidth`, `pixelHeight`).
const DIMENSIONS_AT: usize = 20;
/// Where the finest level's size without supercompression is (section 3, `uncompressedByteLength`).
const SIZE_AT: usize = 96;
/// Bytes of a block of 4 × 4 pixels, at most (UASTC).
const BLOCK_BYTES: u64 = 16;

/// Whether the content is KTX2.
pub(super) fn is_ktx2(bytes: &[u8]) -> bool {
    bytes.starts_with(&IDENTIFIER)
}

/// Width and height, as the header has them.
pub(super) fn dimensions(bytes: &[u8]) -> Result<(u32, u32), String> {
    let at = |k: usize| bytes.get(DIMENSIONS_AT + 4 * k..)?.first_chunk().copied();
    let (Some(width), Some(height)) = (at(0), at(1)) else {
        return Err("its header is cut off".to_owned());
    };
    Ok((u32::from_le_bytes(width), u32::from_le_bytes(height)))
}

/// The decoder makes as much room as the file says that it needs.
fn check_size(bytes: &[u8]) -> Result<(), String> {
    let (width, height) = dimensions(bytes)?;
    let blocks = |pixels: u32| u64::from(pixels.div_ceil(4));
    let most = blocks(width).saturating_mul(blocks(height)).saturating_mul(BLOCK_BYTES);
    let size = bytes.get(SIZE_AT..).and_then(<[u8]>::first_chunk);
    let size = size.copied().map(u64::from_le_bytes).ok_or("its list of levels is cut off")?;
    if size > most {
        return Err(format!("its {width} × {height} pixels take {size} bytes, it says"));
    }
    Ok(())
}

/// The finest level of the first image, eight bits a channel.
pub(super) fn decode(bytes: &[u8]) -> Result<Pixels, String> {
    let transcoder = Transcoder::new(bytes).map_err(|_| {
        "it is damaged, or KTX2 without Basis Universal (ETC1S or UASTC) in it".to_owned()
    })?;
    check_size(bytes)?;
    let (width, height) = transcoder.base_dimensions();
    let rgba = transcoder
        .transcode(0, TargetFormat::Rgba32, DecodeFlags::NONE)
        .map_err(|error| format!("{error:?}"))?;
    if rgba.len() as u64 != u64::from(width) * u64::from(height) * 4 {
        return Err("it has less pixels than its header says".to_owned());
    }
    Ok(Pixels { width, height, rgba })
}
