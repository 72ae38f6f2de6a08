//! How visible differences are: where the original is busy, an eye forgives more than where it is calm.
//!
//! The visibility of a difference in a pixel is σ₀² / (σ₀² + σ²), where σ² is the variance of the original's luminances
//! round it: the visibility function of Anderson & Netravali 1976 (a subjective criterion for image restoration), with
//! local variance as the measure of activity. Edges are no texture: a difference beside a silhouette is plain to see,
//! whatever lies on its other side. So the variance is that of the calmest of the four windows of 4 × 4 that have
//! the pixel in a corner (the regions of Kuwahara et al. 1976). Lindstrom & Turk's own perceptual metric was never
//! published; this one is Lookalike's.
//!
//! Invariants:
//! 1. weights depend on the original's pictures alone, so the energy is a sum over pixels and changes where pictures do;
//! 2. all is integers.

use crate::render::FULL_WEIGHT;

/// Standard deviation, in steps of 255, at which a difference counts half.
const HALF_VISIBLE: u64 = 8;
/// Pixels along a side of a window.
const WINDOW: usize = 4;

/// How often the pixels of a picture count, 1 to [`FULL_WEIGHT`]: their visibilities, rounded. The picture has `size`²
/// luminances, row by row.
pub fn weights(picture: &[u8], size: usize) -> Vec<u8> {
    let last = size.saturating_sub(WINDOW);
    let windows: Vec<u64> =
        (0..size * size).map(|at| spread(picture, size, [at % size, at / size])).collect();
    let weight = |at: usize| {
        // Windows that have the pixel in a corner, or at an edge of the picture the nearest ones.
        let starts = |c: usize| [c.saturating_sub(WINDOW - 1).min(last), c.min(last)];
        let (columns, rows) = (starts(at % size), starts(at / size));
        let all = rows.iter().flat_map(|y| columns.map(|x| windows[y * size + x]));
        visibility(all.min().unwrap_or(0))
    };
    (0..picture.len()).map(weight).collect()
}

/// Pixels of a window, squared.
const N2: u64 = (WINDOW * WINDOW * WINDOW * WINDOW) as u64;

/// The variance in the window that begins at a pixel, times [`N2`]; 0 where it is not in the picture as a whole.
fn spread(picture: &[u8], size: usize, [x, y]: [usize; 2]) -> u64 {
    if x + WINDOW > size || y + WINDOW > size {
        return 0;
    }
    let (mut sum, mut squares) = (0, 0);
    for row in picture[y * size + x..].chunks(size).take(WINDOW) {
        for lum in &row[..WINDOW] {
            sum += u64::from(*lum);
            squares += u64::from(*lum).pow(2);
        }
    }
    (WINDOW * WINDOW) as u64 * squares - sum * sum
}

/// In parts of [`FULL_WEIGHT`], from a variance times [`N2`].
fn visibility(spread: u64) -> u8 {
    let half = HALF_VISIBLE.pow(2) * N2;
    let (full, all) = (u64::from(FULL_WEIGHT) * half, half + spread);
    ((2 * full + all) / (2 * all)).max(1) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calm_counts_and_busy_does_not() {
        const SIZE: usize = 64;
        // Left of the middle all is even but for a step, right of it a checkerboard of ± 8, below it of ± 100.
        let lum = |at: usize| {
            let (x, y) = (at % SIZE, at / SIZE);
            let busy = |by: usize| if (x + y).is_multiple_of(2) { 128 - by } else { 128 + by };
            match (x < 32, y < 32) {
                (true, _) => 60 + 120 * usize::from(x > 15),
                (false, true) => busy(8),
                (false, false) => busy(100),
            }
        };
        let picture: Vec<u8> = (0..SIZE * SIZE).map(|at| lum(at) as u8).collect();
        let found = weights(&picture, SIZE);
        let at = |x: usize, y: usize| found[y * SIZE + x];
        assert!((0..32).all(|x| at(x, 40) == FULL_WEIGHT), "edges hide nothing");
        assert!((36..SIZE).all(|x| at(x, 10) == FULL_WEIGHT / 2), "half visible");
        assert!((36..SIZE).all(|x| at(x, 50) == 1), "hidden, but not for nothing");
    }

    #[test]
    fn the_least_is_one_and_the_most_is_full() {
        assert_eq!(visibility(0), FULL_WEIGHT);
        assert_eq!(visibility(N2 * 255 * 255), 1);
    }
}
