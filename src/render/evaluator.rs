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

/// Reference pictures of the original, one a view, row by row, 8-bit luminance.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reference {
    /// `image_size`² luminances for each view.
    pub pictures: Vec<Vec<u8>>,
}
