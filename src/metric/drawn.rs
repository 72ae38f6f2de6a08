//! One view of a scene, drawn so that it can be differentiated: which triangle is seen in each
//! pixel, and how its luminance there depends on its corners.
//!
//! Invariants:
//! 1. what is seen where is what the evaluators see: the same lattice, the same ties;
//! 2. luminances are not rounded, so that they have derivatives; where light and what is given off are more than
//!    white, nothing changes.

use std::ops::Range;

use glam::{DVec2, DVec3};

use crate::render::{
    NOTHING, Nearest, Painted, Scene, SceneFace, Shading,
    view::{Projection, View},
};

use super::{
    attributes::Attributes,
    shade::Shade,
    shown::Shown,
    slopes::{Drag, Slopes},
};

/// The most that a picture shows.
const WHITE: f64 = 255.0;

/// See the module.
pub struct Drawn<'s> {
    scene: &'s Scene,
    view: usize,
    size: usize,
    /// By pixel: the triangle seen there, or [`NOTHING`].
    ids: Vec<u32>,
    /// By pixel: how far away it is.
    depths: Vec<i32>,
    /// By triangle.
    shades: Vec<Shade>,
    /// By triangle.
    sides: Vec<[Side; 3]>,
    /// By triangle; empty where there are no textures.
    paints: Vec<Option<Painted>>,
    /// By pixel: what the texture seen there lets through; empty where there are no textures.
    texels: Vec<f32>,
    /// By pixel: what the texture seen there gives off, 0 to 255; empty where none gives off anything.
    glows: Vec<f32>,
    /// By these is differentiated, too.
    attributes: Option<&'s Attributes>,
}

/// What a triangle's pixels add up to.
#[derive(Clone, Copy, Default)]
struct Seen {
    n: f64,
    /// Luminance too much, weighted by what the pixel has of the triangle's mean luminance.
    off: f64,
    /// The same, weighted by the corners' shares; and the sums of the squares of these.
    off_by_share: [f64; 3],
    squares: [f64; 3],
    /// What changes as the ends of its sides move along the sides' axes: slopes and bends.
    sides: [[[f64; 2]; 2]; 3],
    /// What changes as the corners take the texture along.
    drags: [Drag; 3],
    /// What changes as the corners move on the texture, the other way.
    turns: [Drag; 3],
}

impl Seen {
    /// Slope and bend by the luminance of a corner.
    fn by_corner(&self, k: usize) -> (f64, f64) {
        (2.0 * self.off_by_share[k], 2.0 * self.squares[k])
    }
}

impl<'s> Drawn<'s> {
    /// Draws one view.
    pub fn new(scene: &'s Scene, view: usize, attributes: Option<&'s Attributes>) -> Self {
        let size = scene.lattice.size as usize;
        let points: Vec<DVec2> =
            (0..scene.n_vertex_slots() as u32).map(|v| on_picture(scene, view, v)).collect();
        let nearest = Nearest::of(scene, view);
        let is_seen = nearest.faces_seen(scene.faces.len());
        let Nearest { ids, depths, .. } = nearest;
        let mut this = Self {
            scene,
            view,
            size,
            ids,
            depths,
            shades: vec![Shade::default(); scene.faces.len()],
            sides: vec![<[Side; 3]>::default(); scene.faces.len()],
            paints: vec![None; if scene.texels.is_empty() { 0 } else { scene.faces.len() }],
            texels: Vec::new(),
            glows: Vec::new(),
            attributes,
        };
        for (id, face) in scene.faces.iter().enumerate() {
            let Some(face) = face.as_ref().filter(|_| is_seen[id]) else { continue };
            this.shades[id] = Shade::of(scene, view, face, (&points, this.has_colours(id as u32)));
            this.sides[id] = Side::all(face, &points);
            if let Some(paint) = this.paints.get_mut(id) {
                *paint = scene.painted(view, face);
            }
        }
        if !this.paints.is_empty() {
            let seen =
                |p| this.paint(this.ids[p]).map_or(1.0, |paint| this.look_up(paint, p) as f32);
            this.texels = (0..size * size).map(seen).collect();
        }
        if scene.texels.has_glow() {
            let seen =
                |p| this.paint(this.ids[p]).map_or(0.0, |paint| this.glow_of(paint, p) as f32);
            this.glows = (0..size * size).map(seen).collect();
        }
        this
    }

