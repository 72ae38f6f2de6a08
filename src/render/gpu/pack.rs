//! Moves as the kernels read them: vectors of four 32-bit words.
//!
//! Formats (the WGSL side is in common.wgsl and item.wgsl):
//! - a triangle is three vectors: corners `x | y << 16` in an order that makes the edge functions
//!   positive inside, and its flat luminance; depth plane with 16 fraction bits, and its id;
//!   luminance plane with 16 fraction bits, and 0;
//! - the ids of the triangles that go are padded with `NIL` to whole vectors;
//! - an item is two vectors: see `Item` in item.wgsl.

use super::super::{
    lattice::{DEPTH_BITS, PixelRect, ScreenPoint, Setup},
    moves::{Move, Projected},
    scene::Scene,
    tiles::TileBounds,
};
use super::lists::Geometry;

/// Vectors of a packed triangle.
pub(super) const TRIANGLE_WORDS: usize = 3;
/// Vectors of a packed item.
pub(super) const ITEM_WORDS: usize = 2;
/// No triangle, no address.
pub(super) const NIL: u32 = u32::MAX;

/// Four 32-bit words.
pub(super) type Word = [u32; 4];

/// A band of rows of one move in one view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Item {
    /// Index of the move in its batch.
    pub(super) owner: u32,
    /// Group of views.
    pub(super) group: u32,
    /// Address of the first pixel; column a multiple of four.
    pub(super) first: u32,
    /// Column and row of the first pixel.
    pub(super) at: (u32, u32),
    /// Columns of four pixels.
    pub(super) n_quads: u32,
    /// Rows.
    pub(super) n_rows: u32,
    /// Triangles that come: place among the data, number.
    pub(super) added: (u32, u32),
    /// Ids that go: place among the data, vectors.
    pub(super) removed: (u32, u32),
}

impl Item {
    /// The item as words, its data starting at `data_at`.
    pub(super) fn words(&self, data_at: u32) -> [Word; ITEM_WORDS] {
        [
            [self.first, self.at.0 | self.at.1 << 16, self.n_quads | self.n_rows << 16, 0],
            [self.added.0 + data_at, self.added.1, self.removed.0 + data_at, self.removed.1],
        ]
    }

    /// Pixels / 4.
    pub(super) fn n_cells(&self) -> u32 {
        self.n_quads * self.n_rows
    }
}

/// Items of several moves and the data they refer to.
#[derive(Clone, Debug, Default)]
pub(super) struct Packed {
    pub(super) items: Vec<Item>,
    pub(super) data: Vec<Word>,
}

impl Packed {
    /// Appends another pack's items and data.
    pub(super) fn append(&mut self, other: &Self) {
        let shift = self.data.len() as u32;
        self.data.extend_from_slice(&other.data);
        self.items.extend(other.items.iter().map(|item| Item {
            added: (item.added.0 + shift, item.added.1),
            removed: (item.removed.0 + shift, item.removed.1),
            ..*item
        }));
    }
}

/// Working memory for packing.
#[derive(Default)]
pub(super) struct Packer {
    pub(super) projected: Projected,
    setups: Vec<(u32, Word, Word, Word)>,
}

/// What of a move to pack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Purpose {
    /// To judge it: where everything is nearer than the move, nothing can change.
    Judge,
    /// To make it: hidden fragments change too.
    Make,
}

impl Packer {
    /// Packs a move in every view where it may matter.
    pub(super) fn pack(
        &mut self,
        scene: &Scene,
        geometry: &Geometry,
        bounds: &[TileBounds],
        (owner, mv): (u32, &Move),
        purpose: Purpose,
        out: &mut Packed,
    ) {
        self.projected.fill(scene, mv);
        let mut removed = None;
        for (view, bounds) in bounds.iter().enumerate() {
            let (rect, nearest_z) = self.projected.extent(&scene.lattice, view);
            if rect.is_empty()
                || (purpose == Purpose::Judge && bounds.hides(&rect, u32::from(nearest_z)))
            {
                continue;
            }
            let removed = *removed.get_or_insert_with(|| pack_ids(&mv.removed, &mut out.data));
            let added = self.pack_added(scene, mv, view, &mut out.data);
            push_bands(geometry, view, &rect, Bands { owner, added, removed }, &mut out.items);
        }
    }

