//! Contact sheets: original, simplified and difference side by side, for eyes.
//!
//! Invariants:
//! 1. pictures are drawn with the same light and material as those that d2 is taken of;
//! 2. the cameras are those of the original's bounding sphere, upright;
//! 3. the figure in a difference picture is that view's own d2, taken before any scaling.
//!
//! Knows nothing of files: PNG bytes come out.

use glam::DVec3;
use image::{ImageBuffer, imageops};
use rayon::prelude::*;

use super::{
    canvas::{Canvas, Rgb, text_width},
    evaluate::{NEVER_ENDS, Part, Tick, view_params},
    raster::{Appearance, Drawable, Look, pictures},
};
use crate::{
    mesh::Mesh,
    metric::{
        bounding_sphere,
        image::{REC709, d2_percent, mean_square_difference, srgb_from_linear},
    },
    render::view::{View, camera},
};

/// A coordinate axis of the model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Axis {
    /// First.
    X,
    /// Second; up in glTF.
    #[default]
    Y,
    /// Third; up in most CAD and scan data.
    Z,
}

/// A picture of a contact sheet.
#[derive(Clone, Debug, PartialEq)]
pub struct SheetView {
    /// Its caption.
    pub name: String,
    /// Direction from the model's centre to the eye (any length but 0).
    pub direction: DVec3,
}

impl SheetView {
    /// A view named after the axis that it looks along the most.
    pub fn from_direction(direction: DVec3) -> Self {
        let axis = direction.abs().max_position();
        let sign = if direction[axis] < 0.0 { '-' } else { '+' };
        Self { name: format!("from {sign}{}", ["x", "y", "z"][axis]), direction }
    }
}

/// What a contact sheet shows.
#[derive(Clone, Debug, PartialEq)]
pub struct SheetParams {
    /// Size (as drawn), shading, material and light of the pictures.
    pub look: Look,
    /// Full field of view, degrees.
    pub fov_degrees: f64,
    /// Angle between the directions to the eye and to the light, degrees.
    pub light_degrees: f64,
    /// Which axis points to the top of the pictures.
    pub up: Axis,
    /// The views, one row each.
    pub views: Vec<SheetView>,
    /// Pixels along each side of a picture on the sheet.
    pub tile: usize,
    /// How many times luminance differences are amplified.
    pub gain: f64,
    /// In smooth shading, simplified meshes have the normals of their files (see [`super::Params`]).
    pub stored_normals: bool,
}

/// Nine samples a pixel, drawn at the size of the sheet: a third of the work of the pictures that
/// d2 is stated for, and no scaling.
fn look_of(tile: usize) -> Look {
    Look { image_size: tile, supersampling: 3, ..Look::default() }
}

impl Default for SheetParams {
    fn default() -> Self {
        Self {
            look: look_of(384),
            fov_degrees: 60.0,
            light_degrees: 10.0,
            up: Axis::Y,
            views: all_round_views(Axis::Y),
            tile: 384,
            gain: 4.0,
            stored_normals: false,
        }
    }
}

impl SheetParams {
    /// Two views at a smaller size: fit for a whole chain of levels on one page.
    pub fn chain(up: Axis) -> Self {
        let (up_axis, toward, side) = axes(up);
        let views = [
            toward * 0.8 + side * 0.5 + up_axis * 0.3,
            -toward * 0.9 + side * 0.3 + up_axis * 0.35,
        ];
        let views = views.into_iter().map(SheetView::from_direction).collect();
        Self { look: look_of(288), up, views, tile: 288, ..Self::default() }
    }

    /// Pictures of the same surface as those of `look`, at the sheet's own size and light.
    #[must_use]
    pub fn of_surface(mut self, look: &Look) -> Self {
        let Look { shading, appearance, hides_back_faces, .. } = *look;
        self.look = Look { shading, appearance, hides_back_faces, ..self.look };
        self
    }

    /// With the normals of simplified meshes' files, or without.
    #[must_use]
    pub fn with_stored_normals(self, stored_normals: bool) -> Self {
        Self { stored_normals, ..self }
    }

    fn dressed<'m, const N: usize>(&self, drawable: Drawable<'m, N>) -> Drawable<'m, N> {
        if self.stored_normals { drawable.with_stored_normals() } else { drawable }
    }

    /// As the original is drawn.
    fn of_original(&self) -> Self {
        self.clone().with_stored_normals(false)
    }
}

