//! The twin's inner loop: what a move does to one view.
//!
//! Two versions of the same integer arithmetic: plain, for any processor, and eight pixels at a
//! time for those with AVX2 (three times as fast). Tests compare them; the contract suite runs the
//! one that this machine would use.

use crate::intrinsics::by_processor;

use super::{
    fragments::{BLOCK_HEIGHT, BLOCK_WIDTH, FragmentLists, LANES},
    lattice::{DEPTH_BITS, PixelRect, Setup},
};

/// A move in one view.
pub struct Judged<'a> {
    /// Added triangles with their ids, by ascending id, so that the lesser rank wins a tie; at
    /// most [`MAX_ADDED`].
    pub setups: &'a [(u32, Setup)],
    /// What they are painted with.
    pub texels: &'a [u32],
    /// Ids of the triangles that go.
    pub removed: &'a [u32],
    /// Pixels that the move can touch.
    pub rect: PixelRect,
    /// The view as it is.
    pub lists: &'a FragmentLists,
}

/// The most triangles that a move may add.
pub const MAX_ADDED: usize = 255;
/// Nothing comes to this pixel. Keys are `z << 16 | rank << 8 | luminance`, and rank 255 is unused.
pub(super) const NOTHING: u32 = u32::MAX;

/// Working memory.
#[derive(Default)]
pub struct Scratch {
    /// What comes to each pixel of the rectangle's blocks.
    pub(super) keys: Vec<[u32; LANES]>,
    /// The removed ids, each for all lanes.
    pub(super) removed: Vec<[u32; LANES]>,
}

/// A rectangle of blocks, bounds inclusive.
#[derive(Clone, Copy)]
pub(super) struct BlockRect {
    pub x0: i32,
    pub y0: i32,
    pub x1: i32,
    pub y1: i32,
}

impl BlockRect {
    /// The blocks that hold the pixels.
    #[inline(always)]
    pub fn of(pixels: &PixelRect) -> Self {
        Self {
            x0: pixels.x0 / BLOCK_WIDTH,
            y0: pixels.y0 / BLOCK_HEIGHT,
            x1: pixels.x1 / BLOCK_WIDTH,
            y1: pixels.y1 / BLOCK_HEIGHT,
        }
    }

    #[inline(always)]
    pub fn width(&self) -> usize {
        (self.x1 - self.x0 + 1) as usize
    }

    #[inline(always)]
    pub fn height(&self) -> usize {
        (self.y1 - self.y0 + 1) as usize
    }
}

by_processor! {
    /// The change of energy of a move in one view.
    #[inline]
    pub fn delta(of: &Judged<'_>, scratch: &mut Scratch) -> i64 {
        avx2: super::kernel_avx2::delta,
        plain: delta_plain,
    }
}

/// [`delta`], one pixel at a time.
pub(super) fn delta_plain(of: &Judged<'_>, scratch: &mut Scratch) -> i64 {
    let blocks = BlockRect::of(&of.rect);
    let (width, height) = (blocks.width(), blocks.height());
    scratch.keys.clear();
    scratch.keys.resize(width * height, [NOTHING; LANES]);
    for (rank, (_, s)) in of.setups.iter().enumerate() {
        super::raster::for_each_pixel(s, |i, j| {
            if s.is_hole(of.texels, i, j) {
                return;
            }
            let block = (j / BLOCK_HEIGHT - blocks.y0) as usize * width
                + (i / BLOCK_WIDTH - blocks.x0) as usize;
            let lane = (j % BLOCK_HEIGHT * BLOCK_WIDTH + i % BLOCK_WIDTH) as usize;
            let (z, lum) = (s.depth.at(i, j, DEPTH_BITS) as u32, s.lum_at(of.texels, i, j));
            let slot = &mut scratch.keys[block][lane];
            *slot = (*slot).min(z << 16 | (rank << 8) as u32 | u32::from(lum));
        });
    }
    let mut sum = 0;
    for (k, keys) in scratch.keys.iter().enumerate() {
        let at =
            of.lists.block_index(blocks.x0 + (k % width) as i32, blocks.y0 + (k / width) as i32);
        for (lane, key) in keys.iter().enumerate() {
            sum += pixel_delta(of, at, lane, 0, *key);
        }
    }
    sum
}

/// The change of energy of one pixel, whose `n_gone` nearest fragments go for sure.
pub(super) fn pixel_delta(
    of: &Judged<'_>,
    block: usize,
    lane: usize,
    n_gone: usize,
    key: u32,
) -> i64 {
    let front = &of.lists.fronts()[block];
    let stay = of.lists.nearest_from(n_gone, block, lane, |f| !of.removed.contains(&f));
    let rank = (key >> 8 & 0xff) as usize;
    let wins = key != NOTHING && (key >> 16, of.setups[rank].0) < (u32::from(stay.z), stay.face);
    let lum = if wins { key as u8 } else { stay.lum };
    let square = |l: u8| i64::from(l.abs_diff(front.reference[lane])).pow(2);
    i64::from(of.lists.weights(block)[lane]) * (square(lum) - square(front.lum[lane]))
}
