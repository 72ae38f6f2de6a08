//! `lookalike fetch`: the results of a job into a folder.

use std::{
    fs,
    path::{Path, PathBuf},
};

use clap::Args;

use super::{
    exit::{Exit, Failure},
    remote::{Remote, ServerArgs},
    show,
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
    let job = remote.job(&args.job).await?;
    if show::state_of(&job).is_none_or(|state| !state.is_final()) {
        let text = format!("{0} has not ended: wait with `lookalike watch {0}`", job.name);
        return Err(Failure::new(Exit::Failed, text));
    }
    fetch_all(&remote, &job.name, &args.out).await
}

/// Fetches every artifact of a job and prints their paths.
pub(crate) async fn fetch_all(remote: &Remote, job: &str, folder: &Path) -> Result<(), Failure> {
    make_folder(folder)?;
    for artifact in remote.artifacts(job).await? {
        remote.fetch(&artifact, folder).await?;
        let file = artifact.name.rsplit('/').next().unwrap_or_default();
        show::print(&format!("{}\n", folder.join(file).display()));
    }
    Ok(())
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