    /// Triangles by ascending id, so that the lesser id wins a tie in depth.
    fn pack_added(
        &mut self,
        scene: &Scene,
        mv: &Move,
        view: usize,
        data: &mut Vec<Word>,
    ) -> (u32, u32) {
        let cull = scene.culls_front(view);
        self.setups.clear();
        for (k, added) in mv.added.iter().enumerate() {
            let points = self.projected.added_points(k, view);
            let lum = self.projected.added_luminance(scene, mv, k, view);
            if let Some(setup) = scene.lattice.setup(points, lum, cull) {
                let [a, b, c] = triangle(points, &setup, added.face);
                self.setups.push((added.face, a, b, c));
            }
        }
        self.setups.sort_unstable_by_key(|s| s.0);
        let at = data.len() as u32;
        data.extend(self.setups.iter().flat_map(|(_, a, b, c)| [*a, *b, *c]));
        (at, self.setups.len() as u32)
    }
}

fn pack_ids(ids: &[u32], data: &mut Vec<Word>) -> (u32, u32) {
    let at = data.len() as u32;
    data.extend(ids.chunks(4).map(|four| std::array::from_fn(|k| *four.get(k).unwrap_or(&NIL))));
    (at, data.len() as u32 - at)
}

/// A triangle as the kernels read it.
pub(super) fn triangle(
    points: [ScreenPoint; 3],
    setup: &Setup,
    face: u32,
) -> [Word; TRIANGLE_WORDS] {
    let x = points.map(|p| i32::from(p.x));
    let y = points.map(|p| i32::from(p.y));
    let area2 = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
    let corner = |k: usize| x[k] as u32 | (y[k] as u32) << 16;
    let (b, c) = if area2 < 0 { (2, 1) } else { (1, 2) };
    let scale = 16 - DEPTH_BITS;
    let (depth, lum) = (&setup.depth, &setup.lum);
    [
        [corner(0), corner(b), corner(c), lum.at_origin as u32 >> 16],
        [
            (depth.at_origin as u32) << scale,
            (depth.dx as u32) << scale,
            (depth.dy as u32) << scale,
            face,
        ],
        [lum.at_origin as u32, lum.dx as u32, lum.dy as u32, 0],
    ]
}

/// What all bands of a move in a view share.
struct Bands {
    owner: u32,
    added: (u32, u32),
    removed: (u32, u32),
}

/// Cuts the rectangle into bands of at most `geometry.band_cells` × 4 pixels.
fn push_bands(
    geometry: &Geometry,
    view: usize,
    rect: &PixelRect,
    shared: Bands,
    items: &mut Vec<Item>,
) {
    let (x, y0, y1) = (rect.x0 as u32 & !3, rect.y0 as u32, rect.y1 as u32);
    let n_quads = (rect.x1 as u32 - x) / 4 + 1;
    // Wide rectangles are cut into columns too: one row of a large picture may exceed a band.
    for part in (0..n_quads).step_by(geometry.band_cells as usize) {
        let n_quads = (n_quads - part).min(geometry.band_cells);
        let rows = (geometry.band_cells / n_quads).max(1);
        for y in (y0..=y1).step_by(rows as usize) {
            let at = (x + 4 * part, y);
            items.push(Item {
                owner: shared.owner,
                group: geometry.group_of(view),
                first: geometry.address(view, at.0, at.1),
                at,
                n_quads,
                n_rows: rows.min(y1 + 1 - y),
                added: shared.added,
                removed: shared.removed,
            });
        }
    }
}