    /// Adds energy and slopes.
    pub fn differentiate(&self, shown: Shown<'_>, sum: &mut Slopes) {
        let mut seen = vec![Seen::default(); self.shades.len()];
        for start in (0..self.ids.len()).step_by(self.size) {
            let (row, end) = (&self.ids[start..][..self.size], start + self.size);
            let mut at = start;
            for run in row.chunk_by(|a, b| a == b) {
                let energy = self.see(run[0], shown, at..at + run.len(), &mut seen);
                sum.energy += energy;
                if let Some(of_face) = sum.faces.get_mut(run[0] as usize) {
                    *of_face += energy;
                }
                at += run.len();
                if at < end {
                    self.across(shown, [at - 1, at], Axis::X, &mut seen);
                }
            }
            let below = self.ids.get(end..).unwrap_or_default();
            for (at, (a, b)) in (start..).zip(row.iter().zip(below)) {
                if a != b {
                    self.across(shown, [at, at + self.size], Axis::Y, &mut seen);
                }
            }
        }
        self.add_up(&seen, sum);
    }

    /// Adds a run of pixels that show one triangle to what is seen of it. Returns their energy.
    fn see(&self, id: u32, shown: Shown<'_>, pixels: Range<usize>, seen: &mut [Seen]) -> f64 {
        let paint = self.paint(id);
        let is_flat = self.scene.params.shading == Shading::Flat;
        let is_even = self.shades.get(id as usize).is_none_or(Shade::is_even);
        if id == NOTHING || (is_flat && is_even && paint.is_none() && !self.has_colours(id)) {
            let lum = self.luminance(id, pixels.start);
            let [n, sum, squares] = shown.sums(pixels);
            if let Some(seen) = seen.get_mut(id as usize) {
                seen.n += n;
                seen.off += n * lum - sum;
            }
            return n * lum * lum - 2.0 * lum * sum + squares;
        }
        let (shade, seen) = (&self.shades[id as usize], &mut seen[id as usize]);
        let on_texture = paint.filter(|_| self.attributes.is_some_and(|a| a.has_coordinates(id)));
        let mean = shade.corners.iter().sum::<f64>() / 3.0;
        let mut energy = 0.0;
        for pixel in pixels {
            let weight = shown.weight(pixel);
            let (bare, texel) = (self.bare_luminance(id, pixel), self.texel(id, pixel));
            let (lum, is_full) = with_glow(bare * texel, self.glow(id, pixel));
            let off = lum - f64::from(shown.picture[pixel]);
            energy += weight * (off * off);
            if is_full {
                continue;
            }
            let of_mean = if is_flat && !is_even { texel * bare / mean } else { texel };
            seen.n += weight * (of_mean * of_mean);
            seen.off += weight * (off * of_mean);
            for (k, share) in shade.shares_at(pixel, self.size).into_iter().enumerate() {
                seen.off_by_share[k] += weight * (off * texel * share);
                seen.squares[k] += weight * (texel * share).powi(2);
                if paint.is_some() {
                    seen.drags[k].add(weight, off, self.slope(id, pixel, (share, bare)));
                }
            }
            if let Some(paint) = on_texture {
                self.turn(paint, pixel, (weight, off, bare), &mut seen.turns);
            }
        }
        energy
    }

    /// Adds what changes in a pixel as corners move on the texture.
    fn turn(
        &self,
        paint: &Painted,
        pixel: usize,
        (weight, off, bare): (f64, f64, f64),
        turns: &mut [Drag; 3],
    ) {
        let (i, j) = ((pixel % self.size) as i32, (pixel / self.size) as i32);
        let slope = paint.slope(self.scene.texels.words(), i, j);
        let by =
            DVec2::from_array(slope.luminance) * (bare / 255.0) + DVec2::from_array(slope.glow);
        for (turn, share) in turns.iter_mut().zip(slope.shares) {
            turn.add(weight, off, share * by);
        }
    }

    /// Whether a triangle has vertex colours by which is differentiated.
    fn has_colours(&self, id: u32) -> bool {
        self.attributes.is_some_and(|a| a.has_colours(id))
    }

