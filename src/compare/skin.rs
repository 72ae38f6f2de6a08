//! What a material looks like: its base colour texture, decoded, and where it has holes.
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
}

/// The decoded image of a texture.
pub(super) fn pixels<'m>(mesh: &'m Mesh, at: &TextureUse) -> Option<(&'m Pixels, [Wrap; 2])> {
    let texture = mesh.textures.get(at.texture as usize)?;
    let image = mesh.images.get(texture.image? as usize)?;
    Some((image.pixels.as_deref()?, texture.wrap))
}

/// The base colour texture of a material, if it has one that was read, with the factor in it; a single texel where
/// there is none, but holes.
pub(super) fn skin<const N: usize>(
    mesh: &Mesh,
    material: &Material,
    encode: impl Fn([f32; 3]) -> [f32; N],
) -> Option<Skin<N>> {
    let white = Pixels { width: 1, height: 1, rgba: vec![255; 4] };
    let everywhere = TextureUse { texture: 0, tex_coord: 0, transform: TextureUse::IDENTITY };
    let found = material.base_texture.and_then(|at| Some((at, pixels(mesh, &at)?)));
    let coverage = material.coverage();
    let (at, (pixels, wrap)) = match found {
        Some(found) => found,
        None if coverage == Coverage::Opaque => return None,
        None => (everywhere, (&white, [Wrap::Repeat; 2])),
    };
    let [r, g, b, alpha] = material.base_color;
    let lit = |texel: [f32; 3]| encode([texel[0] * r, texel[1] * g, texel[2] * b]);
    let has_sieve = coverage != Coverage::Opaque;
    let sieve = has_sieve.then(|| Sieve::new(pixels, wrap, alpha, coverage));
    Some(Skin { at, texture: Texture::new(pixels, wrap, lit), sieve })
}
