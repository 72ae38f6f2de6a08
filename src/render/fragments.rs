//! The A-buffer of one view: every pixel's fragments, sorted by (depth, triangle).
//!
//! Invariants:
//! 1. `front[p]` is the nearest fragment of pixel p, or the background (face = `no_face`);
//! 2. the rest follow through `next` in ascending (z, face) order and end at `NIL`;
//! 3. `far[t]` is at least the greatest front depth in tile t (8 × 8 pixels); background counts as
//!    65,536. A move whose nearest vertex lies beyond every tile it touches changes nothing.
//!
//! Lists have no fixed depth, so a deep assembly costs memory, never correctness: 12 bytes for a
//! pixel and 12 for every fragment behind the front.

use super::raster::Fragment;

/// End of a list.
const NIL: u32 = u32::MAX;
/// Pixels along a tile's side.
pub const TILE: i32 = 8;
/// Depth of the background, beyond every fragment.
const BACKGROUND_Z: u32 = 1 << 16;

/// A fragment and the one behind it.
#[derive(Clone, Copy, Debug)]
pub struct Node {
    /// `z << 8 | luminance`; the background has z = 65,536.
    pub depth_lum: u32,
    /// Triangle, or the background's id.
    pub face: u32,
    next: u32,
}

impl Node {
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
    front: Vec<Node>,
    pool: Vec<Node>,
    free: u32,
    far: Vec<u32>,
    size: i32,
    background: Node,
}

impl FragmentLists {
    /// Lists of an empty picture. `no_face` is an id above every triangle's.
    pub fn new(size: i32, background_lum: u8, no_face: u32) -> Self {
        let background =
            Node { depth_lum: BACKGROUND_Z << 8 | u32::from(background_lum), face: no_face, next: NIL };
        let tiles = (size + TILE - 1) / TILE;
        Self {
            front: vec![background; (size * size) as usize],
            pool: Vec::new(),
            free: NIL,
            far: vec![BACKGROUND_Z; (tiles * tiles) as usize],
            size,
            background,
        }
    }

    /// Tiles along a side.
    #[inline(always)]
    pub fn tiles(&self) -> i32 {
        (self.size + TILE - 1) / TILE
    }

    /// Upper bound of the front depths in a tile.
    #[inline(always)]
    pub fn far(&self, tile: usize) -> u32 {
        self.far[tile]
    }

    /// The fronts of pixels `x0..=x1` of row `y`.
    #[inline(always)]
    pub fn row(&self, y: i32, x0: i32, x1: i32) -> &[Node] {
        let at = y * self.size;
        &self.front[(at + x0) as usize..=(at + x1) as usize]
    }

    /// The nearest fragment of the list starting at `node` whose triangle passes `keep`.
    #[inline(always)]
    pub fn nearest(&self, mut node: Node, keep: impl Fn(u32) -> bool) -> Node {
        loop {
            if keep(node.face) {
                return node;
            }
            if node.next == NIL {
                return self.background;
            }
            node = self.pool[node.next as usize];
        }
    }

    /// Enters a fragment at its place.
    pub fn insert(&mut self, pixel: usize, f: Fragment) {
        let new = Node {
            depth_lum: u32::from(f.z) << 8 | u32::from(f.lum),
            face: f.face,
            next: NIL,
        };
        let front = self.front[pixel];
        if front.face == self.background.face {
            self.front[pixel] = new;
        } else if new.is_nearer(&front) {
            let behind = self.store(front);
            self.front[pixel] = Node { next: behind, ..new };
        } else {
            self.insert_behind_front(pixel, new);
        }
    }

    fn insert_behind_front(&mut self, pixel: usize, new: Node) {
        let mut before = NIL;
        let mut at = self.front[pixel].next;
        while at != NIL && self.pool[at as usize].is_nearer(&new) {
            before = at;
            at = self.pool[at as usize].next;
        }
        let slot = self.store(Node { next: at, ..new });
        match before {
            NIL => self.front[pixel].next = slot,
            b => self.pool[b as usize].next = slot,
        }
    }

    /// Takes out every fragment whose triangle does not pass `keep`.
    pub fn retain(&mut self, pixel: usize, keep: impl Fn(u32) -> bool) {
        loop {
            let front = self.front[pixel];
            if front.face == self.background.face || keep(front.face) {
                break;
            }
            self.front[pixel] = match front.next {
                NIL => self.background,
                next => {
                    let node = self.pool[next as usize];
                    self.release(next);
                    node
                }
            };
        }
        let mut before = NIL;
        let mut at = self.front[pixel].next;
        while at != NIL {
            let node = self.pool[at as usize];
            if keep(node.face) {
                before = at;
            } else {
                match before {
                    NIL => self.front[pixel].next = node.next,
                    b => self.pool[b as usize].next = node.next,
                }
                self.release(at);
            }
            at = node.next;
        }
    }

    /// Recomputes the depth bounds of the tiles that touch the given rows and columns.
    pub fn refresh_tiles(&mut self, x: (i32, i32), y: (i32, i32)) {
        for ty in y.0 / TILE..=y.1 / TILE {
            for tx in x.0 / TILE..=x.1 / TILE {
                let rows = ty * TILE..((ty + 1) * TILE).min(self.size);
                let last = ((tx + 1) * TILE).min(self.size) - 1;
                let far = rows
                    .flat_map(|row| self.row(row, tx * TILE, last))
                    .map(Node::z)
                    .max()
                    .unwrap_or(BACKGROUND_Z);
                let tile = ty * self.tiles() + tx;
                self.far[tile as usize] = far;
            }
        }
    }

    /// The picture: the luminance of every front.
    pub fn picture(&self) -> Vec<u8> {
        self.front.iter().map(Node::lum).collect()
    }

    /// All fragments of a pixel, near to far.
    #[cfg(test)]
    pub fn list(&self, pixel: usize) -> Vec<Fragment> {
        let mut out = Vec::new();
        let mut node = self.front[pixel];
        while node.face != self.background.face {
            out.push(Fragment { z: node.z() as u16, lum: node.lum(), face: node.face });
            match node.next {
                NIL => break,
                next => node = self.pool[next as usize],
            }
        }
        out
    }

    fn store(&mut self, node: Node) -> u32 {
        if self.free == NIL {
            self.pool.push(node);
            return self.pool.len() as u32 - 1;
        }
        let slot = self.free;
        self.free = self.pool[slot as usize].next;
        self.pool[slot as usize] = node;
        slot
    }

    fn release(&mut self, slot: u32) {
        self.pool[slot as usize].next = self.free;
        self.free = slot;
    }
}