    /// Adds what changes where two neighbouring pixels show different triangles.
    fn across(&self, shown: Shown<'_>, pixels: [usize; 2], axis: Axis, seen: &mut [Seen]) {
        let Some((id, k, at)) = self.side_between(pixels, axis) else { return };
        // Both at the edge: smooth surfaces do not jump where two triangles meet.
        let at_edge = |id| 0.5 * pixels.iter().map(|p| self.luminance(id, *p)).sum::<f64>();
        let lum = pixels.map(|p| at_edge(self.ids[p]));
        let weights = pixels.map(|p| shown.weight(p));
        let square = |l: f64, p: usize| shown.weight(p) * (l - f64::from(shown.picture[p])).powi(2);
        // As the edge moves on, the first pixel's triangle gains ground from the second's.
        let change = |p: &usize| square(lum[0], *p) - square(lum[1], *p);
        let slope = 0.5 * pixels.iter().map(change).sum::<f64>();
        let bend = (weights[0] + weights[1]) * (lum[0] - lum[1]).powi(2);
        let sums = &mut seen[id as usize].sides[k];
        for (sum, share) in sums.iter_mut().zip([1.0 - at, at]) {
            sum[0] += slope * share;
            sum[1] += bend * share * share;
        }
    }

    /// The edge that separates two neighbouring pixels, of the nearer triangle first: the triangle, the
    /// number of the side, and where along it.
    fn side_between(&self, pixels: [usize; 2], axis: Axis) -> Option<(u32, usize, f64)> {
        let keys = pixels.map(|p| (self.depths[p], self.ids[p]));
        let [nearer, farther] = if keys[0] < keys[1] { keys } else { [keys[1], keys[0]] };
        let pixel = [pixels[0] % self.size, pixels[0] / self.size].map(|c| c as f64 + 0.5);
        let from = axis.turned(DVec2::from_array(pixel));
        [nearer.1, farther.1].into_iter().find_map(|id| {
            let sides = self.sides.get(id as usize)?;
            (0..3).find_map(|k| Some((id, k, sides[k].crossing(from, axis)?)))
        })
    }

    /// Adds what was seen of every triangle.
    fn add_up(&self, seen: &[Seen], sum: &mut Slopes) {
        let (view, size) = (&self.scene.views[self.view], self.size as f64);
        let motions: Vec<[DVec3; 2]> = (0..sum.places.len() as u32)
            .map(|v| motion(view, self.scene.position(v), size))
            .collect();
        self.inside(seen, &motions, sum);
        for (sides, seen) in self.sides.iter().zip(seen) {
            for (side, sums) in sides.iter().zip(seen.sides) {
                // What was not seen has no part: neither have sides without a length.
                let ends = side.ends.into_iter().zip(sums).filter(|(_, sums)| *sums != [0.0; 2]);
                for (v, [slope, bend]) in ends {
                    let along = side.along(motions[v as usize]);
                    sum.places[v as usize].add(slope, bend, along);
                }
            }
        }
    }

    /// Adds what changes inside triangles.
    fn inside(&self, seen: &[Seen], motions: &[[DVec3; 2]], sum: &mut Slopes) {
        for (id, (face, shade)) in self.scene.faces.iter().zip(&self.shades).enumerate() {
            let seen = &seen[id];
            let Some(face) = face.filter(|_| seen.n > 0.0) else { continue };
            if let Some(attributes) = self.attributes {
                let by_albedo = [0, 1, 2].map(|k| {
                    let (slope, bend) = seen.by_corner(k);
                    (slope * shade.lights[k], bend * shade.lights[k].powi(2))
                });
                let channel = self.scene.views[self.view].channel;
                attributes.add_up((id as u32, channel), &seen.turns, by_albedo, sum);
            }
            if !self.paints.is_empty() {
                for (v, drag) in face.vertices.iter().zip(&seen.drags) {
                    drag.add_to(&mut sum.places[*v as usize], motions[*v as usize]);
                }
            }
            match self.scene.params.shading {
                Shading::Flat => {
                    for (v, by) in face.vertices.iter().zip(shade.by) {
                        sum.places[*v as usize].add(2.0 * seen.off, 2.0 * seen.n, by);
                    }
                }
                Shading::Smooth => {
                    for (k, v) in face.vertices.iter().enumerate() {
                        let (slope, bend) = seen.by_corner(k);
                        sum.normals[*v as usize].add(slope, bend, shade.by[k]);
                    }
                }
            }
            if self.scene.params.shading == Shading::Smooth || !shade.is_even() {
                travel(&face, shade, seen, motions, sum);
            }
        }
    }

