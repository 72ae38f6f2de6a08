//! What the glTF of a material says beyond [`Material`]'s fields: how much of a surface is there, and the light that
//! it gives off.

use serde_json::Value;

use super::model::{Coverage, Image, Material, Mesh, Pixels, Semantic, Texture, TextureUse, Wrap};

const EMISSIVE_STRENGTH: &str = "/extensions/KHR_materials_emissive_strength/emissiveStrength";

/// The light that a material gives off: a factor, times a texture if it has one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Emission {
    /// Red, green and blue, 0 or more; 1 is full scale. The strength is in it.
    pub factor: [f32; 3],
    /// Multiplies the factor.
    pub texture: Option<TextureUse>,
}

/// An [`Emission`] as pictures show it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Glow<'m> {
    /// Red, green and blue, 0 or more; 1 is full scale.
    pub factor: [f32; 3],
    /// Multiplies the factor; lies where the base texture does, if there is one. `None`: the same everywhere.
    pub texture: Option<Glowing<'m>>,
}

/// The texture of a [`Glow`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Glowing<'m> {
    /// Decoded.
    pub image: &'m Image,
    /// Where it lies, its set of coordinates being there.
    pub at: TextureUse,
    /// Beyond the edges.
    pub wrap: [Wrap; 2],
}

impl Material {
    /// What `alphaMode` and `alphaCutoff` say.
    pub fn coverage(&self) -> Coverage {
        let property = |name: &str| self.source.as_ref()?.get(name);
        match property("alphaMode").and_then(Value::as_str) {
            Some("MASK") => {
                let cutoff = property("alphaCutoff").and_then(Value::as_f64);
                Coverage::Mask(cutoff.unwrap_or(0.5) as f32)
            }
            Some("BLEND") => Coverage::Blend,
            _ => Coverage::Opaque,
        }
    }

    /// What `emissiveFactor`, `emissiveTexture` and KHR_materials_emissive_strength say; `None` where that is
    /// nothing, and of unlit materials, which give off none.
    pub fn emission(&self) -> Option<Emission> {
        let source = self.source.as_ref().filter(|_| !self.unlit)?;
        let factor = source.get("emissiveFactor")?;
        let strength = source.pointer(EMISSIVE_STRENGTH).and_then(Value::as_f64).unwrap_or(1.0);
        let factor = [0, 1, 2].map(|c| {
            let value = factor.get(c).and_then(Value::as_f64).unwrap_or(0.0) * strength;
            value.clamp(0.0, f64::from(f32::MAX)) as f32
        });
        let texture = source.get("emissiveTexture").and_then(TextureUse::of_info);
        (factor != [0.0; 3]).then_some(Emission { factor, texture })
    }

    /// Whether the emissive texture lies elsewhere than the base texture: it has other coordinates, or goes on
    /// otherwise beyond its edges.
    pub fn glows_apart(&self, textures: &[Texture]) -> bool {
        let wrap = |at: &TextureUse| textures.get(at.texture as usize).map(|t| t.wrap);
        let place = |at: &TextureUse| (at.tex_coord, at.transform, wrap(at));
        let glow = self.emission().and_then(|emission| emission.texture);
        self.base_texture.zip(glow).is_some_and(|(base, glow)| place(&base) != place(&glow))
    }
}

impl Mesh {
    /// How a material glows in pictures. A texture that lies elsewhere than the base texture, or whose coordinates
    /// are not there, counts with its mean; where its image was not read, nothing glows.
    pub fn glow_of(&self, material: &Material) -> Option<Glow<'_>> {
        let Emission { factor, texture } = material.emission()?;
        let found = texture.and_then(|at| Some((at, self.textures.get(at.texture as usize)?)));
        let Some((at, found)) = found else { return Some(Glow { factor, texture: None }) };
        let image = self.images.get(found.image? as usize)?;
        let pixels = image.pixels.as_ref()?;
        let has_place = self.layer(Semantic::TexCoord(at.tex_coord)).is_some();
        if has_place && !material.glows_apart(&self.textures) {
            let texture = Some(Glowing { image, at, wrap: found.wrap });
            return Some(Glow { factor, texture });
        }
        let mean = pixels.mean();
        Some(Glow { factor: [0, 1, 2].map(|c| factor[c] * mean[c]), texture: None })
    }
}

impl Pixels {
    /// The mean red, green and blue, 0 to 1.
    fn mean(&self) -> [f32; 3] {
        let texels = self.rgba.as_chunks::<4>().0;
        let full = 255.0 * texels.len().max(1) as f64;
        [0, 1, 2]
            .map(|c| (texels.iter().map(|p| u64::from(p[c])).sum::<u64>() as f64 / full) as f32)
    }
}

