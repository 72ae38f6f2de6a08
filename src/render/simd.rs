//! The twin's inner loop, compiled twice: for any processor, and for AVX2.
//!
//! The only `unsafe` of the project: calling a function compiled for AVX2 after asking the
//! processor whether it has it. Both versions are one source and the same integer arithmetic.

use super::lattice::{DEPTH_BITS, PixelRect, Setup};

/// Pixels rastered at once.
const LANES: usize = 8;

/// Rasters triangles into `nearest`: for each pixel of `rect` the least `z << 16 | rank`, rank being
/// the index into `setups`, or `u32::MAX`. Returns the row stride.
#[inline]
pub fn raster(setups: &[(u32, Setup)], rect: &PixelRect, nearest: &mut Vec<u32>) -> usize {
    let stride = (rect.x1 - rect.x0 + 1) as usize + LANES;
    let rows = (rect.y1 - rect.y0 + 1) as usize;
    nearest.clear();
    nearest.resize(rows * stride, u32::MAX);
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        #[allow(unsafe_code, reason = "the processor was asked for AVX2 just above")]
        // SAFETY: `raster_avx2` needs AVX2 and nothing else, and the processor has it.
        unsafe {
            raster_avx2(setups, rect, stride, nearest);
        }
        return stride;
    }
    raster_any(setups, rect, stride, nearest);
    stride
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn raster_avx2(setups: &[(u32, Setup)], rect: &PixelRect, stride: usize, nearest: &mut [u32]) {
    raster_any(setups, rect, stride, nearest);
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
