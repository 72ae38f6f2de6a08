//! `lookalike run`: a whole job in this process.

use std::{
    ops::ControlFlow,
    path::PathBuf,
    sync::atomic::{AtomicBool, Ordering},
};

use clap::Args;
use lookalike::worker::pipeline::{self, DeviceChoice, PipelineError};

use super::{
    bar::Bar,
    exit::{Exit, Failure},
    fetch::make_folder,
    job_args::JobArgs,
    show, signals,
    submit::{file_name, read_input},
};

/// Flags of `lookalike run`.
#[derive(Args, Debug)]
pub(crate) struct RunArgs {
    /// The mesh: .glb, .gltf, .ply, .obj or .stl.
    file: PathBuf,
    /// Where to put the results.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Evaluator: auto, cpu, or the name of an adapter.
    #[arg(long, env = "LOOKALIKE_DEVICE", default_value = "auto")]
    device: String,
    #[command(flatten)]
    job: JobArgs,
}

static STOP: AtomicBool = AtomicBool::new(false);

pub(crate) async fn run(args: RunArgs) -> Result<(), Failure> {
    let spec = args.job.spec()?;
    let input = read_input(&args.file)?;
    make_folder(&args.out)?;
    let (name, out, device) = (file_name(&args.file), args.out, DeviceChoice(args.device));
    let mut work = tokio::task::spawn_blocking(move || {
        let mut bar = Bar::new();
        let mut on = |report: lookalike::jobs::event::Report| {
            bar.report(&report);
            if let lookalike::jobs::event::Report::Artifact { name, .. } = &report {
                show::print(&format!("{}\n", out.join(name).display()));
            }
            if STOP.load(Ordering::Relaxed) {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        };
        let result = pipeline::run(&spec, &name, &input, &out, &device, &mut on);
        bar.finish();
        result
    });
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
