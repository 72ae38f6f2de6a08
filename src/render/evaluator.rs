//! The one question every image-driven algorithm asks, and the trait its two answers share.
//!
//! *By how much does the summed squared luminance difference over all pictures change if these
//! triangles go and those come?* (Lindstrom & Turk 2000, section 5.) Answers are exact integers:
//! the native twin and the WGSL device agree to the bit, in any batch size and on any adapter.

use super::{moves::Move, scene::Scene};

/// Why an evaluator cannot go on. The machine is at fault, never the model.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// No device of that name.
    #[error("no graphics adapter matches `{wanted}`; there is {present}; `cpu` always works")]
    NoAdapter {
        /// What was asked for.
        wanted: String,
        /// The adapters' names, or what to install when there is none.
        present: String,
    },
    /// The device was lost or ran out of memory.
    #[error("graphics device failed: {0}")]
    Device(String),
}

/// Pictures of the current model, kept ready for judging edits.
///
/// An evaluator is built from a [`Scene`] and reference pictures, and from then on follows every
/// `commit`; the scene passed in must be the one it was built from, with the same edits applied.
pub trait Evaluator: Send {
    /// What judges: `native`, or the adapter's name.
    fn name(&self) -> String;

    /// The change of energy (sum of squared luminance differences, 0..=255 units) of each move,
    /// each judged alone against the current model.
    fn evaluate(&mut self, scene: &Scene, moves: &[Move]) -> Result<Vec<i64>, RenderError>;

    /// Makes a move: brings the pictures up to date and applies it to the scene. Returns the
    /// change of energy, equal to what `evaluate` says of the same move.
    fn commit(&mut self, scene: &mut Scene, mv: &Move) -> Result<i64, RenderError>;

    /// The energy now.
    fn energy(&self) -> u64;

    /// The current picture of one view, row by row from the top, 8-bit luminance.
    fn picture(&mut self, scene: &Scene, view: usize) -> Result<Vec<u8>, RenderError>;
}

/// How much a pixel counts at most, where not all count the same.
pub const FULL_WEIGHT: u8 = 16;

/// Reference pictures of the original, one a view, row by row, 8-bit luminance.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reference {
    /// `image_size`² luminances for each view.
    pub pictures: Vec<Vec<u8>>,
    /// How often each pixel's squared difference counts, 1 to [`FULL_WEIGHT`], as many for each view; no pictures
    /// where all count once.
    pub weights: Vec<Vec<u8>>,
}

impl Reference {
    /// Pictures whose pixels all count once.
    pub fn plain(pictures: Vec<Vec<u8>>) -> Self {
        Self { pictures, weights: Vec::new() }
    }

    /// The weights of a view's pixels, where they have some.
    pub fn weights_in(&self, view: usize) -> Option<&[u8]> {
        self.weights.get(view).map(Vec::as_slice)
    }

    /// What a pixel counts at most.
    pub fn full_weight(&self) -> u8 {
        if self.weights.is_empty() { 1 } else { FULL_WEIGHT }
    }

    /// Sum over one view of the squared differences of these luminances, as often as each pixel counts.
    pub fn difference(&self, view: usize, luminances: impl Iterator<Item = u8>) -> u64 {
        let pairs = self.pictures[view].iter().zip(luminances);
        let squares = pairs.map(|(r, l)| u64::from(r.abs_diff(l)).pow(2));
        match self.weights_in(view) {
            None => squares.sum(),
            Some(weights) => squares.zip(weights).map(|(s, w)| s * u64::from(*w)).sum(),
        }
    }
}
