//! The original in one view, as slopes are taken against it.

use std::ops::Range;

use crate::render::Reference;

/// The original in a view.
#[derive(Clone, Copy)]
pub struct Shown<'r> {
    /// Its luminances, row by row.
    pub picture: &'r [u8],
    /// How often each pixel counts; `None`: all once.
    weights: Option<&'r [u8]>,
}

impl<'r> Shown<'r> {
    /// Of all views, this one.
    pub fn of(reference: &'r Reference, view: usize) -> Self {
        Self { picture: &reference.pictures[view], weights: reference.weights_in(view) }
    }

    /// How often a pixel counts.
    pub fn weight(&self, pixel: usize) -> f64 {
        self.weights.map_or(1.0, |weights| f64::from(weights[pixel]))
    }

    /// Sums over pixels of weights, luminances and squared luminances.
    pub fn sums(&self, pixels: Range<usize>) -> [f64; 3] {
        let picture = &self.picture[pixels.clone()];
        let square = |r: &u8| u32::from(*r).pow(2);
        let Some(weights) = self.weights.map(|weights| &weights[pixels]) else {
            let sum = picture.iter().map(|r| u32::from(*r)).sum::<u32>();
            let squares = picture.iter().map(square).sum::<u32>();
            return [picture.len() as f64, sum.into(), squares.into()];
        };
        let pairs = picture.iter().zip(weights);
        let weigh = |sums: [u32; 3], (r, w): (&u8, &u8)| {
            let w = u32::from(*w);
            [sums[0] + w, sums[1] + w * u32::from(*r), sums[2] + w * square(r)]
        };
        pairs.fold([0; 3], weigh).map(f64::from)
    }
}