    /// The triangle seen in a pixel, or [`NOTHING`].
    pub(super) fn id(&self, pixel: usize) -> u32 {
        self.ids[pixel]
    }

    /// The luminance of a triangle in a pixel, in which another may be seen.
    pub(super) fn luminance(&self, id: u32, pixel: usize) -> f64 {
        with_glow(self.bare_luminance(id, pixel) * self.texel(id, pixel), self.glow(id, pixel)).0
    }

    fn paint(&self, id: u32) -> Option<&Painted> {
        self.paints.get(id as usize)?.as_ref()
    }

    /// What the texture lets through, 0 to 1.
    fn texel(&self, id: u32, pixel: usize) -> f64 {
        match self.texels.get(pixel) {
            Some(texel) if self.ids[pixel] == id => f64::from(*texel),
            _ => self.paint(id).map_or(1.0, |paint| self.look_up(paint, pixel)),
        }
    }

    fn look_up(&self, paint: &Painted, pixel: usize) -> f64 {
        let (i, j) = ((pixel % self.size) as i32, (pixel / self.size) as i32);
        f64::from(paint.at(self.scene.texels.words(), i, j)) / 255.0
    }

    /// What the texture gives off, 0 to 255.
    fn glow(&self, id: u32, pixel: usize) -> f64 {
        match self.glows.get(pixel) {
            None => 0.0,
            Some(glow) if self.ids[pixel] == id => f64::from(*glow),
            Some(_) => self.paint(id).map_or(0.0, |paint| self.glow_of(paint, pixel)),
        }
    }

    fn glow_of(&self, paint: &Painted, pixel: usize) -> f64 {
        let (i, j) = ((pixel % self.size) as i32, (pixel / self.size) as i32);
        f64::from(paint.glow(self.scene.texels.words(), i, j))
    }

    /// How a share of the luminance changes with the texture from pixel to pixel, rightwards and downwards; `bare` is
    /// the luminance without it.
    fn slope(&self, id: u32, pixel: usize, (share, bare): (f64, f64)) -> DVec2 {
        let through = share * bare * self.change(&self.texels, id, pixel);
        if self.glows.is_empty() {
            return through;
        }
        through + share * self.change(&self.glows, id, pixel)
    }

    /// How values by pixel change, as far as the same triangle is seen beside the pixel.
    fn change(&self, values: &[f32], id: u32, pixel: usize) -> DVec2 {
        let here = f64::from(values[pixel]);
        let along = |step: usize, is_inside: [bool; 2]| {
            let beside = [pixel.wrapping_sub(step), pixel + step];
            let seen = [0, 1].map(|k| is_inside[k] && self.ids.get(beside[k]) == Some(&id));
            let at = |k: usize| if seen[k] { f64::from(values[beside[k]]) } else { here };
            let n = f64::from(u8::from(seen[0]) + u8::from(seen[1]));
            if n > 0.0 { (at(1) - at(0)) / n } else { 0.0 }
        };
        let column = pixel % self.size;
        let inside = [column > 0, column + 1 < self.size];
        DVec2::new(along(1, inside), along(self.size, [pixel >= self.size, true]))
    }

    /// [`Self::luminance`] without the texture.
    fn bare_luminance(&self, id: u32, pixel: usize) -> f64 {
        let Some(shade) = self.shades.get(id as usize) else {
            return f64::from(self.scene.params.background);
        };
        let [a, b, c] = shade.corners;
        if shade.is_even() {
            return a;
        }
        let shares = shade.shares_at(pixel, self.size);
        let sum: f64 = (0..3).map(|k| shares[k] * shade.corners[k]).sum();
        sum.max(a.min(b).min(c)).min(a.max(b).max(c))
    }
}

