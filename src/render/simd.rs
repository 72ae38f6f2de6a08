//! The twin's inner loops, compiled twice: for any processor, and for AVX2.
//!
//! The only `unsafe` of the project: calling a function compiled for AVX2 after asking the
//! processor whether it has it. Both versions are one source and the same integer arithmetic.

use super::{
    fragments::Cell,
    lattice::{DEPTH_BITS, PixelRect, Setup},
};

/// Pixels rastered at once.
const LANES: usize = 8;

/// A pixel that a move may change: its index in the picture, and what comes there.
pub type Touched = (u32, u32);

/// What is known of a move in a view when its pixels are looked for.
pub struct Coverage<'a> {
    /// Added triangles with their ids, by ascending id.
    pub setups: &'a [(u32, Setup)],
    /// Pixels that the move can touch.
    pub rect: PixelRect,
    /// The fronts of the whole picture, row by row, `size` to a row.
    pub fronts: &'a [Cell],
    /// Pixels along a side.
    pub size: i32,
    /// Bit `face % 32` is set for every triangle that goes.
    pub going: u32,
}

/// Finds the pixels that a move may change: those where something comes that is not behind the
/// front, and those whose front may go (`going` lets some through that stay). What comes is
/// `z << 16 | rank`, rank being the index into `setups`, or `u32::MAX` for nothing. `nearest` is
/// working memory.
#[inline]
pub fn touched(of: &Coverage<'_>, nearest: &mut Vec<u32>, out: &mut Vec<Touched>) {
    let stride = (of.rect.x1 - of.rect.x0 + 1) as usize + LANES;
    let rows = (of.rect.y1 - of.rect.y0 + 1) as usize;
    nearest.clear();
    nearest.resize(rows * stride, u32::MAX);
    out.clear();
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        #[allow(unsafe_code, reason = "the processor was asked for AVX2 just above")]
        // SAFETY: `touched_avx2` needs AVX2 and nothing else, and the processor has it.
        unsafe {
            touched_avx2(of, stride, nearest, out);
        }
        return;
    }
    touched_any(of, stride, nearest, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn touched_avx2(of: &Coverage<'_>, stride: usize, nearest: &mut [u32], out: &mut Vec<Touched>) {
    touched_any(of, stride, nearest, out);
}

#[inline(always)]
fn touched_any(of: &Coverage<'_>, stride: usize, nearest: &mut [u32], out: &mut Vec<Touched>) {
    raster_any(of.setups, &of.rect, stride, nearest);
    for j in of.rect.y0..=of.rect.y1 {
        let first = (j * of.size + of.rect.x0) as usize;
        let last = (j * of.size + of.rect.x1) as usize;
        let fronts = &of.fronts[first..=last];
        let coming = &nearest[(j - of.rect.y0) as usize * stride..][..fronts.len()];
        let (front_chunks, front_rest) = fronts.as_chunks::<LANES>();
        let (coming_chunks, coming_rest) = coming.as_chunks::<LANES>();
        let mut pixel = first as u32;
        for (front, key) in front_chunks.iter().zip(coming_chunks) {
            let mut mask = 0;
            for lane in 0..LANES {
                mask |= may_change(front[lane], key[lane], of.going) << lane;
            }
            while mask != 0 {
                let lane = mask.trailing_zeros();
                out.push((pixel + lane, key[lane as usize]));
                mask &= mask - 1;
            }
            pixel += LANES as u32;
        }
        for (front, key) in front_rest.iter().zip(coming_rest) {
            if may_change(*front, *key, of.going) != 0 {
                out.push((pixel, *key));
            }
            pixel += 1;
        }
    }
}

/// 1 where the pixel must be looked at, else 0; no branches, so that eight go at once.
#[inline(always)]
fn may_change(front: Cell, key: u32, going: u32) -> u32 {
    let comes = u32::from(key != u32::MAX) & u32::from(key >> 16 <= front.depth_lum >> 8);
    comes | ((going >> (front.face & 31)) & 1)
}

#[inline(always)]
fn raster_any(setups: &[(u32, Setup)], rect: &PixelRect, stride: usize, nearest: &mut [u32]) {
    for (rank, (_, s)) in setups.iter().enumerate() {
        let width = (s.rect.x1 - s.rect.x0 + 1) as usize;
        let left = (s.rect.x0 - rect.x0) as usize;
        for j in s.rect.y0..=s.rect.y1 {
            let at = (j - rect.y0) as usize * stride + left;
            let row = &mut nearest[at..at + width.next_multiple_of(LANES)];
            raster_row(s, rank as u32, j, row);
        }
    }
}

/// One row of one triangle. Lanes beyond the triangle's rectangle fail its edge tests, or fall into
/// the row's padding.
#[inline(always)]
fn raster_row(s: &Setup, rank: u32, j: i32, row: &mut [u32]) {
    let e = s.edges.map(|e| e.at(s.rect.x0, j));
    let z = s
        .depth
        .at_origin
        .wrapping_add(s.depth.dx.wrapping_mul(s.rect.x0))
        .wrapping_add(s.depth.dy.wrapping_mul(j));
    for (chunk_index, chunk) in row.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
        let first = (chunk_index * LANES) as i32;
        for (lane, slot) in chunk.iter_mut().enumerate() {
            let i = first + lane as i32;
            let edge = |k: usize| e[k].wrapping_add(s.edges[k].dx.wrapping_mul(i));
            let outside = (edge(0) | edge(1) | edge(2)) >> 31;
            let depth = (z.wrapping_add(s.depth.dx.wrapping_mul(i)) >> DEPTH_BITS)
                .clamp(s.depth.min, s.depth.max);
            let key = (depth as u32) << 16 | rank | outside as u32;
            *slot = (*slot).min(key);
        }
    }
}
