//! `lookalike fetch`: the results of a job into a folder.

use std::{
    fs, iter,
    path::{Path, PathBuf},
};

use clap::Args;
use lookalike::{
    jobs::state::State,
    service::{convert, proto::v1},
};

use super::{
    exit::{Exit, Failure},
    leftovers::Earlier,
    remote::{Remote, ServerArgs},
    show, summary,
};

/// Flags of `lookalike fetch`.
#[derive(Args, Debug)]
pub(crate) struct FetchArgs {
    /// The job, `jobs/{id}` or just the id.
    job: String,
    /// Where to put the files.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn run(args: FetchArgs) -> Result<(), Failure> {
    let remote = Remote::connect(&args.server).await?;
    fetch_all(&remote, &args.job, &args.out).await
}

/// Fetches every artifact of a job and prints their paths; fails where there is none.
pub(crate) async fn fetch_all(remote: &Remote, job: &str, folder: &Path) -> Result<(), Failure> {
    let job = remote.job(job).await?;
    let artifacts = remote.artifacts(&job.name).await?;
    if artifacts.is_empty() {
        return Err(nothing_of(&job));
    }
    make_folder(folder)?;
    let earlier = Earlier::of(folder);
    let mut written = Vec::new();
    for artifact in artifacts {
        remote.fetch(&artifact, folder).await?;
        let file = artifact.name.rsplit('/').next().unwrap_or_default();
        show::print(&format!("{}\n", folder.join(file).display()));
        written.push(file.to_owned());
    }
    let simplified = convert::spec_from_wire(job.spec).0.simplified;
    let inputs = iter::once(job.file_name).chain(simplified.map(|input| input.file_name));
    earlier.remove(folder, &written, &inputs.collect::<Vec<_>>());
    summary::tell(folder, &written);
    Ok(())
}

/// Why a job has no files, and what to do.
fn nothing_of(job: &v1::Job) -> Failure {
    let name = &job.name;
    let again = format!("`lookalike retry {name}` queues it anew");
    let (exit, text) = match show::state_of(job) {
        Some(State::Failed) => {
            let failure = job.failure.clone().unwrap_or_default();
            (Exit::Failed, format!("failed: {}: {}; {again}", failure.reason, failure.text))
        }
        Some(State::Cancelled) => {
            (Exit::Cancelled, format!("was cancelled and has no files: {again}"))
        }
        Some(State::Succeeded) => {
            let text = "succeeded, but its files are gone, as their time was up: submit the mesh anew, and \
                        keep what comes of it with `lookalike pin`";
            (Exit::Failed, text.into())
        }
        state => {
            let state = state.map_or("UNKNOWN", State::name);
            let text = format!("has not ended ({state}): wait with `lookalike watch {name}`");
            (Exit::Failed, text)
        }
    };
    Failure::new(exit, format!("{name} {text}"))
}

/// Creates the folder for results, and finds out whether files can be made in it: later would be too late.
pub(crate) fn make_folder(folder: &Path) -> Result<(), Failure> {
    let trial = folder.join(format!(".lookalike-{}", uuid::Uuid::new_v4().simple()));
    let tried = fs::create_dir_all(folder)
        .and_then(|()| fs::File::create_new(&trial))
        .and_then(|_| fs::remove_file(&trial));
    tried.map_err(|error| {
        let text = format!("{}: {error}; choose another --out", folder.display());
        Failure::new(Exit::Usage, text)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_without_files_says_why_and_what_to_do() {
        let failure = v1::JobFailure { reason: "EMPTY_MESH".into(), text: "no triangle".into() };
        for (state, exit, said) in [
            (State::Failed, Exit::Failed, "failed: EMPTY_MESH: no triangle; `lookalike retry"),
            (State::Cancelled, Exit::Cancelled, "cancelled and has no files: `lookalike retry"),
            (State::Succeeded, Exit::Failed, "time was up: submit the mesh anew"),
            (State::Running, Exit::Failed, "has not ended (RUNNING): wait with `lookalike watch"),
        ] {
            let job = v1::Job {
                name: "jobs/7".into(),
                state: convert::state_to_wire(state).into(),
                failure: Some(failure.clone()),
                ..v1::Job::default()
            };
            let found = nothing_of(&job);
            assert_eq!(found.exit, exit, "{state}");
            let text = found.error.to_string();
            assert!(text.starts_with("jobs/7 ") && text.contains(said), "{text}");
        }
    }

    #[test]
    fn a_folder_in_which_nothing_can_be_made_is_noticed() {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("not/there");
        for _ in 0..2 {
            assert!(make_folder(&folder).is_ok());
        }
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
        // It exists, and not even root can make a file in it.
        let failure = make_folder(Path::new("/proc")).unwrap_err();
        assert_eq!(failure.exit, Exit::Usage);
        assert!(failure.error.to_string().ends_with("choose another --out"), "{failure:?}");
    }
}