/// A luminance with what is given off added, and whether that is more than white.
fn with_glow(luminance: f64, glow: f64) -> (f64, bool) {
    let sum = luminance + glow;
    let is_full = glow > 0.0 && sum > WHITE;
    (if is_full { WHITE } else { sum }, is_full)
}

/// Adds what changes inside a triangle with interpolated luminance: luminances travel with the corners.
fn travel(face: &SceneFace, shade: &Shade, seen: &Seen, motions: &[[DVec3; 2]], sum: &mut Slopes) {
    let gradient =
        |axis: usize| -> f64 { (0..3).map(|k| shade.shares[axis][k] * shade.corners[k]).sum() };
    let (right, down) = (gradient(1), gradient(2));
    for (k, v) in face.vertices.iter().enumerate() {
        let (slope, bend) = seen.by_corner(k);
        let [dx, dy] = motions[*v as usize];
        sum.places[*v as usize].add(slope, bend, -(right * dx + down * dy));
    }
}

/// Where a vertex is drawn, in pixels from the upper left corner.
fn on_picture(scene: &Scene, view: usize, v: u32) -> DVec2 {
    let (p, lattice) = (scene.screen_points(v)[view], &scene.lattice);
    let step = f64::from(1 << lattice.sub_bits);
    let pixel = |c: i16| f64::from(i32::from(c) - lattice.first_center) / step + 0.5;
    DVec2::new(pixel(p.x), pixel(p.y))
}

/// The direction from a pixel to its neighbour.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
enum Axis {
    #[default]
    X,
    Y,
}

impl Axis {
    /// A point whose `x` runs along the axis.
    fn turned(self, p: DVec2) -> DVec2 {
        if self == Self::X { p } else { DVec2::new(p.y, p.x) }
    }
}

/// A side of a triangle in a picture, turned to the axis across which it rather runs than along it.
#[derive(Clone, Copy, Default)]
struct Side {
    ends: [u32; 2],
    axis: Axis,
    from: DVec2,
    to: DVec2,
    /// Change along the axis for each pixel across it.
    slant: f64,
}

impl Side {
    fn all(face: &SceneFace, points: &[DVec2]) -> [Self; 3] {
        let corner = |k: usize| face.vertices[k % 3];
        std::array::from_fn(|k| {
            let ends = [corner(k), corner(k + 1)];
            let [p, q] = ends.map(|v| points[v as usize]);
            let by = q - p;
            let axis = if by.x.abs() > by.y.abs() { Axis::Y } else { Axis::X };
            let (from, to) = (axis.turned(p), axis.turned(q));
            let slant = (to.x - from.x) / (to.y - from.y);
            Self { ends, axis, from, to, slant }
        })
    }

    /// Where on its way from one end to the other it runs between a pixel's centre and the next one's
    /// along the axis, if it does.
    fn crossing(&self, center: DVec2, axis: Axis) -> Option<f64> {
        if self.axis != axis || (self.from.y > center.y) == (self.to.y > center.y) {
            return None;
        }
        let x = self.from.x + (center.y - self.from.y) * self.slant;
        let is_between = (center.x..=center.x + 1.0).contains(&x);
        is_between.then(|| (center.y - self.from.y) / (self.to.y - self.from.y))
    }

    /// How far it moves along its axis, from how an end moves in the picture.
    fn along(&self, [dx, dy]: [DVec3; 2]) -> DVec3 {
        match self.axis {
            Axis::X => dx - self.slant * dy,
            Axis::Y => dy - self.slant * dx,
        }
    }
}

/// How a point's picture moves, in pixels to the right and down, with its place.
fn motion(view: &View, p: DVec3, size: f64) -> [DVec3; 2] {
    let at = view.project(p);
    // To the right, the distance along the view axis stays the same.
    let scale = view.project(p + view.right).x - at.x;
    let away = match view.projection {
        Projection::Perspective => view.back / -(p - view.eye).dot(view.back),
        Projection::Orthographic => DVec3::ZERO,
    };
    let (dx, dy) =
        (scale * view.right + (at.x - 0.5) * away, (at.y - 0.5) * away - scale * view.up);
    [size * dx, size * dy]
}
