//! The A-buffer of one view: every pixel's fragments, sorted by (depth, triangle).
//!
//! Invariants:
//! 1. layer k holds the k-th nearest fragment of every pixel, or the background where there is none;
//!    fragments beyond the dense layers are in `deep`, sorted too, and only where the dense layers
//!    are full;
//! 2. `bounds` are up to date with the fronts;
//! 3. the reference picture lies in the blocks of layer 0, the weights of its pixels in those of layer 1, and neither
//!    ever changes.
//!
//! Pixels come in blocks of 4 × 2, one cache line a block and layer: judging a move reads the
//! fronts of whole blocks, the second layer where a front goes, and the deeper ones hardly ever.
//! Lists have no fixed depth, so a deep assembly costs memory (8 bytes a fragment), never
//! correctness.

use std::collections::BTreeMap;

use super::{
    lattice::PixelRect,
    raster::Fragment,
    tiles::{BACKGROUND_Z, TileBounds},
};

/// Layers kept for every pixel (0.8% of the bunny's pixels have more).
const DENSE: usize = 4;
/// Pixels across a block.
pub const BLOCK_WIDTH: i32 = 4;
/// Pixels down a block.
pub const BLOCK_HEIGHT: i32 = 2;
/// Pixels in a block; lane `(y % 2) * 4 + x % 4` is pixel (x, y).
pub const LANES: usize = 8;
/// The background's id, above every triangle's: slots are 32-bit, this one is never used.
pub const NO_FACE: u32 = u32::MAX - 1;

/// One layer of a block of pixels.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub struct Block {
    /// Triangles, or [`NO_FACE`].
    pub face: [u32; LANES],
    /// 16-bit depths (65,535 for the background).
    pub depth: [u16; LANES],
    /// 8-bit luminances.
    pub lum: [u8; LANES],
    /// Layer 0: luminances of the reference picture. Layer 1: how often each pixel counts.
    pub reference: [u8; LANES],
}

/// A fragment as it is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cell {
    /// 16-bit depth (65,535 for the background).
    pub z: u16,
    /// 8-bit luminance.
    pub lum: u8,
    /// Triangle, or [`NO_FACE`].
    pub face: u32,
}

impl Cell {
    #[inline(always)]
    fn is_nearer(&self, other: &Self) -> bool {
        (self.z, self.face) < (other.z, other.face)
    }
}

impl Block {
    /// The fragment of one pixel.
    #[inline(always)]
    pub fn cell(&self, lane: usize) -> Cell {
        Cell { z: self.depth[lane], lum: self.lum[lane], face: self.face[lane] }
    }

    #[inline(always)]
    fn set(&mut self, lane: usize, cell: Cell) {
        (self.depth[lane], self.lum[lane], self.face[lane]) = (cell.z, cell.lum, cell.face);
    }

    /// The greatest depth, the background counting as [`BACKGROUND_Z`].
    #[inline]
    fn farthest(&self) -> u32 {
        if self.face.contains(&NO_FACE) {
            return BACKGROUND_Z;
        }
        self.depth.iter().copied().max().map_or(BACKGROUND_Z, u32::from)
    }
}

/// The sorted fragments of one view.
#[derive(Clone, Debug)]
pub struct FragmentLists {
    layers: [Vec<Block>; DENSE],
    /// By block and lane.
    deep: BTreeMap<(u32, u8), Vec<Cell>>,
    bounds: TileBounds,
    size: i32,
    background: Cell,
    is_weighed: bool,
}

impl FragmentLists {
    /// Lists of an empty picture, beside the reference picture (row by row) and the weights of its pixels, where
    /// not all count once. `size` is a multiple of 8.
    pub fn new(
        size: i32,
        background_lum: u8,
        (reference, weights): (&[u8], Option<&[u8]>),
    ) -> Self {
        let background = Cell { z: u16::MAX, lum: background_lum, face: NO_FACE };
        let empty = Block {
            face: [NO_FACE; LANES],
            depth: [u16::MAX; LANES],
            lum: [background_lum; LANES],
            reference: [0; LANES],
        };
        let n_blocks = ((size / BLOCK_WIDTH + 1) * (size / BLOCK_HEIGHT)) as usize;
        let mut lists = Self {
            layers: std::array::from_fn(|_| vec![empty; n_blocks]),
            deep: BTreeMap::new(),
            bounds: TileBounds::new(size),
            size,
            background,
            is_weighed: weights.is_some(),
        };
        for (pixel, lum) in reference.iter().enumerate() {
            let (block, lane) = lists.locate(pixel as i32 % size, pixel as i32 / size);
            lists.layers[0][block].reference[lane] = *lum;
            lists.layers[1][block].reference[lane] = weights.map_or(1, |w| w[pixel]);
        }
        lists
    }

    /// Block and lane of pixel (i, j).
    #[inline(always)]
    fn locate(&self, i: i32, j: i32) -> (usize, usize) {
        let block = self.block_index(i / BLOCK_WIDTH, j / BLOCK_HEIGHT);
        (block, (j % BLOCK_HEIGHT * BLOCK_WIDTH + i % BLOCK_WIDTH) as usize)
    }

    /// The block in column `x` and row `y` of blocks.
    #[inline(always)]
    pub fn block_index(&self, x: i32, y: i32) -> usize {
        (y * self.blocks_per_row() + x) as usize
    }

    /// Blocks in a row of blocks, one of them unused: at 256² a row would fill a page, and blocks
    /// below one another would compete for the same places in the cache.
    #[inline(always)]
    pub fn blocks_per_row(&self) -> i32 {
        self.size / BLOCK_WIDTH + 1
    }

