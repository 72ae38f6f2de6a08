//! The A-buffer of one view: every pixel's fragments, sorted by (depth, triangle).
//!
//! Invariants:
//! 1. `front[p]` is the nearest fragment of pixel p, or the background (face = `no_face`);
//! 2. the rest follow through `next` in ascending (z, face) order and end at `NIL`;
//! 3. `bounds` are up to date with the fronts.
//!
//! Lists have no fixed depth, so a deep assembly costs memory, never correctness: 12 bytes for a
//! pixel and 12 for every fragment behind the front.

use super::{
    lattice::PixelRect,
    raster::Fragment,
    tiles::{BACKGROUND_Z, TileBounds},
};

/// End of a list.
const NIL: u32 = u32::MAX;

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
    bounds: TileBounds,
    size: i32,
    background: Node,
}

impl FragmentLists {
    /// Lists of an empty picture. `no_face` is an id above every triangle's.
    pub fn new(size: i32, background_lum: u8, no_face: u32) -> Self {
        let background = Node {
            depth_lum: BACKGROUND_Z << 8 | u32::from(background_lum),
            face: no_face,
            next: NIL,
        };
        Self {
            front: vec![background; (size * size) as usize],
            pool: Vec::new(),
            free: NIL,
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
        let new =
            Node { depth_lum: u32::from(f.z) << 8 | u32::from(f.lum), face: f.face, next: NIL };
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

    /// Recomputes the depth bounds of the tiles that touch the rectangle.
    pub fn refresh_tiles(&mut self, rect: &PixelRect) {
        for tile in self.bounds.touched(rect) {
            let far = (tile.y0..=tile.y1).flat_map(|y| self.row(y, tile.x0, tile.x1)).map(Node::z);
            let far = far.max().unwrap_or(BACKGROUND_Z);
            self.bounds.set(&tile, far);
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
