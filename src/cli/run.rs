//! `lookalike run`: a whole job in this process.

use std::{
    iter,
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
};

use clap::Args;
use lookalike::{
    jobs::{event::Report, spec::Spec},
    tape::Tape,
    worker::pipeline::{self, DeviceChoice, Inputs, ModelFile, PipelineError},
};

use super::{
    bar::Bar,
    exit::{Exit, Failure},
    fetch::make_folder,
    job_args::JobArgs,
    leftovers::Earlier,
    show, signals,
    submit::{file_name, read_input},
    summary,
};

/// Flags of `lookalike run`.
#[derive(Args, Debug)]
pub(crate) struct RunArgs {
    /// The mesh: .glb, .gltf, .ply, .obj or .stl, or a .zip of one with its materials and images.
    file: PathBuf,
    #[command(flatten)]
    here: HereArgs,
    #[command(flatten)]
    job: JobArgs,
}

/// Where a job of this process computes, and where its results go.
#[derive(Args, Clone, Debug)]
pub(crate) struct HereArgs {
    /// Where to put the results.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Evaluator: auto, cpu, or the name of an adapter.
    #[arg(long, env = "LOOKALIKE_DEVICE", default_value = "auto")]
    device: String,
}

static STOP: AtomicBool = AtomicBool::new(false);

pub(crate) async fn run(args: RunArgs) -> Result<(), Failure> {
    here(args.job.spec()?, &args.file, None, args.here).await
}

/// Runs a job in this process.
pub(crate) async fn here(
    spec: Spec,
    original: &Path,
    simplified: Option<&Path>,
    args: HereArgs,
) -> Result<(), Failure> {
    let read = |file: &Path| read_input(file).map(|bytes| (file_name(file), bytes));
    let (original, simplified) = (read(original)?, simplified.map(read).transpose()?);
    make_folder(&args.out)?;
    let (out, device) = (args.out, DeviceChoice(args.device));
    let mut work =
        tokio::task::spawn_blocking(move || work(&spec, (original, simplified), &out, &device));
    let result = tokio::select! {
        result = &mut work => result,
        () = signals::asked_to_end() => {
            STOP.store(true, Ordering::Relaxed);
            work.await
        }
    };
    let result =
        result.map_err(|bug| Failure::new(Exit::Failed, format!("a bug in the program: {bug}")))?;
    result.map_err(|error| {
        let exit = match error {
            PipelineError::Cancelled => Exit::Cancelled,
            PipelineError::Job { .. } | PipelineError::Machine(_) => Exit::Failed,
        };
        Failure::new(exit, error.to_string())
    })
}

/// A file's name and bytes.
type Named = (String, Vec<u8>);

/// Runs a job, shows how far it is, and tells what it has written.
fn work(
    spec: &Spec,
    (original, simplified): (Named, Option<Named>),
    out: &Path,
    device: &DeviceChoice,
) -> Result<(), PipelineError> {
    let earlier = Earlier::of(out);
    let (mut bar, mut written) = (Bar::new(), Vec::new());
    let mut on = |report: Report| {
        bar.report(&report);
        if let Report::Artifact { name, .. } = report {
            written.push(name);
        }
        if STOP.load(Ordering::Relaxed) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    };
    let inputs = Inputs { original: model(&original), simplified: simplified.as_ref().map(model) };
    let result = pipeline::run(spec, &inputs, out, (device, &Tape::off()), &mut on);
    // What is printed below a living bar is wiped away with it.
    bar.finish();
    for name in &written {
        show::print(&format!("{}\n", out.join(name).display()));
    }
    if result.is_ok() {
        let inputs = iter::once(original).chain(simplified).map(|(name, _)| name);
        earlier.remove(out, &written, &inputs.collect::<Vec<_>>());
        summary::tell(out, &written);
    }
    result
}

fn model((name, bytes): &Named) -> ModelFile<'_> {
    ModelFile { name, bytes }
}
