//! Moves as the kernels read them: words of four 32-bit numbers.
//!
//! Formats (the WGSL side is in common.wgsl and item.wgsl):
//! - a triangle is three words: corners `x | y << 16` in an order that makes the edge functions
//!   positive inside, and its flat luminance; depth plane with 16 fraction bits, and its id;
//!   luminance plane with 16 fraction bits, and how many words further on its texture is described (0: it has
//!   none);
//! - a texture on a triangle is six words: three planes with 16 fraction bits, with the first of them the level's
//!   place, with the second log2 of its width and height, with the third the place of what it gives off (0: nothing);
//!   then `from`, `to` and `range` of [`Painted`], and its holes (0: it has none);
//! - the ids of the triangles that go are padded with `NIL` to whole words;
//! - an item is two words: see `Item` in item.wgsl.

use std::num::NonZeroU32;

use super::super::{
    lattice::{DEPTH_BITS, PixelRect, ScreenPoint, Setup},
    moves::{Move, Projected},
    paint::Painted,
    scene::Scene,
    tiles::TileBounds,
};

/// Words of a packed triangle.
pub(super) const TRIANGLE_WORDS: usize = 3;
/// Words of a packed texture.
const PAINT_WORDS: usize = 6;
/// Words of a packed item.
pub(super) const ITEM_WORDS: usize = 2;
/// No triangle.
const NIL: u32 = u32::MAX;
/// Instead of a sum: the driver ended the item's loops early (`CUT_OFF` in common.wgsl).
pub(super) const CUT_OFF: u32 = 1 << 31;
/// Cells of 2 × 2 pixels of a work item, at most (`BAND_CELLS` in evaluate.wgsl).
pub(super) const BAND_CELLS: u32 = 64;

/// Four 32-bit numbers.
pub(super) type Word = [u32; 4];

/// A band of one move's rectangle in one view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Item {
    /// Index of the move in its batch.
    pub(super) owner: u32,
    /// View.
    pub(super) view: u32,
    /// Column and row of the first pixel.
    pub(super) at: (u32, u32),
    /// Columns and rows of cells of 2 × 2 pixels.
    pub(super) n_cells: (u32, u32),
    /// Triangles that come: place among the data, number.
    pub(super) added: (u32, u32),
    /// Ids that go: place among the data, words.
    pub(super) removed: (u32, u32),
    /// Whether each triangle that comes has one luminance.
    pub(super) is_plain: bool,
    /// Whether some triangles that come face the viewer and some do not: many of its pixels then
    /// take longer.
    pub(super) is_folded: bool,
    /// Whether everything there is nearer than the move.
    pub(super) is_hidden: bool,
}

impl Item {
    /// The item as words, its data starting at `data_at`.
    pub(super) fn words(&self, data_at: u32) -> [Word; ITEM_WORDS] {
        [
            [self.at.0 | self.at.1 << 16, self.n_cells.0 | self.n_cells.1 << 16, self.view, 0],
            [self.added.0 + data_at, self.added.1, self.removed.0 + data_at, self.removed.1],
        ]
    }

    /// What the sums of its lanes are in the energy; `None` if the driver cut one of them off.
    pub(super) fn weighed(&self, scene: &Scene, sums: &[u32]) -> Option<i64> {
        let weight = i64::from(scene.views[self.view as usize].weight);
        let whole = !sums.contains(&CUT_OFF);
        whole.then(|| weight * sums.iter().map(|sum| i64::from(*sum as i32)).sum::<i64>())
    }

