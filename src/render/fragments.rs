//! The A-buffer of one view: every pixel's fragments, sorted by (depth, triangle).
//!
//! Invariants:
//! 1. layer k holds the k-th nearest fragment of every pixel, or the background where there is none;
//!    fragments beyond the dense layers are in `deep`, sorted too, and only where the dense layers
//!    are full;
//! 2. `bounds` are up to date with the fronts.
//!
//! Layers are arrays of their own because judging a move reads the front of many pixels and the
//! second of few: measured, linked lists cost 2.5 times the time in cache misses. Lists have no
//! fixed depth, so a deep assembly costs memory (8 bytes a fragment), never correctness.

use std::collections::BTreeMap;

use super::{
    lattice::PixelRect,
    raster::Fragment,
    tiles::{BACKGROUND_Z, TileBounds},
};

/// Layers kept for every pixel (0.8% of the bunny's pixels have more).
const DENSE: usize = 4;

/// A fragment as it is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cell {
    /// `z << 8 | luminance`; the background has z = 65,536.
    pub(super) depth_lum: u32,
    /// Triangle, or the background's id.
    pub face: u32,
}

impl Cell {
    /// 16-bit depth (65,536 for the background).
    #[inline(always)]
    pub fn z(&self) -> u32 {
        self.depth_lum >> 8
    }
    /// 8-bit luminance.
    #[inline(always)]
    pub fn lum(&self) -> u8 {
        self.depth_lum as u8
    }
    #[inline(always)]
    fn is_nearer(&self, other: &Self) -> bool {
        (self.z(), self.face) < (other.z(), other.face)
    }
}

/// The sorted fragments of one view.
#[derive(Clone, Debug)]
pub struct FragmentLists {
    layers: [Vec<Cell>; DENSE],
    deep: BTreeMap<u32, Vec<Cell>>,
    bounds: TileBounds,
    size: i32,
    background: Cell,
}

impl FragmentLists {
    /// Lists of an empty picture. `no_face` is an id above every triangle's.
    pub fn new(size: i32, background_lum: u8, no_face: u32) -> Self {
        let background =
            Cell { depth_lum: BACKGROUND_Z << 8 | u32::from(background_lum), face: no_face };
        Self {
            layers: std::array::from_fn(|_| vec![background; (size * size) as usize]),
            deep: BTreeMap::new(),
            bounds: TileBounds::new(size),
            size,
            background,
        }
    }

    /// Upper bounds of the front depths.
    #[inline(always)]
    pub fn bounds(&self) -> &TileBounds {
        &self.bounds
    }

    /// The fronts of pixels `x0..=x1` of row `y`.
    #[inline(always)]
    pub fn row(&self, y: i32, x0: i32, x1: i32) -> &[Cell] {
        let at = y * self.size;
        &self.layers[0][(at + x0) as usize..=(at + x1) as usize]
    }

    /// The fronts of all pixels, row by row.
    #[inline(always)]
    pub fn fronts(&self) -> &[Cell] {
        &self.layers[0]
    }

    /// The nearest fragment behind the front whose triangle passes `keep`.
    #[inline]
    pub fn nearest_behind(&self, pixel: usize, keep: impl Fn(u32) -> bool) -> Cell {
        for layer in &self.layers[1..] {
            if keep(layer[pixel].face) {
                return layer[pixel];
            }
        }
        let deep = self.deep.get(&(pixel as u32)).map_or(&[][..], Vec::as_slice);
        deep.iter().find(|c| keep(c.face)).copied().unwrap_or(self.background)
    }

    /// Enters a fragment at its place.
    pub fn insert(&mut self, pixel: usize, f: Fragment) {
        let mut cell = Cell { depth_lum: u32::from(f.z) << 8 | u32::from(f.lum), face: f.face };
        for layer in &mut self.layers {
            if cell.is_nearer(&layer[pixel]) {
                std::mem::swap(&mut cell, &mut layer[pixel]);
            }
            if cell == self.background {
                return;
            }
        }
        let deep = self.deep.entry(pixel as u32).or_default();
        let at = deep.partition_point(|c| c.is_nearer(&cell));
        deep.insert(at, cell);
    }

    /// Takes out the fragment of a triangle, if it is there.
    pub fn remove(&mut self, pixel: usize, face: u32) {
        let Some(at) = self.layers.iter().position(|l| l[pixel].face == face) else {
            if let Some(deep) = self.deep.get_mut(&(pixel as u32)) {
                deep.retain(|c| c.face != face);
            }
            return;
        };
        for k in at..DENSE - 1 {
            let behind = self.layers[k + 1][pixel];
            self.layers[k][pixel] = behind;
            if behind == self.background {
                return;
            }
        }
        let deep = self.deep.get_mut(&(pixel as u32)).filter(|d| !d.is_empty());
        self.layers[DENSE - 1][pixel] = deep.map_or(self.background, |d| d.remove(0));
    }

    /// Recomputes the depth bounds of the tiles that touch the rectangle.
    pub fn refresh_tiles(&mut self, rect: &PixelRect) {
        for tile in self.bounds.touched(rect) {
            let far = (tile.y0..=tile.y1).flat_map(|y| self.row(y, tile.x0, tile.x1)).map(Cell::z);
            let far = far.max().unwrap_or(BACKGROUND_Z);
            self.bounds.set(&tile, far);
        }
    }

    /// The picture: the luminance of every front.
    pub fn picture(&self) -> Vec<u8> {
        self.layers[0].iter().map(Cell::lum).collect()
    }

    /// All fragments of a pixel, near to far.
    #[cfg(test)]
    pub fn list(&self, pixel: usize) -> Vec<Fragment> {
        let dense = self.layers.iter().map(|l| l[pixel]);
        let deep = self.deep.get(&(pixel as u32)).into_iter().flatten().copied();
        dense
            .chain(deep)
            .filter(|c| c.face != self.background.face)
            .map(|c| Fragment { z: c.z() as u16, lum: c.lum(), face: c.face })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deep_stacks_come_back_in_order_whatever_is_taken_out() {
        let mut lists = FragmentLists::new(8, 7, u32::MAX);
        // Twenty sheets entered out of order; ties in depth fall to the lower id.
        let sheet = |face: u32| Fragment { z: (face / 2) as u16, lum: face as u8, face };
        for face in (0..20).map(|i| i * 7 % 20) {
            lists.insert(5, sheet(face));
        }
        assert_eq!(lists.list(5), (0..20).map(sheet).collect::<Vec<_>>());
        for face in [0, 3, 19, 4, 77] {
            lists.remove(5, face);
        }
        let left: Vec<_> = (0..20).filter(|f| ![0, 3, 19, 4].contains(f)).map(sheet).collect();
        assert_eq!(lists.list(5), left);
        assert_eq!(lists.nearest_behind(5, |f| f > 12).face, 13);
        assert_eq!(lists.nearest_behind(5, |f| f > 99).z(), BACKGROUND_Z);
    }
}
