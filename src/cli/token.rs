//! `lookalike token`: makes a token for somebody, and shows it once.

use std::{fs, io::Write, os::unix::fs::OpenOptionsExt, path::PathBuf};

use clap::Args;
use lookalike::{jobs::principal::Role, service::auth};

use super::{
    exit::{Exit, Failure},
    show,
};

/// Flags of `lookalike token`.
#[derive(Args, Debug)]
pub(crate) struct TokenArgs {
    /// Names the token: who or what will use it.
    name: String,
    /// Whose jobs and meshes it sees.
    #[arg(long)]
    owner: String,
    /// What it may do: viewer, user, worker, admin.
    #[arg(long)]
    role: Role,
    /// The server's file of principals, to which it is added. A server that uses it notices.
    #[arg(long, env = "LOOKALIKE_TOKENS", value_name = "FILE")]
    tokens: PathBuf,
}

pub(crate) fn run(args: &TokenArgs) -> Result<(), Failure> {
    let path = args.tokens.display();
    let failed = |error: std::io::Error| Failure::new(Exit::Failed, format!("{path}: {error}"));
    let usage = |fault: String| Failure::new(Exit::Usage, format!("{path}: {fault}"));
    let text = match fs::read_to_string(&args.tokens) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
        read => read.map_err(failed)?,
    };
    let (token, lines) = auth::issue(&text, &args.name, &args.owner, args.role).map_err(usage)?;
    let file = fs::File::options().create(true).append(true).mode(0o600).open(&args.tokens);
    let mut file = file.map_err(failed)?;
    file.write_all(lines.as_bytes()).and_then(|()| file.sync_all()).map_err(failed)?;
    // The one place that shows it.
    show::print(&format!("{}\n", token.reveal()));
    Ok(())
}
