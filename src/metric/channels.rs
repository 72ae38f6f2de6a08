//! What of colours pictures show: their luminance, or red, green and blue, each in a picture of its own.
//!
//! Invariants:
//! 1. channels are 8-bit numbers as the model has them, without a transfer curve, lit as luminances are;
//! 2. a picture of a channel is a picture like any other: whoever judges moves knows of no colours.

use serde::{Deserialize, Serialize};

use crate::{
    mesh::{AttributeLayer, Image, Material, Mesh, Semantic},
    render::FULL_WEIGHT,
};

use super::{
    appearance::is_white,
    image::{self, REC709},
};

/// By what pictures are compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Metric {
    /// Squared differences of luminances (Lindstrom & Turk 2000, section 4).
    #[default]
    Luminance,
    /// Squared differences of red, of green and of blue.
    Rgb,
    /// Those of luminances, as far as they are visible (`masking.rs`).
    Perceptual,
}

impl Metric {
    /// Pictures that a camera takes.
    pub fn n_channels(self) -> usize {
        self.weights().len()
    }

    /// Bytes of the original's pictures for each pixel of a camera.
    pub fn n_bytes(self) -> usize {
        self.n_channels() + usize::from(self == Self::Perceptual)
    }

    /// How often a pixel of a camera counts at most, in all its channels: the energy divided by that and the pixels
    /// is the square of d2.
    pub fn full_weight(self) -> u64 {
        match self {
            Self::Luminance => 1,
            Self::Rgb => self.n_channels() as u64,
            Self::Perceptual => FULL_WEIGHT.into(),
        }
    }

    /// What each channel has of red, green and blue.
    pub(super) fn weights(self) -> &'static [[f64; 3]] {
        match self {
            Self::Luminance | Self::Perceptual => &[REC709],
            Self::Rgb => &[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        }
    }

    /// Channels of an RGB(A) vector, all the same where luminance is the only one; white when it is too short to be
    /// a colour.
    pub(super) fn channels(self, colour: &[f32]) -> [f32; 3] {
        let &[r, g, b, ..] = colour else { return [1.0; 3] };
        match self {
            Self::Luminance | Self::Perceptual => [image::luminance([r, g, b]); 3],
            Self::Rgb => [r, g, b],
        }
    }
}

/// Whether a mesh shows no colour but greys: its channels then differ in nothing, and its luminance says it all.
pub fn is_grey(mesh: &Mesh) -> bool {
    fn is_even<T: PartialEq>(colour: &[T]) -> bool {
        !matches!(colour, [r, g, b, ..] if r != g || g != b)
    }
    let vertices = |layer: &AttributeLayer| {
        layer.semantic != Semantic::Color(0)
            || layer.values.chunks_exact(layer.width.max(1)).all(is_even)
    };
    let gives_off_grey = |m: &Material| m.emission().is_none_or(|light| is_even(&light.factor));
    let pixels = |image: &Image| {
        image.pixels.as_ref().is_none_or(|p| p.rgba.as_chunks::<4>().0.iter().all(|p| is_even(p)))
    };
    is_white(mesh)
        || mesh.materials.iter().all(|m| is_even(&m.base_color) && gives_off_grey(m))
            && mesh.layers.iter().all(vertices)
            && mesh.images.iter().all(pixels)
}