/// Five views: from all sides, a little from above, and from below.
pub fn all_round_views(up: Axis) -> Vec<SheetView> {
    let (up, toward, side) = axes(up);
    let views = [
        toward + 0.25 * up,
        side + 0.25 * up,
        -toward + 0.25 * up,
        -side + 0.25 * up,
        0.3 * side - up,
    ];
    views.into_iter().map(SheetView::from_direction).collect()
}

/// Draws rows of original, simplified and difference; returns a PNG file.
pub fn sheet(original: &Mesh, simplified: &Mesh, params: &SheetParams) -> Vec<u8> {
    let Ok(png) = try_sheet(original, simplified, params, NEVER_ENDS);
    png
}

/// [`sheet`], which may be ended: [`Part::Sheet`].
pub fn try_sheet<E: Send>(
    original: &Mesh,
    simplified: &Mesh,
    params: &SheetParams,
    tick: Tick<'_, E>,
) -> Result<Vec<u8>, E> {
    let half = |part: Part, share: f64| tick(part, share / 2.0);
    let reference = Portraits::try_new(original, original, &params.of_original(), &half)?;
    let portraits = Portraits::try_new(original, simplified, params, &half)?;
    Ok(sheet_against(&reference, &portraits, (original, simplified), params))
}

/// [`sheet`] for each level, in parallel; the original is drawn once.
pub fn sheets(original: &Mesh, levels: &[&Mesh], params: &SheetParams) -> Vec<Vec<u8>> {
    let reference = Portraits::new(original, original, &params.of_original());
    let draw = |mesh: &&Mesh| {
        let portraits = Portraits::new(original, mesh, params);
        sheet_against(&reference, &portraits, (original, mesh), params)
    };
    levels.par_iter().map(draw).collect()
}

fn sheet_against(
    reference: &Portraits,
    portraits: &Portraits,
    (original, simplified): (&Mesh, &Mesh),
    params: &SheetParams,
) -> Vec<u8> {
    let tile = params.tile.max(1);
    let page = Page { tile, columns: 3, rows: params.views.len() };
    let mut canvas = page.canvas();
    page.heading(&mut canvas, 0, "Original", &count(original));
    page.heading(&mut canvas, 1, "Simplified", &share(original, simplified));
    let overall = d2_percent(&portraits.mean_squares(reference));
    page.heading(&mut canvas, 2, "Difference", &format!("d2 {overall:.2} % over these views"));
    for (row, view) in params.views.iter().enumerate() {
        page.picture(&mut canvas, 0, row, &reference.shown(row, tile), &view.name);
        page.picture(&mut canvas, 1, row, &portraits.shown(row, tile), "");
        let (difference, caption) = portraits.difference(reference, row, params);
        page.picture(&mut canvas, 2, row, &difference, &caption);
    }
    page.legend(&mut canvas, params.gain);
    canvas.png()
}

/// Draws a chain of levels: a column each, and for every view a row of pictures and a row of
/// differences from the original; returns a PNG file.
pub fn sheet_multi(original: &Mesh, levels: &[&Mesh], params: &SheetParams) -> Vec<u8> {
    let reference = Portraits::new(original, original, &params.of_original());
    let all: Vec<Portraits> =
        levels.par_iter().map(|mesh| Portraits::new(original, mesh, params)).collect();
    let tile = params.tile.max(1);
    let page = Page { tile, columns: 1 + levels.len(), rows: 2 * params.views.len() };
    let mut canvas = page.canvas();
    page.heading(&mut canvas, 0, "Original", &count(original));
    for (row, view) in params.views.iter().enumerate() {
        page.picture(&mut canvas, 0, 2 * row, &reference.shown(row, tile), &view.name);
        page.note(&mut canvas, 0, 2 * row + 1, &["difference", "from the original"]);
    }
    for (level, (mesh, portraits)) in levels.iter().zip(&all).enumerate() {
        let column = level + 1;
        page.heading(&mut canvas, column, &format!("LOD {level}"), &short_share(original, mesh));
        for row in 0..params.views.len() {
            page.picture(&mut canvas, column, 2 * row, &portraits.shown(row, tile), "");
            let (difference, caption) = portraits.difference(&reference, row, params);
            page.picture(&mut canvas, column, 2 * row + 1, &difference, &caption);
        }
    }
    page.legend(&mut canvas, params.gain);
    canvas.png()
}

/// The pictures of one mesh, as large as drawn.
struct Portraits {
    /// Pixels along each side.
    side: usize,
    /// What differences are taken of.
    luminance: Vec<Vec<[f32; 1]>>,
    /// What is shown, if that is not the luminance.
    coloured: Option<Vec<Vec<[f32; 3]>>>,
}