    /// Upper bounds of the front depths.
    #[inline(always)]
    pub fn bounds(&self) -> &TileBounds {
        &self.bounds
    }

    /// The fronts, block by block.
    #[inline(always)]
    pub fn fronts(&self) -> &[Block] {
        &self.layers[0]
    }

    /// The fragments behind the fronts, block by block.
    #[inline(always)]
    pub fn seconds(&self) -> &[Block] {
        &self.layers[1]
    }

    /// Whether some pixels count more than once.
    #[inline(always)]
    pub fn is_weighed(&self) -> bool {
        self.is_weighed
    }

    /// How often the pixels of a block count.
    #[inline(always)]
    pub fn weights(&self, block: usize) -> &[u8; LANES] {
        &self.seconds()[block].reference
    }

    /// The nearest fragment from the given layer on whose triangle passes `keep`.
    #[inline]
    pub fn nearest_from(
        &self,
        layer: usize,
        block: usize,
        lane: usize,
        keep: impl Fn(u32) -> bool,
    ) -> Cell {
        for layer in &self.layers[layer..] {
            if keep(layer[block].face[lane]) {
                return layer[block].cell(lane);
            }
        }
        let deep = self.deep.get(&(block as u32, lane as u8)).map_or(&[][..], Vec::as_slice);
        deep.iter().find(|c| keep(c.face)).copied().unwrap_or(self.background)
    }

    /// Enters a fragment at its place.
    pub fn insert(&mut self, i: i32, j: i32, f: Fragment) {
        let (block, lane) = self.locate(i, j);
        let mut cell = Cell { z: f.z, lum: f.lum, face: f.face };
        for layer in &mut self.layers {
            let here = layer[block].cell(lane);
            if cell.is_nearer(&here) {
                layer[block].set(lane, cell);
                cell = here;
            }
            if cell == self.background {
                return;
            }
        }
        let deep = self.deep.entry((block as u32, lane as u8)).or_default();
        let at = deep.partition_point(|c| c.is_nearer(&cell));
        deep.insert(at, cell);
    }

    /// Takes out the fragment of a triangle, if it is there.
    pub fn remove(&mut self, i: i32, j: i32, face: u32) {
        let (block, lane) = self.locate(i, j);
        let key = (block as u32, lane as u8);
        let Some(at) = self.layers.iter().position(|l| l[block].face[lane] == face) else {
            if let Some(deep) = self.deep.get_mut(&key) {
                deep.retain(|c| c.face != face);
            }
            return;
        };
        for k in at..DENSE - 1 {
            let behind = self.layers[k + 1][block].cell(lane);
            self.layers[k][block].set(lane, behind);
            if behind == self.background {
                return;
            }
        }
        let deep = self.deep.get_mut(&key).filter(|d| !d.is_empty());
        let next = deep.map_or(self.background, |d| d.remove(0));
        self.layers[DENSE - 1][block].set(lane, next);
    }

    /// Recomputes the depth bounds of the tiles that touch the rectangle.
    pub fn refresh_tiles(&mut self, rect: &PixelRect) {
        for tile in self.bounds.touched(rect) {
            let mut far = 0;
            for j in (tile.y0..=tile.y1).step_by(BLOCK_HEIGHT as usize) {
                let (first, last) = (self.locate(tile.x0, j).0, self.locate(tile.x1, j).0);
                let row = &self.layers[0][first..=last];
                far = row.iter().map(Block::farthest).fold(far, u32::max);
            }
            self.bounds.set(&tile, far);
        }
    }

    /// The picture: the luminance of every front, row by row.
    pub fn picture(&self) -> Vec<u8> {
        let at = |pixel: i32| {
            let (block, lane) = self.locate(pixel % self.size, pixel / self.size);
            self.layers[0][block].lum[lane]
        };
        (0..self.size * self.size).map(at).collect()
    }

    /// All fragments of a pixel, near to far.
    #[cfg(test)]
    pub fn list(&self, i: i32, j: i32) -> Vec<Fragment> {
        let (block, lane) = self.locate(i, j);
        let dense = self.layers.iter().map(|l| l[block].cell(lane));
        let deep = self.deep.get(&(block as u32, lane as u8)).into_iter().flatten().copied();
        dense
            .chain(deep)
            .filter(|c| c.face != NO_FACE)
            .map(|c| Fragment { z: c.z, lum: c.lum, face: c.face })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deep_stacks_come_back_in_order_whatever_is_taken_out() {
        let mut lists = FragmentLists::new(8, 7, (&[0; 64], None));
        // Twenty sheets entered out of order; ties in depth fall to the lower id.
        let sheet = |face: u32| Fragment { z: (face / 2) as u16, lum: face as u8, face };
        for face in (0..20).map(|i| i * 7 % 20) {
            lists.insert(5, 3, sheet(face));
        }
        assert_eq!(lists.list(5, 3), (0..20).map(sheet).collect::<Vec<_>>());
        for face in [0, 3, 19, 4, 77] {
            lists.remove(5, 3, face);
        }
        let left: Vec<_> = (0..20).filter(|f| ![0, 3, 19, 4].contains(f)).map(sheet).collect();
        assert_eq!(lists.list(5, 3), left);
        let (block, lane) = lists.locate(5, 3);
        assert_eq!(lists.nearest_from(0, block, lane, |f| f > 12).face, 13);
        assert_eq!(lists.nearest_from(0, block, lane, |f| f > 99).face, NO_FACE);
    }
}
