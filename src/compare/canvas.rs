//! A page to draw pictures, boxes and lettering on, and its PNG.
//!
//! Lettering uses an 8 × 8 bitmap font whose outlines are rounded by repeated scaling (Scale2x,
//! Mazzoleni 2001) and then filtered down, so that it reads well at any height.
//!
//! Knows nothing of meshes.

use std::{collections::BTreeMap, rc::Rc};

use font8x8::UnicodeFonts;
use image::{
    ExtendedColorType, ImageEncoder,
    codecs::png::{CompressionType, FilterType, PngEncoder},
};

/// Red, green and blue as displayed.
pub(super) type Rgb = [u8; 3];

/// A rectangular page of pixels.
pub(super) struct Canvas {
    width: usize,
    height: usize,
    pixels: Vec<Rgb>,
    /// The glyphs met so far, by their bitmaps.
    outlines: BTreeMap<[u8; 8], Rc<[bool]>>,
}

impl Canvas {
    pub(super) fn new(width: usize, height: usize, colour: Rgb) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        let pixels = vec![colour; width * height];
        Self { width, height, pixels, outlines: BTreeMap::new() }
    }

    /// Sets one pixel; outside the page nothing happens.
    pub(super) fn set(&mut self, x: usize, y: usize, colour: Rgb) {
        if x < self.width && y < self.height {
            self.pixels[y * self.width + x] = colour;
        }
    }

    /// Pastes a square picture with its upper left corner at (x, y).
    pub(super) fn paste(&mut self, x: usize, y: usize, side: usize, picture: &[Rgb]) {
        for (row, pixels) in picture.chunks_exact(side.max(1)).enumerate() {
            for (column, pixel) in pixels.iter().enumerate() {
                self.set(x + column, y + row, *pixel);
            }
        }
    }

    /// Writes a line of text; (x, y) is its upper left corner, `height` that of a line in pixels.
    pub(super) fn text(&mut self, x: usize, y: usize, height: usize, colour: Rgb, text: &str) {
        let mut at = x as f64;
        for character in text.chars() {
            let glyph = Glyph::of(character);
            self.glyph(at, y, height, colour, &glyph);
            at += glyph.advance(height);
        }
    }

    fn glyph(&mut self, left: f64, top: usize, height: usize, colour: Rgb, glyph: &Glyph) {
        let outline = self.outlines.entry(glyph.rows).or_insert_with(|| glyph.outline().into());
        let outline = Rc::clone(outline);
        let first = left.floor();
        let width = (glyph.columns as usize * height).div_ceil(8);
        for y in 0..height {
            for x in 0..=width {
                let ink = coverage(&outline, height, first - left + x as f64, y as f64);
                self.blend(first as usize + x, top + y, colour, ink);
            }
        }
    }

    fn blend(&mut self, x: usize, y: usize, colour: Rgb, ink: f64) {
        if x < self.width && y < self.height && ink > 0.0 {
            let pixel = &mut self.pixels[y * self.width + x];
            for (old, new) in pixel.iter_mut().zip(colour) {
                *old = (f64::from(*old) * (1.0 - ink) + f64::from(new) * ink).round() as u8;
            }
        }
    }

    /// The page as a PNG file.
    /// The pixels, row after row from the top.
    pub(super) fn pixels(&self) -> &[Rgb] {
        &self.pixels
    }

    pub(super) fn png(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        let (width, height) = (self.width as u32, self.height as u32);
        // Encoding into memory fails only for a picture without pixels, which no canvas is.
        // One filter for all rows: trying each on every row costs more than drawing the page.
        let (compression, filter) = (CompressionType::Fast, FilterType::Up);
        let encoder = PngEncoder::new_with_quality(&mut bytes, compression, filter);
        let encoded =
            encoder.write_image(self.pixels.as_flattened(), width, height, ExtendedColorType::Rgb8);
        debug_assert!(encoded.is_ok(), "{encoded:?}");
        bytes
    }
}

/// Width of a line of text, pixels.
pub(super) fn text_width(height: usize, text: &str) -> usize {
    text.chars().map(|c| Glyph::of(c).advance(height)).sum::<f64>().ceil() as usize
}

/// An 8 × 8 bitmap, moved to the left edge.
struct Glyph {
    rows: [u8; 8],
    columns: u32,
}

/// How often the outline is doubled: 8 → 64.
const DOUBLINGS: u32 = 3;
const OUTLINE: usize = 8 << DOUBLINGS;

