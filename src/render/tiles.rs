//! Depth bounds of square tiles: which moves happen wholly behind what is seen.
//!
//! Invariant: a tile's bound is at least the greatest front depth in it; background counts as
//! 65,536. A move whose nearest vertex lies beyond every tile it touches changes nothing.

use super::lattice::PixelRect;

/// Pixels along a tile's side.
pub const TILE: i32 = 8;
/// Depth of the background, beyond every fragment.
pub const BACKGROUND_Z: u32 = 1 << 16;

/// The depth bounds of one view's tiles, row by row.
#[derive(Clone, Debug)]
pub struct TileBounds {
    far: Vec<u32>,
    tiles_per_row: i32,
    size: i32,
}

impl TileBounds {
    /// Of an empty picture of `size`² pixels.
    pub fn new(size: i32) -> Self {
        let tiles_per_row = (size + TILE - 1) / TILE;
        Self {
            far: vec![BACKGROUND_Z; (tiles_per_row * tiles_per_row) as usize],
            tiles_per_row,
            size,
        }
    }

    /// Whether everything in the rectangle is nearer than `z`.
    #[inline(always)]
    pub fn hides(&self, rect: &PixelRect, z: u32) -> bool {
        (rect.y0 / TILE..=rect.y1 / TILE).all(|ty| {
            let row = ty * self.tiles_per_row;
            self.far[(row + rect.x0 / TILE) as usize..=(row + rect.x1 / TILE) as usize]
                .iter()
                .all(|far| *far < z)
        })
    }

    /// The tiles that a rectangle touches, each as its pixels.
    pub fn touched(&self, rect: &PixelRect) -> impl Iterator<Item = PixelRect> + use<> {
        let (columns, size) = (rect.x0 / TILE..=rect.x1 / TILE, self.size);
        (rect.y0 / TILE..=rect.y1 / TILE).flat_map(move |ty| {
            columns.clone().map(move |tx| PixelRect {
                x0: tx * TILE,
                y0: ty * TILE,
                x1: ((tx + 1) * TILE).min(size) - 1,
                y1: ((ty + 1) * TILE).min(size) - 1,
            })
        })
    }

    /// Sets the bound of the tile with these pixels.
    pub fn set(&mut self, tile: &PixelRect, far: u32) {
        self.far[(tile.y0 / TILE * self.tiles_per_row + tile.x0 / TILE) as usize] = far;
    }
}
