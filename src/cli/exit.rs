//! How a command fails: an exit code that scripts can rely on, and a text for people.

use std::process::ExitCode;

use lookalike::service::{
    client::is_transient,
    status::{faults_of, reason_of},
};
use tonic::Status;

use crate::config::Settings;

/// Exit codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Exit {
    /// The job or the command failed.
    Failed = 1,
    /// The command line or the job's specification is at fault.
    Usage = 2,
    /// No server answers.
    Unreachable = 3,
    /// The job was cancelled.
    Cancelled = 130,
}

/// A failed command.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(crate) exit: Exit,
    pub(crate) error: anyhow::Error,
}

impl Failure {
    pub(crate) fn new(exit: Exit, text: impl Into<String>) -> Self {
        Self { exit, error: anyhow::Error::msg(text.into()) }
    }

    /// Several faults, one a line.
    pub(crate) fn faults(faults: &[String]) -> Self {
        Self::new(Exit::Usage, faults.join("\n"))
    }

    /// Adds what to do once a server answers; other failures stay as they are.
    pub(crate) fn then(self, text: &str) -> Self {
        if self.exit != Exit::Unreachable {
            return self;
        }
        Self::new(self.exit, format!("{:#}; {text}", self.error))
    }

    /// Adds to faults of settings where these were set.
    pub(crate) fn at(self, settings: &Settings) -> Self {
        if self.exit != Exit::Usage {
            return self;
        }
        let lines = format!("{:#}", self.error);
        Self::faults(&lines.lines().map(|line| settings.with_places(line)).collect::<Vec<_>>())
    }

    /// Tells the person at the terminal.
    pub(crate) fn report(&self) -> ExitCode {
        for line in format!("{:#}", self.error).lines() {
            eprintln!("lookalike: {line}");
        }
        ExitCode::from(self.exit as u8)
    }
}

impl From<anyhow::Error> for Failure {
    fn from(error: anyhow::Error) -> Self {
        Self { exit: Exit::Failed, error }
    }
}

/// What a server answered, or that none did. `url` is where it should be.
pub(crate) fn refused(url: &str, status: &Status) -> Failure {
    let faults = faults_of(status);
    if reason_of(status).as_deref() == Some("INVALID") && !faults.is_empty() {
        let line =
            |fault: &lookalike::jobs::spec::Fault| format!("{}: {}", fault.field, fault.text);
        return Failure::faults(&faults.iter().map(line).collect::<Vec<_>>());
    }
    if is_transient(status) || stranger(status.message()).is_some() {
        return unreachable(url, status.message());
    }
    Failure::new(Exit::Failed, status.message())
}

/// No server answers at `url`.
pub(crate) fn unreachable(url: &str, why: &str) -> Failure {
    let mend = stranger(why).unwrap_or(
        "start one with `lookalike serve --data-dir DIR`, or name another with --server",
    );
    Failure::new(Exit::Unreachable, format!("no server answers at {url} ({why}): {mend}"))
}

/// What shows that something else answers than was called, and what to do.
const STRANGERS: [(&str, &str); 2] = [
    (
        "mapped from HTTP status code 404",
        "this port does not speak gRPC; name with --server the address at which `lookalike serve` says that it \
         listens, not that of its metrics",
    ),
    (
        "InvalidContentType",
        "what listens there speaks no TLS; name it with http:// instead of https://",
    ),
];

fn stranger(why: &str) -> Option<&'static str> {
    STRANGERS.iter().find(|(sign, _)| why.contains(*sign)).map(|(_, mend)| *mend)
}

#[cfg(test)]
mod tests {
    use super::*;
    use lookalike::service::status;

    #[test]
    fn answers_and_silence_have_different_exit_codes() {
        let url = "http://127.0.0.1:1";
        assert_eq!(refused(url, &Status::unavailable("refused")).exit, Exit::Unreachable);
        assert_eq!(refused(url, &status::invalid("name", "wrong")).exit, Exit::Usage);
        let elsewhere = "grpc-status header missing, mapped from HTTP status code 404";
        let elsewhere = refused(url, &Status::unimplemented(elsewhere));
        assert_eq!(elsewhere.exit, Exit::Unreachable);
        assert!(elsewhere.error.to_string().contains("does not speak gRPC"), "{elsewhere:?}");
        let no_tls = unreachable(url, "received corrupt message of type InvalidContentType");
        assert!(no_tls.error.to_string().contains("http:// instead"), "{no_tls:?}");
        let missing = lookalike::jobs::error::Error::NotFound("jobs/1".into());
        assert_eq!(refused(url, &status::status_of(&missing)).exit, Exit::Failed);
    }
}
