//! Textures, samplers and images, under the indices that they have in the file.
//!
//! What cannot be had (files that are not in the same archive, broken references) is left empty
//! with a note: geometry is worth reading without it. Nothing is fetched.

use std::{collections::HashMap, sync::Arc};

use gltf::json::{
    image::Image as JsonImage,
    texture::{MagFilter, MinFilter, Sampler, WrappingMode},
    validation::Checked,
};
use serde_json::Value;

use super::{
    super::picture::mime_of,
    Document, Soup,
    container::{PACK_REMEDY, decode},
};
use crate::mesh::{Image, Texture, Wrap};

/// The schema's mark of a texture without a source.
const NO_SOURCE: usize = u32::MAX as usize;

/// Extensions that name an image in a format that not all programs read.
const NEWER_FORMATS: [&str; 2] = ["KHR_texture_basisu", "EXT_texture_webp"];

/// All images in the order of the file.
pub(super) fn read_images(document: &Document<'_>, soup: &mut Soup) {
    let mut store = Store {
        document,
        views: HashMap::new(),
        // Images that overlap could take more than there is.
        n_left: document.source.n_bytes() as usize,
    };
    for (i, image) in document.root.images.iter().enumerate() {
        let name = image.name.clone().unwrap_or_default();
        let bytes = store.bytes_of(image, i).unwrap_or_else(|reason| {
            let label = label("image", i, &name);
            let text = format!("{label} is left out: {reason}; {PACK_REMEDY}");
            soup.notes.add("image_missing", text);
            Arc::default()
        });
        let stated = image.mime_type.as_ref().map(|mime| mime.0.clone());
        let mime = stated.or_else(|| mime_of(&bytes).map(str::to_owned)).unwrap_or_default();
        soup.images.push(Image { name, mime, bytes, pixels: None });
    }
}

/// The bytes of images, those of a buffer view once.
struct Store<'d> {
    document: &'d Document<'d>,
    views: HashMap<usize, Arc<[u8]>>,
    n_left: usize,
}

impl Store<'_> {
    fn bytes_of(&mut self, image: &JsonImage, index: usize) -> Result<Arc<[u8]>, String> {
        let bytes = match (image.buffer_view, &image.uri) {
            (Some(view), _) => self.view(view.value(), index)?,
            (None, Some(uri)) if uri.starts_with("data:") => {
                decode(uri).map(Arc::from).ok_or("its base64 text is bad")?
            }
            (None, Some(uri)) => {
                let archive = self.document.source.beside;
                if let Some((archive, entry)) = archive.and_then(|a| Some((a, a.find_uri(uri)?))) {
                    return archive.unpack(entry).map_err(|e| e.to_string());
                }
                let shown: String = uri.chars().take(80).collect();
                return Err(format!("it is in another file, '{shown}'"));
            }
            (None, None) => Arc::default(),
        };
        if bytes.is_empty() { Err("it has no bytes".to_owned()) } else { Ok(bytes) }
    }

    fn view(&mut self, view: usize, image: usize) -> Result<Arc<[u8]>, String> {
        if let Some(bytes) = self.views.get(&view) {
            return Ok(bytes.clone());
        }
        let Document { source, root, buffers, .. } = self.document;
        let bytes = buffers
            .view(source, root, view, &format!("image {image}"))
            .map_err(|_| format!("its bytes (buffer view {view}) are not in the file"))?;
        self.n_left = self
            .n_left
            .checked_sub(bytes.len())
            .ok_or("it overlaps other images, which together are larger than the file")?;
        let bytes: Arc<[u8]> = bytes.into();
        self.views.insert(view, bytes.clone());
        Ok(bytes)
    }
}

/// All textures in the order of the file; `verbatim` has their extensions.
pub(super) fn read_textures(document: &Document<'_>, verbatim: &[Value], soup: &mut Soup) {
    for (i, texture) in document.root.textures.iter().enumerate() {
        let name = texture.name.clone().unwrap_or_default();
        let label = label("texture", i, &name);
        let extension = |name: &str| {
            let source = verbatim.get(i)?.get("extensions")?.get(name)?.get("source")?;
            source.as_u64().map(|source| source as usize)
        };
        let source = Some(texture.source.value()).filter(|source| *source != NO_SOURCE);
        let source = in_range(source, document.root.images.len(), &label, "image", soup);
        let newer = NEWER_FORMATS.iter().find_map(|name| extension(name));
        let newer = in_range(newer, document.root.images.len(), &label, "image", soup);
        if let (None, Some(format)) = (newer.or(source), verbatim.get(i).and_then(unread_format)) {
            let text = format!(
                "{label} has its image by {format} alone, which is not read: it is left out; save \
                 images as PNG, JPEG, WebP or KTX2 (Basis Universal)"
            );
            soup.notes.add("texture_format_ignored", text);
        }
        let sampler = texture.sampler.map(|sampler| sampler.value());
        let sampler = in_range(sampler, document.root.samplers.len(), &label, "sampler", soup);
        let (wrap, filters) =
            sampler.map(|s| sampling(&document.root.samplers[s])).unwrap_or_default();
        soup.textures.push(Texture {
            name,
            image: newer.or(source).map(|i| i as u32),
            fallback: newer.and(source).map(|i| i as u32),
            wrap,
            filters,
        });
    }
}

/// The first extension that names an image in a format that is not read.
fn unread_format(texture: &Value) -> Option<String> {
    let extensions = texture.get("extensions")?.as_object()?;
    let is_unread = |name: &str| !NEWER_FORMATS.contains(&name);
    let (name, _) =
        extensions.iter().find(|(name, value)| is_unread(name) && value.get("source").is_some())?;
    Some(name.chars().take(64).collect())
}

/// The index, unless it is out of range, which is noted.
fn in_range(
    index: Option<usize>,
    n: usize,
    label: &str,
    what: &str,
    soup: &mut Soup,
) -> Option<usize> {
    let index = index?;
    if index < n {
        return Some(index);
    }
    let text = format!(
        "{label} names {what} {index}, but there are {n}: it is read without; export the model again"
    );
    soup.notes.add("texture_reference_broken", text);
    None
}

fn sampling(sampler: &Sampler) -> ([Wrap; 2], [Option<u32>; 2]) {
    let wrap = |mode: Checked<WrappingMode>| match mode {
        Checked::Valid(WrappingMode::ClampToEdge) => Wrap::Clamp,
        Checked::Valid(WrappingMode::MirroredRepeat) => Wrap::Mirror,
        _ => Wrap::Repeat,
    };
    let mag = match sampler.mag_filter {
        Some(Checked::Valid(filter)) => Some(MagFilter::as_gl_enum(&filter)),
        _ => None,
    };
    let min = match sampler.min_filter {
        Some(Checked::Valid(filter)) => Some(MinFilter::as_gl_enum(&filter)),
        _ => None,
    };
    ([wrap(sampler.wrap_s), wrap(sampler.wrap_t)], [mag, min])
}

/// What messages call a thing.
pub(super) fn label(what: &str, index: usize, name: &str) -> String {
    let shown: String = name.chars().take(64).collect();
    if shown.is_empty() { format!("{what} {index}") } else { format!("{what} {index} '{shown}'") }
}