    /// Pixels / 4.
    pub(super) fn area(&self) -> u32 {
        self.n_cells.0 * self.n_cells.1
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
pub(super) struct Packer {
    pub(super) projected: Projected,
    added: Vec<Added>,
    /// Cells of an item, at most.
    max_cells: u32,
}

/// A triangle that comes, in one view.
struct Added {
    face: u32,
    setup: Setup,
    is_turned: bool,
    words: [Word; TRIANGLE_WORDS],
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
    /// Items of at most so many cells, and no more than [`BAND_CELLS`].
    pub(super) fn new(max_cells: u32) -> Self {
        let max_cells = max_cells.clamp(1, BAND_CELLS);
        Self { projected: Projected::default(), added: Vec::new(), max_cells }
    }

    /// Packs a move in every view where it may matter.
    pub(super) fn pack(
        &mut self,
        scene: &Scene,
        bounds: &[TileBounds],
        (owner, mv): (u32, &Move),
        purpose: Purpose,
        out: &mut Packed,
    ) {
        self.projected.fill(scene, mv);
        let mut removed = None;
        for (view, bounds) in bounds.iter().enumerate() {
            let (rect, nearest_z) = self.projected.extent(&scene.lattice, view);
            let hides = |rect: &PixelRect| bounds.hides(rect, u32::from(nearest_z));
            if rect.is_empty() || (purpose == Purpose::Judge && hides(&rect)) {
                continue;
            }
            let removed = *removed.get_or_insert_with(|| pack_ids(&mv.removed, &mut out.data));
            self.set_up(scene, mv, view);
            for block in blocks(&rect, self.max_cells) {
                let is_hidden = hides(&block);
                if !is_hidden || purpose == Purpose::Make {
                    let mut item = self.item(&block, &mut out.data);
                    item.owner = owner;
                    item.view = view as u32;
                    item.removed = removed;
                    item.is_hidden = is_hidden;
                    out.items.push(item);
                }
            }
        }
    }

    /// Prepares the triangles that come, by ascending id, so that the lesser id wins a tie in
    /// depth.
    fn set_up(&mut self, scene: &Scene, mv: &Move, view: usize) {
        self.added.clear();
        for (k, added) in mv.added.iter().enumerate() {
            let points = self.projected.added_points(k, view);
            if let Some(setup) = self.projected.set_up(scene, mv, k, view) {
                let (words, is_turned) = triangle(points, &setup, added.face);
                self.added.push(Added { face: added.face, setup, is_turned, words });
            }
        }
        self.added.sort_unstable_by_key(|a| a.face);
    }

    /// The work item of a block, with the triangles that may cover some of it.
    fn item(&self, block: &PixelRect, data: &mut Vec<Word>) -> Item {
        let at = data.len();
        let (mut is_plain, mut n_turned, mut n_added) = (true, 0, 0);
        for added in self.added.iter().filter(|a| a.setup.may_cover(block)) {
            let is_painted = added.setup.paint.is_some();
            is_plain &= added.setup.lum.min == added.setup.lum.max && !is_painted;
            n_turned += u32::from(added.is_turned);
            n_added += 1;
            data.extend(added.words);
        }
        self.paint(block, at, data);
        let columns = (block.x1 - block.x0) as u32 / 2 + 1;
        let rows = (block.y1 - block.y0) as u32 / 2 + 1;
        Item {
            owner: 0,
            view: 0,
            at: (block.x0 as u32, block.y0 as u32),
            n_cells: (columns, rows),
            added: (at as u32, n_added),
            removed: (0, 0),
            is_plain,
            is_folded: n_turned > 0 && n_turned < n_added,
            is_hidden: false,
        }
    }
}

impl Packer {
    /// Describes the textures of the triangles that were packed from `at` on for a block.
    fn paint(&self, block: &PixelRect, at: usize, data: &mut Vec<Word>) {
        let packed = self.added.iter().filter(|a| a.setup.may_cover(block));
        for (k, added) in packed.enumerate() {
            let Some(paint) = &added.setup.paint else { continue };
            let own = at + k * TRIANGLE_WORDS;
            data[own + TRIANGLE_WORDS - 1][3] = (data.len() - own) as u32;
            data.extend(paint_words(paint));
        }
    }
}

/// A texture on a triangle as the kernels read it.
pub(super) fn paint_words(paint: &Painted) -> [Word; PAINT_WORDS] {
    let glow_at = paint.glow_at.map_or(0, NonZeroU32::get);
    let tags = [paint.at, paint.bits[0] | paint.bits[1] << 8, glow_at];
    let plane = |k: usize| {
        let p = &paint.planes[k];
        [p.at_origin as u32, p.dx as u32, p.dy as u32, tags[k]]
    };
    let pairs = |a: [i32; 2], b: [i32; 2]| [a[0] as u32, a[1] as u32, b[0] as u32, b[1] as u32];
    let [x, y] = paint.range;
    [
        plane(0),
        plane(1),
        plane(2),
        pairs(paint.from, paint.to[0]),
        pairs(paint.to[1], [x[0], y[0]]),
        [
            x[1] as u32,
            y[1] as u32,
            paint.holes.map_or(0, |h| h.at),
            paint.holes.map_or(0, |h| h.least),
        ],
    ]
}

fn pack_ids(ids: &[u32], data: &mut Vec<Word>) -> (u32, u32) {
    let at = data.len() as u32;
    data.extend(ids.chunks(4).map(|four| std::array::from_fn(|k| *four.get(k).unwrap_or(&NIL))));
    (at, data.len() as u32 - at)
}

/// A triangle as the kernels read it, and whether its corners had to be turned round.
pub(super) fn triangle(
    points: [ScreenPoint; 3],
    setup: &Setup,
    face: u32,
) -> ([Word; TRIANGLE_WORDS], bool) {
    let x = points.map(|p| i32::from(p.x));
    let y = points.map(|p| i32::from(p.y));
    let area2 = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
    let corner = |k: usize| x[k] as u32 | (y[k] as u32) << 16;
    let (b, c) = if area2 < 0 { (2, 1) } else { (1, 2) };
    let scale = 16 - DEPTH_BITS;
    let (depth, lum) = (&setup.depth, &setup.lum);
    let words = [
        [corner(0), corner(b), corner(c), lum.at_origin as u32 >> 16],
        [
            (depth.at_origin as u32) << scale,
            (depth.dx as u32) << scale,
            (depth.dy as u32) << scale,
            face,
        ],
        [lum.at_origin as u32, lum.dx as u32, lum.dy as u32, 0],
    ];
    (words, area2 < 0)
}

/// Cuts a rectangle into blocks of at most so many cells, as few and as square as can be.
fn blocks(rect: &PixelRect, max_cells: u32) -> impl Iterator<Item = PixelRect> + use<> {
    let rect = *rect;
    let (mut width, mut height) = ((rect.x1 - rect.x0) / 2 + 1, (rect.y1 - rect.y0) / 2 + 1);
    while width * height > max_cells as i32 {
        let longer = if width > height { &mut width } else { &mut height };
        *longer = (*longer + 1) / 2;
    }
    (rect.y0..=rect.y1).step_by(2 * height as usize).flat_map(move |y0| {
        (rect.x0..=rect.x1).step_by(2 * width as usize).map(move |x0| PixelRect {
            x0,
            y0,
            x1: (x0 + 2 * width - 1).min(rect.x1),
            y1: (y0 + 2 * height - 1).min(rect.y1),
        })
    })
}
