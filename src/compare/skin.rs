//! What a material looks like: its base colour texture, decoded, where it has holes, and what it gives off.
//!
//! Knows nothing of triangles or pictures.

use super::texture::{Sieve, Texture};
use crate::mesh::{Coverage, Material, Mesh, Pixels, TextureUse, Wrap};

/// What a material looks like.
pub(super) struct Skin<const N: usize> {
    pub(super) at: TextureUse,
    pub(super) texture: Texture<N>,
    /// Where it has holes.
    pub(super) sieve: Option<Sieve>,
    /// What it gives off.
    pub(super) glow: Option<Texture<N>>,
}

impl<const N: usize> Skin<N> {
    /// Whether it looks the same everywhere.
    pub(super) fn is_plain(&self) -> bool {
        self.texture.is_plain() && self.glow.as_ref().is_none_or(Texture::is_plain)
    }
}

/// The decoded image of a texture.
fn pixels<'m>(mesh: &'m Mesh, at: &TextureUse) -> Option<(&'m Pixels, [Wrap; 2])> {
    let texture = mesh.textures.get(at.texture as usize)?;
    let image = mesh.images.get(texture.image? as usize)?;
    Some((image.pixels.as_deref()?, texture.wrap))
}

/// The base colour texture of a material, if it has one that was read, with the factor in it; a single texel where
/// there is none, but holes, or something that is given off.
pub(super) fn skin<const N: usize>(
    mesh: &Mesh,
    material: &Material,
    encode: impl Fn([f32; 3]) -> [f32; N],
) -> Option<Skin<N>> {
    let white = Pixels { width: 1, height: 1, rgba: vec![255; 4] };
    let everywhere = TextureUse { texture: 0, tex_coord: 0, transform: TextureUse::IDENTITY };
    let found = material.base_texture.and_then(|at| Some((at, pixels(mesh, &at)?)));
    let (coverage, glow) = (material.coverage(), mesh.glow_of(material));
    if found.is_none() && coverage == Coverage::Opaque && glow.is_none() {
        return None;
    }
    let plain = (&white, [Wrap::Repeat; 2]);
    let glowing = glow.and_then(|glow| Some((glow.texture?.at, pixels(mesh, &glow.texture?.at)?)));
    let at = found.or(glowing).map_or(everywhere, |(at, _)| at);
    let (pixels, wrap) = found.map_or(plain, |(_, found)| found);
    let [r, g, b, alpha] = material.base_color;
    let lit = |texel: [f32; 3]| encode([texel[0] * r, texel[1] * g, texel[2] * b]);
    let has_sieve = coverage != Coverage::Opaque;
    let sieve = has_sieve.then(|| Sieve::new(pixels, wrap, alpha, coverage));
    let glow = glow.map(|glow| {
        let (pixels, wrap) = glowing.map_or(plain, |(_, found)| found);
        let channel = |texel: [f32; 3], c: usize| (texel[c] * glow.factor[c]).min(1.0);
        Texture::new(pixels, wrap, |texel| encode([0, 1, 2].map(|c| channel(texel, c))))
    });
    Some(Skin { at, texture: Texture::new(pixels, wrap, lit), sieve, glow })
}
