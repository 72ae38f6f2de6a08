//! One attempt of a job, from the bytes of a model to the files of the result.

use std::{ops::ControlFlow, path::Path};

use crate::jobs::{event::Report, spec::Spec};

/// Which evaluator to use: `auto` measures and takes the fastest, `cpu` is the native twin,
/// anything else names an adapter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeviceChoice(pub String);

/// Why an attempt ended without a result.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// The model or the specification is at fault; trying again cannot help.
    #[error("{code}: {text}")]
    Job {
        /// Stable upper-snake-case code.
        code: &'static str,
        /// What, where, and what to do.
        text: String,
    },
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
    /// The machine is at fault (disk, device); another worker may succeed.
    #[error("{0}")]
    Machine(String),
}

/// Runs the whole job: reads `input` (the bytes of a model file; `name` gives the format by its
/// extension), writes every artifact into `out_dir`, and tells `on` of each step. `Break` from `on`
/// cancels.
pub fn run(
    _spec: &Spec,
    _name: &str,
    _input: &[u8],
    _out_dir: &Path,
    _device: &DeviceChoice,
    _on: &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError> {
    Err(PipelineError::Machine("the pipeline is not wired yet".into()))
}