impl Portraits {
    fn new(original: &Mesh, mesh: &Mesh, params: &SheetParams) -> Self {
        let Ok(portraits) = Self::try_new(original, mesh, params, NEVER_ENDS);
        portraits
    }

    fn try_new<E: Send>(
        original: &Mesh,
        mesh: &Mesh,
        params: &SheetParams,
        tick: Tick<'_, E>,
    ) -> Result<Self, E> {
        let (views, look) = (sheet_cameras(original, params), &params.look);
        let has_colours = look.appearance == Appearance::Coloured;
        let n_passes = if has_colours { 2.0 } else { 1.0 };
        let tick = |share: f64| tick(Part::Sheet, share / n_passes);
        let coloured = has_colours
            .then(|| pictures(&params.dressed(Drawable::display(mesh, look)), &views, look, &tick))
            .transpose()?;
        let drawable = params.dressed(Drawable::luminance(mesh, look));
        let luminance = pictures(&drawable, &views, look, &tick)?;
        Ok(Self { side: look.image_size.max(1), luminance, coloured })
    }

    /// One view in the colours of the screen.
    fn shown(&self, view: usize, tile: usize) -> Vec<Rgb> {
        let byte = |value: f32| (value * 255.0).round().clamp(0.0, 255.0) as u8;
        let channels: Vec<[f32; 3]> = match &self.coloured {
            Some(coloured) => coloured[view].clone(),
            None => self.luminance[view].iter().map(|[y]| [*y; 3]).collect(),
        };
        resized(self.side, tile, &channels).into_iter().map(|pixel| pixel.map(byte)).collect()
    }

    /// The amplified difference of one view, and its caption.
    fn difference(
        &self,
        reference: &Self,
        view: usize,
        params: &SheetParams,
    ) -> (Vec<Rgb>, String) {
        let (a, b) = (&reference.luminance[view], &self.luminance[view]);
        let amplified: Vec<[f32; 3]> =
            a.iter().zip(b).map(|([a], [b])| [(a - b).abs() * params.gain as f32; 3]).collect();
        let tile = resized(self.side, params.tile.max(1), &amplified);
        let d2 = d2_percent(&[mean_square_difference(a.as_flattened(), b.as_flattened())]);
        let table: Vec<Rgb> = (0..HEATS).map(|i| heat(i as f64 / (HEATS - 1) as f64)).collect();
        let shade = |v: f32| (v.clamp(0.0, 1.0) * (HEATS - 1) as f32).round() as usize;
        (tile.iter().map(|[v, ..]| table[shade(*v)]).collect(), format!("d2 {d2:.2} %"))
    }

    fn mean_squares(&self, reference: &Self) -> Vec<f64> {
        let pairs = self.luminance.iter().zip(&reference.luminance);
        pairs.map(|(a, b)| mean_square_difference(a.as_flattened(), b.as_flattened())).collect()
    }
}

/// Upright cameras of the sheet's views.
fn sheet_cameras(original: &Mesh, params: &SheetParams) -> Vec<View> {
    let sphere = bounding_sphere(original);
    let view_params = view_params(params.fov_degrees, params.light_degrees);
    let (up, ..) = axes(params.up);
    let upright = |view: &SheetView| {
        // Roll so that the axis, as the unrolled camera sees it, points to the top.
        let level = camera(&sphere, &view_params, view.direction, 0.0);
        let roll = libm::atan2(-up.dot(level.right), up.dot(level.up));
        camera(&sphere, &view_params, view.direction, roll / std::f64::consts::TAU)
    };
    params.views.iter().map(upright).collect()
}

/// The axis itself, then the one towards the viewer of the front view, then the one to the side.
fn axes(up: Axis) -> (DVec3, DVec3, DVec3) {
    match up {
        Axis::X => (DVec3::X, DVec3::Y, DVec3::Z),
        Axis::Y => (DVec3::Y, DVec3::Z, DVec3::X),
        Axis::Z => (DVec3::Z, DVec3::X, DVec3::Y),
    }
}

fn resized(side: usize, tile: usize, pixels: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let (from, to) = (side as u32, tile as u32);
    if from == to {
        return pixels.to_vec();
    }
    let Some(picture) =
        ImageBuffer::<image::Rgb<f32>, _>::from_raw(from, from, pixels.as_flattened())
    else {
        return vec![[0.0; 3]; tile * tile];
    };
    imageops::resize(&picture, to, to, imageops::FilterType::CatmullRom)
        .pixels()
        .map(|pixel| pixel.0)
        .collect()
}

/// Steps of the colours of differences: more than a byte can tell apart.
const HEATS: usize = 1024;

