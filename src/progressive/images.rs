//! Images in the file: their bytes as they are, which are compressed already.
//!
//! They come first in the body, so that a prefix of the file gives coarse levels with their
//! textures. Images that share bytes share a blob. Blobs do not overlap: together they are no
//! longer than the body, which bounds what a reader allocates.

use std::{collections::HashMap, sync::Arc};

use serde::{Deserialize, Serialize};

use super::{
    error::{Damage, ProgressiveError},
    section::IS_FUZZING,
};
use crate::mesh::Image;

/// Bytes in the body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Blob {
    /// First byte, counted from the end of the header.
    pub(super) offset: u64,
    pub(super) n_bytes: u64,
    /// CRC-32 (IEEE) of the bytes.
    pub(super) crc32: u32,
}

/// An image without its pixels.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct ImageEntry {
    name: String,
    mime: String,
    /// Where its bytes are; absent where it has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) blob: Option<u32>,
}

impl ImageEntry {
    fn of(image: &Image, blob: Option<u32>) -> Self {
        Self { name: image.name.clone(), mime: image.mime.clone(), blob }
    }
}

/// Appends the images' bytes to `body`.
pub(super) fn put_images(images: &[Image], body: &mut Vec<u8>) -> (Vec<ImageEntry>, Vec<Blob>) {
    let (mut blobs, mut known) = (Vec::new(), HashMap::new());
    let mut put = |bytes: &[u8]| {
        let offset = body.len() as u64;
        body.extend_from_slice(bytes);
        blobs.push(Blob { offset, n_bytes: bytes.len() as u64, crc32: crc32fast::hash(bytes) });
        blobs.len() as u32 - 1
    };
    let mut entries = Vec::with_capacity(images.len());
    for image in images {
        let bytes = &image.bytes;
        let blob =
            (!bytes.is_empty()).then(|| *known.entry(bytes.as_ptr()).or_insert_with(|| put(bytes)));
        entries.push(ImageEntry::of(image, blob));
    }
    (entries, blobs)
}

/// Reads what [`put_images`] put.
pub(super) fn take_images(
    entries: &[ImageEntry],
    blobs: &[Blob],
    body: &[u8],
) -> Result<Vec<Image>, ProgressiveError> {
    let truncated = |need: u64| {
        let (place, have) = ("images".to_owned(), body.len() as u64);
        ProgressiveError::Truncated { place, need, have }
    };
    let need = blobs.iter().fold(0_u64, |sum, blob| sum.saturating_add(blob.n_bytes));
    if need > body.len() as u64 {
        return Err(truncated(need));
    }
    let mut contents: Vec<Arc<[u8]>> = Vec::with_capacity(blobs.len());
    for blob in blobs {
        let end = blob.offset.saturating_add(blob.n_bytes);
        let bytes = body.get(blob.offset as usize..end as usize).ok_or_else(|| truncated(end))?;
        if crc32fast::hash(bytes) != blob.crc32 && !IS_FUZZING {
            return Err(ProgressiveError::Checksum { place: "images".to_owned() });
        }
        contents.push(bytes.into());
    }
    let image = |entry: &ImageEntry| {
        let bytes = match entry.blob {
            Some(blob) => contents.get(blob as usize)?.clone(),
            None => Arc::default(),
        };
        let (name, mime) = (entry.name.clone(), entry.mime.clone());
        Some(Image { name, mime, bytes, pixels: None })
    };
    let images: Option<_> = entries.iter().map(image).collect();
    images.ok_or_else(|| Damage("an image names bytes that are not there").at("header"))
}
