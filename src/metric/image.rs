//! Differences of pictures, and the scales they are told in.
//!
//! Invariants:
//! 1. luminance is Rec. 709's and runs from 0 to 1; no transfer curve is applied to it;
//! 2. sums run in pixel order in f64, so a value does not depend on threads.
//!
//! Knows nothing of how a picture came to be.

/// Rec. 709 weights of linear red, green and blue.
pub const REC709: [f64; 3] = [0.2126, 0.7152, 0.0722];

/// Rec. 709 luminance of a linear colour.
pub fn luminance(rgb: [f32; 3]) -> f32 {
    (0..3).map(|c| REC709[c] * f64::from(rgb[c])).sum::<f64>() as f32
}

/// Mean squared difference of two luminance pictures of the same size, 0 to 1
/// (Lindstrom & Turk 2000, section 4: d2 is its root over all the views). Empty pictures are equal.
pub fn mean_square_difference(a: &[f32], b: &[f32]) -> f64 {
    debug_assert_eq!(a.len(), b.len(), "pictures of different sizes");
    let sum: f64 = a.iter().zip(b).map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2)).sum();
    sum / a.len().max(1) as f64
}

/// The same, each square counting so many parts of `full`.
pub fn mean_weighed_difference(a: &[f32], b: &[f32], (weights, full): (&[u8], u8)) -> f64 {
    debug_assert_eq!((a.len(), a.len()), (b.len(), weights.len()), "pictures of different sizes");
    let square = |(x, y): (&f32, &f32)| (f64::from(*x) - f64::from(*y)).powi(2);
    let squares = a.iter().zip(b).map(square).zip(weights);
    let sum: f64 = squares.map(|(square, w)| f64::from(*w) * square).sum();
    sum / (f64::from(full) * a.len().max(1) as f64)
}

/// Root of the mean of equally weighted mean squares, in percent of full scale: the papers' d2.
pub fn d2_percent(mean_squares: &[f64]) -> f64 {
    let n = mean_squares.len().max(1) as f64;
    100.0 * (mean_squares.iter().sum::<f64>() / n).sqrt()
}

/// A linear value as sRGB encodes it, both 0 to 1 (IEC 61966-2-1).
pub fn srgb_from_linear(value: f64) -> f64 {
    if value <= 0.003_130_8 {
        12.92 * value.max(0.0)
    } else {
        1.055 * libm::pow(value.min(1.0), 1.0 / 2.4) - 0.055
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_offset_is_its_own_root_mean_square() {
        let (a, b) = (vec![0.25_f32; 64], vec![0.5_f32; 64]);
        assert_eq!(mean_square_difference(&a, &b), 0.0625);
        assert_eq!(mean_square_difference(&a, &a), 0.0);
        assert!((d2_percent(&[0.0625, 0.0625]) - 25.0).abs() < 1e-12);
        // Views count equally: one view that differs by 0.5 among four.
        assert!((d2_percent(&[0.25, 0.0, 0.0, 0.0]) - 25.0).abs() < 1e-12);
    }

    #[test]
    fn luminance_weights_sum_to_one_and_favour_green() {
        assert!((luminance([1.0; 3]) - 1.0).abs() < 1e-6);
        assert!(luminance([0.0, 1.0, 0.0]) > luminance([1.0, 0.0, 0.0]));
    }

    #[test]
    fn srgb_is_monotonic_and_meets_its_known_points() {
        assert_eq!(srgb_from_linear(0.0), 0.0);
        assert!((srgb_from_linear(1.0) - 1.0).abs() < 1e-12);
        assert!((srgb_from_linear(0.214_041_14) - 0.5).abs() < 1e-6);
        let values: Vec<f64> = (0..=1000).map(|i| srgb_from_linear(f64::from(i) / 1e3)).collect();
        assert!(values.is_sorted());
    }
}