/// Black → red → yellow → white, for 0 to 1. The path is walked so that perceived lightness
/// (CIE L*) grows evenly: twice the value looks twice as light.
fn heat(value: f64) -> Rgb {
    let lightness = value.clamp(0.0, 1.0) * 100.0;
    let luminance =
        if lightness <= 8.0 { lightness / 903.3 } else { ((lightness + 16.0) / 116.0).powi(3) };
    // Red takes up all the luminance it can, then green what is left, then blue.
    let mut left = luminance;
    REC709.map(|weight| {
        let part = (left / weight).clamp(0.0, 1.0);
        left -= part * weight;
        (srgb_from_linear(part) * 255.0).round() as u8
    })
}

fn count(mesh: &Mesh) -> String {
    format!("{} triangles", thousands(mesh.faces.len()))
}

fn share(original: &Mesh, mesh: &Mesh) -> String {
    let percent = 100.0 * mesh.faces.len() as f64 / original.faces.len().max(1) as f64;
    format!("{} ({percent:.2} %)", count(mesh))
}

/// [`share`] for a narrow column.
fn short_share(original: &Mesh, mesh: &Mesh) -> String {
    let percent = 100.0 * mesh.faces.len() as f64 / original.faces.len().max(1) as f64;
    format!("{} ({percent:.1} %)", thousands(mesh.faces.len()))
}

/// A number with commas between thousands.
pub(super) fn thousands(n: usize) -> String {
    let digits = n.to_string();
    let mut out = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

const PAPER: Rgb = [22, 24, 29];
const INK: Rgb = [236, 238, 242];
const FAINT: Rgb = [150, 156, 168];
const MARGIN: usize = 28;
const GAP: usize = 10;
const HEADING: usize = 74;
const LEGEND: usize = 58;

/// Where things stand on a sheet.
struct Page {
    tile: usize,
    columns: usize,
    rows: usize,
}

impl Page {
    fn canvas(&self) -> Canvas {
        let across = |n: usize| n * (self.tile + GAP) + 2 * MARGIN - GAP;
        Canvas::new(across(self.columns), across(self.rows) + HEADING + LEGEND, PAPER)
    }

    fn corner(&self, column: usize, row: usize) -> (usize, usize) {
        let step = self.tile + GAP;
        (MARGIN + column * step, MARGIN + HEADING + row * step)
    }

    fn heading(&self, canvas: &mut Canvas, column: usize, title: &str, subtitle: &str) {
        let (x, _) = self.corner(column, 0);
        canvas.text(x, MARGIN, 24, INK, title);
        canvas.text(x, MARGIN + 36, 16, FAINT, subtitle);
    }

    fn picture(
        &self,
        canvas: &mut Canvas,
        column: usize,
        row: usize,
        picture: &[Rgb],
        caption: &str,
    ) {
        let (x, y) = self.corner(column, row);
        canvas.paste(x, y, self.tile, picture);
        canvas.text(x + 10, y + self.tile.saturating_sub(26), 16, INK, caption);
    }

    fn note(&self, canvas: &mut Canvas, column: usize, row: usize, lines: &[&str]) {
        let (x, y) = self.corner(column, row);
        for (line, text) in lines.iter().enumerate() {
            let indent = self.tile.saturating_sub(text_width(16, text) + 10);
            canvas.text(x + indent, y + self.tile / 2 + 26 * line, 16, FAINT, text);
        }
    }

    /// The colours of the differences and what they mean, below the last column.
    fn legend(&self, canvas: &mut Canvas, gain: f64) {
        let (x, y) = self.corner(self.columns.saturating_sub(1), self.rows);
        let y = y + 8;
        for i in 0..self.tile {
            let colour = heat(i as f64 / self.tile.saturating_sub(1).max(1) as f64);
            (0..12).for_each(|j| canvas.set(x + i, y + j, colour));
        }
        let full = format!("{:.0} %", 100.0 / gain.max(f64::MIN_POSITIVE));
        canvas.text(x, y + 20, 16, FAINT, "0");
        let right = x + self.tile.saturating_sub(text_width(16, &full));
        canvas.text(right, y + 20, 16, FAINT, &full);
        // Beside a single level there is less room.
        let texts = ["luminance difference", "difference"].map(|what| format!("{what} × {gain}"));
        let place = |what| Some((x.checked_sub(text_width(16, what) + 16)?, what));
        if let Some((left, what)) = texts.iter().find_map(|what| place(what)) {
            canvas.text(left, y, 16, FAINT, what);
        }
    }
}

#[cfg(test)]
#[path = "sheet_tests.rs"]
mod tests;