impl TextureUse {
    /// What a textureInfo says, KHR_texture_transform included; `None` without a texture.
    pub fn of_info(info: &Value) -> Option<Self> {
        let id = |value: &Value| value.as_u64().and_then(|id| u32::try_from(id).ok());
        let texture = id(info.get("index")?)?;
        let tex_coord = info.get("texCoord").and_then(id).unwrap_or(0);
        let Some(transform) = info.get("extensions").and_then(|e| e.get("KHR_texture_transform"))
        else {
            return Some(Self { texture, tex_coord, transform: Self::IDENTITY });
        };
        let tex_coord = transform.get("texCoord").and_then(id).unwrap_or(tex_coord);
        Some(Self { texture, tex_coord, transform: affine(transform) })
    }
}

/// Translation × rotation × scale. The rotation is counter-clockwise where v points down, as
/// programs do it; the listing in the extension's text has the other sign
/// (github.com/KhronosGroup/glTF/issues/1563).
fn affine(transform: &Value) -> [[f32; 3]; 2] {
    let number = |value: Option<&Value>, default| value.and_then(Value::as_f64).unwrap_or(default);
    let pair = |key: &str, default| {
        [0, 1].map(|i| number(transform.get(key).and_then(|pair| pair.get(i)), default))
    };
    let ([x, y], [sx, sy]) = (pair("offset", 0.0), pair("scale", 1.0));
    let (sin, cos) = libm::sincos(number(transform.get("rotation"), 0.0));
    let rows = [[cos * sx, sin * sy, x], [-sin * sx, cos * sy, y]];
    let rows = rows.map(|row| row.map(|value| value as f32 + 0.0));
    if rows.as_flattened().iter().all(|v| v.is_finite()) { rows } else { TextureUse::IDENTITY }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn transforms_scale_then_turn_then_shift() {
        let quarter = std::f64::consts::FRAC_PI_2;
        for (transform, expected) in [
            (json!({}), TextureUse::IDENTITY),
            (json!({ "offset": [0.5, -1], "scale": [2, 3] }), [[2., 0., 0.5], [0., 3., -1.]]),
            (json!({ "rotation": quarter }), [[0., 1., 0.], [-1., 0., 0.]]),
            (
                json!({ "rotation": quarter, "scale": [2, 3], "offset": [4, 5] }),
                [[0., 3., 4.], [-2., 0., 5.]],
            ),
            (json!({ "scale": [1e300, 1] }), TextureUse::IDENTITY),
        ] {
            let found = affine(&transform);
            let pairs = found.as_flattened().iter().zip(expected.as_flattened());
            assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-6), "{transform}: {found:?}");
        }
    }

    #[test]
    fn the_transform_may_name_another_set() {
        let info =
            |extensions: Value| json!({ "index": 3, "texCoord": 1, "extensions": extensions });
        for (extensions, expected) in [
            (json!({}), 1),
            (json!({ "KHR_texture_transform": {} }), 1),
            (json!({ "KHR_texture_transform": { "texCoord": 2 } }), 2),
        ] {
            let found = TextureUse::of_info(&info(extensions)).unwrap();
            assert_eq!((found.texture, found.tex_coord), (3, expected));
        }
        assert_eq!(TextureUse::of_info(&json!({ "index": -1 })), None);
    }

    #[test]
    fn light_is_factor_times_strength_and_unlit_materials_give_off_none() {
        let strong = |strength: Value| json!({ "KHR_materials_emissive_strength": { "emissiveStrength": strength } });
        for (source, unlit, expected) in [
            (json!({}), false, None),
            (json!({ "emissiveTexture": { "index": 0 } }), false, None),
            (json!({ "emissiveFactor": [0, 0, 0] }), false, None),
            (json!({ "emissiveFactor": [0, 0.5, 1] }), false, Some([0.0, 0.5, 1.0])),
            (json!({ "emissiveFactor": [0, 0.5, 1] }), true, None),
            (json!({ "emissiveFactor": [-1, "a"] }), false, None),
            (
                json!({ "emissiveFactor": [0, 0.5, 1], "extensions": strong(json!(4)) }),
                false,
                Some([0.0, 2.0, 4.0]),
            ),
            (json!({ "emissiveFactor": [0, 0.5, 1], "extensions": strong(json!(0)) }), false, None),
            (
                json!({ "emissiveFactor": [1e300, 0, 0], "extensions": strong(json!(1e300)) }),
                false,
                Some([f32::MAX, 0.0, 0.0]),
            ),
        ] {
            let material = Material { unlit, source: Some(source), ..Material::default() };
            let found = material.emission().map(|emission| emission.factor);
            assert_eq!(found, expected, "{material:?}");
        }
        assert_eq!(Material::default().emission(), None);
    }
}
