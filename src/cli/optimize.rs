//! `lookalike optimize`: makes a mesh that any tool has simplified look more like its original, in
//! this process or on a server.

use std::path::PathBuf;

use clap::Args;
use lookalike::jobs::spec::{Input, Spec, Topology};

use super::{
    exit::Failure,
    job_args::{LockArgs, checked, word},
    optimize_args::OptimizeArgs,
    output_args::OutputArgs,
    picture_args::PictureArgs,
    remote::ServerArgs,
    run::{HereArgs, here},
    submit::{Request, file_name, submit},
};

/// Flags of `lookalike optimize`.
#[derive(Args, Debug)]
pub(crate) struct OptimizeCommandArgs {
    /// The original: .glb, .gltf, .ply, .obj or .stl, or a .zip of one with its materials and images.
    original: PathBuf,
    /// What some tool has simplified it to, at the same place and scale.
    simplified: PathBuf,
    /// Optimize on the server, which --server names, instead of in this process.
    #[arg(long)]
    remote: bool,
    #[command(flatten)]
    here: HereArgs,
    #[command(flatten)]
    optimize: OptimizeArgs,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    pictures: PictureArgs,
    /// Keep holes as they are, or let small ones close.
    #[arg(long, default_value = "free", value_parser = word::<Topology>(&["preserve", "free"]))]
    topology: Topology,
    #[command(flatten)]
    locks: LockArgs,
    /// Stop after this many seconds, set-up included; 0 for no limit.
    #[arg(long, default_value_t = 0.0, value_name = "SECS")]
    max_secs: f64,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn run(args: OptimizeCommandArgs) -> Result<(), Failure> {
    // An upload gives the mesh its name; in this process it needs none.
    let input = Input { mesh: String::new(), file_name: file_name(&args.simplified) };
    let spec = checked(Spec {
        optimize: args.optimize.optimize(),
        output: args.output.output(),
        render: args.pictures.render(),
        topology: args.topology,
        lock: args.locks.lock,
        hard_edge_degrees: args.locks.hard_edge_degrees,
        max_secs: args.max_secs,
        seed: args.seed,
        ..Spec::optimizing(input)
    })?;
    if !args.remote {
        return here(spec, &args.original, Some(&args.simplified), args.here).await;
    }
    let request = Request {
        id: None,
        out: Some(args.here.out),
        no_wait: false,
        webhook: String::new(),
        priority: 0,
        labels: Vec::new(),
    };
    submit(&args.server, &args.original, Some(&args.simplified), spec, request).await
}
