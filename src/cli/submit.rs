//! `lookalike submit`: a whole job on a server, from a file to a folder of results.

use std::path::{Path, PathBuf};

use clap::Args;
use lookalike::{
    jobs::{
        labels,
        spec::{Input, Spec},
    },
    service::{convert, proto::v1},
};

use super::{
    bar::Bar,
    exit::{Exit, Failure},
    fetch::{fetch_all, make_folder},
    job_args::JobArgs,
    remote::{Remote, ServerArgs},
    show, signals,
    watch::verdict,
};

/// Flags of `lookalike submit`.
#[derive(Args, Debug)]
pub(crate) struct SubmitArgs {
    /// The mesh: .glb, .gltf, .ply, .obj or .stl, or a .zip of one with its materials and images.
    file: PathBuf,
    /// Where to put the results.
    #[arg(long, value_name = "DIR", required_unless_present = "no_wait")]
    out: Option<PathBuf>,
    /// Print the job's name and return at once.
    #[arg(long)]
    no_wait: bool,
    /// Names this request: sending it again finds the job it made. Default: a new name.
    #[arg(long, value_name = "ID")]
    request_id: Option<String>,
    /// Called when the job has ended; the server names the hosts that may be.
    #[arg(long, value_name = "URL", default_value = "", hide_default_value = true)]
    webhook: String,
    #[command(flatten)]
    job: JobArgs,
    /// Jobs of higher priority come first: -10 to 10, more than 0 for administrators.
    #[arg(long, default_value_t = 0, allow_negative_numbers = true, value_name = "N")]
    priority: i32,
    /// What to call the job by, key=value; may be given several times.
    #[arg(long = "label", value_parser = labels::parse, value_name = "KEY=VALUE")]
    labels: Vec<(String, String)>,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn run(args: SubmitArgs) -> Result<(), Failure> {
    let spec = args.job.spec()?;
    let request = Request {
        id: args.request_id,
        out: args.out,
        no_wait: args.no_wait,
        webhook: args.webhook,
        priority: args.priority,
        labels: args.labels,
    };
    submit(&args.server, &args.file, None, spec, request).await
}

/// How a job is submitted.
#[derive(Debug)]
pub(crate) struct Request {
    /// Names the request; a new name where there is none.
    pub(crate) id: Option<String>,
    /// Where to put the results.
    pub(crate) out: Option<PathBuf>,
    /// Do not wait for the end.
    pub(crate) no_wait: bool,
    /// Called when the job has ended; empty for nobody.
    pub(crate) webhook: String,
    /// Those of higher priority come first.
    pub(crate) priority: i32,
    /// What to call the job by.
    pub(crate) labels: Vec<(String, String)>,
}

/// Uploads the original, and what it was simplified to where that is to be optimized; creates the
/// job, follows it and fetches its results.
pub(crate) async fn submit(
    server: &ServerArgs,
    original: &Path,
    simplified: Option<&Path>,
    mut spec: Spec,
    request: Request,
) -> Result<(), Failure> {
    let bytes = read_input(original)?;
    let simplified =
        simplified.map(|file| read_input(file).map(|b| (file_name(file), b))).transpose()?;
    if let (false, Some(out)) = (request.no_wait, request.out.as_deref()) {
        make_folder(out)?;
    }
    let remote = Remote::connect(server).await?;
    let mesh = remote.upload(bytes.into()).await?;
    if let Some((file_name, bytes)) = simplified {
        let mesh = convert::mesh_hash(&remote.upload(bytes.into()).await?);
        spec.simplified = Some(Input { mesh, file_name });
    }
    let request_id = request.id.unwrap_or_else(|| uuid::Uuid::new_v4().to_string());
    let wanted = v1::CreateJobRequest {
        request_id,
        mesh,
        file_name: file_name(original),
        spec: Some(convert::spec_to_wire(&spec)),
        webhook_url: request.webhook,
        priority: request.priority,
        labels: request.labels.into_iter().collect(),
    };
    let job = create(&remote, wanted).await?;
    if request.no_wait {
        show::print(&format!("{}\n", job.name));
        if let Some(out) = &request.out {
            eprintln!("then: lookalike fetch {} --out {}", job.name, out.display());
        }
        return Ok(());
    }
    wait(&remote, &job.name).await?;
    let end = verdict(&remote, &job.name).await;
    let keeps_results = end.as_ref().err().is_none_or(|failure| failure.exit == Exit::Cancelled);
    if let (true, Some(out)) = (keeps_results, request.out.as_deref()) {
        fetch_all(&remote, &job.name, out).await?;
    }
    end
}

/// Follows the job to its end. The first Ctrl-C cancels the job, the second one only this command.
pub(crate) async fn wait(remote: &Remote, job: &str) -> Result<(), Failure> {
    let mut bar = Bar::new();
    bar.line(&format!("{job} created"));
    let mut cancelled = false;
    let end = {
        let mut follow = std::pin::pin!(remote.follow(job, 0, |heard| bar.heard(heard)));
        loop {
            tokio::select! {
                end = &mut follow => break end,
                () = signals::asked_to_end() => {
                    if cancelled {
                        let text = format!("left; see `lookalike watch {job}`");
                        break Err(Failure::new(Exit::Cancelled, text));
                    }
                    cancelled = true;
                    remote.cancel(job).await?;
                }
            }
        }
    };
    bar.finish();
    end
}

/// Queues a job.
pub(crate) async fn create(
    remote: &Remote,
    request: v1::CreateJobRequest,
) -> Result<v1::Job, Failure> {
    let answer = remote.call(|mut client| {
        let request = request.clone();
        async move { client.create_job(request).await }
    });
    remote.present(answer.await?.job)
}

/// The bytes of the input file.
pub(crate) fn read_input(file: &Path) -> Result<Vec<u8>, Failure> {
    std::fs::read(file).map_err(|error| {
        let text = format!("{}: {error}; name a mesh file that can be read", file.display());
        Failure::new(Exit::Usage, text)
    })
}

/// The last part of a path.
pub(crate) fn file_name(file: &Path) -> String {
    file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}
