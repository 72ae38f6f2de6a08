//! One attempt of a job, from the bytes of a model to the files of the result.

use std::{
    fmt::Write,
    ops::ControlFlow,
    path::Path,
    time::{Duration, Instant},
};

use crate::jobs::{
    event::{EnergySample, Report},
    spec::Spec,
};

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

const STEPS: u32 = 50;

/// Runs the whole job: reads `input` (the bytes of a model file; `name` gives the format by its
/// extension), writes every artifact into `out_dir`, and tells `on` of each step. `Break` from `on`
/// cancels.
///
/// For now it does not simplify: it hashes the input in small steps, so that everything around it can
/// be exercised.
pub fn run(
    spec: &Spec,
    name: &str,
    input: &[u8],
    out_dir: &Path,
    _device: &DeviceChoice,
    on: &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError> {
    if input.is_empty() {
        let text = format!("{name} is empty: send a model file");
        return Err(PipelineError::Job { code: "EMPTY_FILE", text });
    }
    let start = Instant::now();
    let mut tell = |report| match on(report) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(PipelineError::Cancelled),
    };
    tell(Report::Note { code: "READ".into(), text: format!("{name}: {} bytes", input.len()) })?;
    let mut digest = blake3::hash(input);
    let mut records = Vec::new();
    let mut curve = String::from("seq,stage,evaluations,seconds,triangles,energy,d2\n");
    for step in 0..STEPS {
        std::thread::sleep(Duration::from_millis(20));
        digest = blake3::hash(&[digest.as_bytes(), input].concat());
        records.extend_from_slice(digest.as_bytes());
        let (first, bytes) = (u64::from(step), digest.as_bytes().to_vec());
        tell(Report::Records { first, count: 1, bytes })?;
        let sample = EnergySample {
            stage: "image".into(),
            evaluations: u64::from(step + 1) * 10,
            seconds: start.elapsed().as_secs_f64(),
            triangles: spec.triangles.iter().copied().max().unwrap_or(1),
            energy: Some(u64::from(digest.as_bytes()[0])),
            d2: Some(f64::from(digest.as_bytes()[0]) / 255.0),
        };
        let _ = writeln!(
            curve,
            "{step},image,{},{},{},{},{}",
            sample.evaluations,
            sample.seconds,
            sample.triangles,
            sample.energy.unwrap_or_default(),
            sample.d2.unwrap_or_default()
        );
        tell(Report::Sample(sample))?;
        let fraction = f64::from(step + 1) / f64::from(STEPS);
        tell(Report::Progress { stage: "image".into(), fraction, eta_secs: None })?;
    }
    let mut files =
        vec![("progressive.lkpm".to_owned(), records), ("energy.csv".into(), curve.into())];
    for (i, n_triangles) in spec.triangles.iter().enumerate() {
        let bytes = format!("{n_triangles} {digest} {}", spec.seed).into_bytes();
        files.push((format!("lod-{i}.glb"), bytes));
    }
    for (name, bytes) in files {
        let path = out_dir.join(&name);
        let fault = |e| PipelineError::Machine(format!("{}: {e}", path.display()));
        std::fs::write(&path, &bytes).map_err(fault)?;
        let (media_type, size) = ("application/octet-stream".into(), bytes.len() as u64);
        tell(Report::Artifact { name, media_type, size })?;
    }
    Ok(())
}