impl Glyph {
    /// The font's glyph, a question mark where it has none.
    fn of(character: char) -> Self {
        let known = font8x8::BASIC_FONTS
            .get(character)
            .or_else(|| font8x8::LATIN_FONTS.get(character))
            .or_else(|| font8x8::BASIC_FONTS.get('?'));
        let rows = known.unwrap_or([0; 8]);
        // The lowest bit is the leftmost column.
        let used = rows.iter().fold(0_u8, |all, row| all | row);
        if used == 0 {
            return Self { rows, columns: 3 };
        }
        let shift = used.trailing_zeros();
        Self { rows: rows.map(|row| row >> shift), columns: 8 - shift - used.leading_zeros() }
    }

    /// Pixels to the start of the next glyph.
    fn advance(&self, height: usize) -> f64 {
        (f64::from(self.columns) + 1.25) * height as f64 / 8.0
    }

    fn outline(&self) -> Vec<bool> {
        let mut bits: Vec<bool> = (0..64).map(|i| self.rows[i / 8] >> (i % 8) & 1 == 1).collect();
        for doubling in 0..DOUBLINGS {
            bits = scale2x(&bits, 8 << doubling);
        }
        bits
    }
}

/// Doubles a bitmap and rounds its corners.
fn scale2x(bits: &[bool], side: usize) -> Vec<bool> {
    let at = |x: isize, y: isize| {
        let inside = |v: isize| (0..side as isize).contains(&v);
        inside(x) && inside(y) && bits[y as usize * side + x as usize]
    };
    let mut out = vec![false; 4 * bits.len()];
    for y in 0..side as isize {
        for x in 0..side as isize {
            let (up, down) = (at(x, y - 1), at(x, y + 1));
            let (left, right) = (at(x - 1, y), at(x + 1, y));
            let corner = |a: bool, b: bool, opposite_a: bool, opposite_b: bool| {
                if a == b && a != opposite_a && b != opposite_b { a } else { at(x, y) }
            };
            let first = (2 * y as usize) * 2 * side + 2 * x as usize;
            out[first] = corner(up, left, down, right);
            out[first + 1] = corner(up, right, down, left);
            out[first + 2 * side] = corner(down, left, up, right);
            out[first + 2 * side + 1] = corner(down, right, up, left);
        }
    }
    out
}

/// The part of a pixel at (x, y), in pixels of a glyph `height` high, that its outline covers.
fn coverage(outline: &[bool], height: usize, x: f64, y: f64) -> f64 {
    const N: usize = 4;
    let scale = OUTLINE as f64 / height as f64;
    let hit = |i: usize| {
        let sample = |v: f64, k: usize| ((v + (k as f64 + 0.5) / N as f64) * scale).floor();
        let (u, v) = (sample(x, i % N), sample(y, i / N));
        let side = OUTLINE as f64;
        let inside = u >= 0.0 && v >= 0.0 && u < side && v < side;
        inside && outline[v as usize * OUTLINE + u as usize]
    };
    (0..N * N).filter(|i| hit(*i)).count() as f64 / (N * N) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_png_reads_back_as_drawn() {
        let mut canvas = Canvas::new(5, 3, [1, 2, 3]);
        canvas.set(4, 2, [200, 100, 50]);
        canvas.set(5, 0, [9, 9, 9]);
        let read = image::load_from_memory(&canvas.png()).unwrap().to_rgb8();
        assert_eq!((read.width(), read.height()), (5, 3));
        assert_eq!(read.get_pixel(0, 0).0, [1, 2, 3]);
        assert_eq!(read.get_pixel(4, 2).0, [200, 100, 50]);
    }

    #[test]
    fn text_leaves_ink_within_its_width_and_never_beyond_the_page() {
        let mut canvas = Canvas::new(200, 40, [0; 3]);
        canvas.text(10, 5, 16, [255; 3], "d2 = 3.71 %");
        let width = text_width(16, "d2 = 3.71 %");
        let inked = |x: usize| (0..40).any(|y| canvas.pixels[y * 200 + x][0] > 128);
        assert!(
            (10..10 + width).any(inked) && !(10 + width..200).any(inked) && !(0..10).any(inked)
        );
        canvas.text(190, 35, 16, [255; 3], "off the page");
    }

    #[test]
    fn unknown_characters_are_marked() {
        assert_eq!(Glyph::of('\u{1F41F}').rows, Glyph::of('?').rows);
        assert_ne!(Glyph::of('×').rows, Glyph::of('?').rows);
    }
}
