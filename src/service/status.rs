//! Errors to gRPC statuses: the one table, and its reading on the client's side.

use std::{collections::HashMap, time::Duration};

use tonic::{Code, Status};
use tonic_types::{ErrorDetails, FieldViolation, StatusExt};

use crate::jobs::{
    error::{Error, MOST_TOLD},
    spec::Fault,
};

/// Domain of every `ErrorInfo`.
pub const DOMAIN: &str = "lookalike";
/// A worker's lease is not, or no longer, the job's.
pub const STALE_LEASE: &str = "STALE_LEASE";
/// The worker's host gets no jobs for now.
pub const OUT_OF_SERVICE: &str = "OUT_OF_SERVICE";
/// An upload begins beyond what the server holds of it: ask again how much that is.
pub const OFFSET: &str = "OFFSET";
/// The server is about to end: connect again in a moment.
pub const SHUTTING_DOWN: &str = "SHUTTING_DOWN";
/// The database or the object store does not answer for now: try again in a moment.
pub const AWAY: &str = "AWAY";
/// The server cannot write or read its objects: its disk is full, or may not be written.
pub const STORAGE: &str = "STORAGE";

/// Statuses travel in HTTP/2 headers, which are capped at 16 KiB by most peers.
const MAX_MESSAGE: usize = 1024;

fn row(error: &Error) -> (Code, &'static str) {
    match error {
        Error::NotFound(_) => (Code::NotFound, "NOT_FOUND"),
        Error::Invalid(_) => (Code::InvalidArgument, "INVALID"),
        Error::RequestIdReused(_) => (Code::AlreadyExists, "REQUEST_ID_REUSED"),
        Error::Illegal { .. } => (Code::FailedPrecondition, "ILLEGAL_TRANSITION"),
        Error::Stale { .. } => (Code::FailedPrecondition, STALE_LEASE),
        Error::OutOfService { .. } => (Code::FailedPrecondition, OUT_OF_SERVICE),
        Error::Gap { .. } => (Code::OutOfRange, "EVENT_GAP"),
        Error::Offset { .. } => (Code::OutOfRange, OFFSET),
        Error::Corrupt { .. } => (Code::DataLoss, "CORRUPT"),
        Error::TooLarge { .. } => (Code::ResourceExhausted, "TOO_LARGE"),
        Error::QueueFull(_) => (Code::ResourceExhausted, "QUEUE_FULL"),
        Error::Quota { .. } => (Code::ResourceExhausted, "QUOTA"),
        Error::UnderWay | Error::Busy => (Code::Unavailable, AWAY),
        error if error.is_passing() => (Code::Unavailable, AWAY),
        Error::InUse(_) | Error::OtherObjects(_) => (Code::FailedPrecondition, "IN_USE"),
        Error::Sql(_) | Error::Migrate(_) | Error::Stored { .. } => (Code::Internal, "DATABASE"),
        Error::Io { .. } | Error::Objects { .. } | Error::PlainEndpoint(_) => {
            (Code::Internal, STORAGE)
        }
        Error::Task(_) => (Code::Internal, "TASK"),
    }
}

/// The status for an error. Faults of the server are logged here, once.
pub fn status_of(error: &Error) -> Status {
    let (code, reason) = row(error);
    let is_clients = matches!(error, Error::UnderWay | Error::Busy);
    if [Code::Internal, Code::Unavailable].contains(&code) && !is_clients {
        tracing::error!(%error, reason, "a request failed");
    }
    let mut details = ErrorDetails::with_error_info(reason, DOMAIN, metadata_of(error));
    if let Error::Invalid(faults) = error {
        let faults = faults.iter().take(MOST_TOLD);
        details.set_bad_request(faults.map(violation).collect::<Vec<_>>());
    }
    let must_wait =
        matches!(error, Error::QueueFull(_) | Error::Quota { .. } | Error::OutOfService { .. });
    let pause = if error.is_passing() { Some(1) } else { None };
    let pause = if must_wait { Some(5) } else { pause };
    if let Some(secs) = pause {
        details.set_retry_info(Some(Duration::from_secs(secs)));
    }
    Status::with_error_details(code, shorten(&error.to_string()), details)
}

/// A call that does not reach its handler.
pub(super) fn refusal(code: Code, reason: &str, text: &str, retry: Option<Duration>) -> Status {
    let mut details = ErrorDetails::with_error_info(reason, DOMAIN, HashMap::new());
    if retry.is_some() {
        details.set_retry_info(retry);
    }
    Status::with_error_details(code, text, details)
}

/// The server ends while a stream is open.
pub fn shutting_down() -> Status {
    let details = ErrorDetails::with_error_info(SHUTTING_DOWN, DOMAIN, HashMap::new());
    let text = "the server is shutting down: connect again in a moment";
    Status::with_error_details(Code::Unavailable, text, details)
}

/// One fault of a request.
pub fn invalid(field: &str, text: impl Into<String>) -> Status {
    status_of(&Error::invalid(field, text))
}

/// The `ErrorInfo` reason, if the status is an answer of a Lookalike server.
pub fn reason_of(status: &Status) -> Option<String> {
    let info = status.get_details_error_info()?;
    (info.domain == DOMAIN).then_some(info.reason)
}

/// The field violations of a status.
pub fn faults_of(status: &Status) -> Vec<Fault> {
    let violations = status.get_details_bad_request().map(|details| details.field_violations);
    let violations = violations.unwrap_or_default().into_iter();
    violations.map(|v| Fault { field: v.field, text: v.description }).collect()
}

fn metadata_of(error: &Error) -> HashMap<String, String> {
    let pairs = match error {
        Error::Illegal { job, state, .. } => {
            vec![("job", job.clone()), ("state", state.to_string())]
        }
        Error::Stale { job, epoch, .. } => vec![("job", job.clone()), ("epoch", epoch.to_string())],
        Error::Gap { held, .. } | Error::Offset { held, .. } => vec![("held", held.to_string())],
        _ => Vec::new(),
    };
    pairs.into_iter().map(|(key, value)| (key.into(), value)).collect()
}

fn violation(fault: &Fault) -> FieldViolation {
    FieldViolation {
        field: fault.field.clone(),
        description: fault.text.clone(),
        ..FieldViolation::default()
    }
}

fn shorten(text: &str) -> String {
    match text.char_indices().nth(MAX_MESSAGE) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_fault_reaches_the_client() {
        let wanted = ["triangles[1]", "render.image_size"].map(str::to_owned);
        let faults = wanted.clone().map(|field| Fault { field, text: "wrong".into() });
        let status = status_of(&Error::Invalid(faults.to_vec()));
        assert_eq!(status.code(), Code::InvalidArgument);
        let fields: Vec<_> = faults_of(&status).into_iter().map(|fault| fault.field).collect();
        assert_eq!(fields, wanted);
    }

    #[test]
    fn statuses_stay_below_the_header_cap() {
        let fault = Fault { field: "spec.render.custom_views[63]".into(), text: "x".repeat(80) };
        let status = status_of(&Error::Invalid(vec![fault; 1000]));
        assert!(status.details().len() * 4 / 3 + status.message().len() < 16 << 10);
    }

    #[test]
    fn answers_differ_from_broken_connections() {
        assert_eq!(reason_of(&shutting_down()).as_deref(), Some(SHUTTING_DOWN));
        assert_eq!(reason_of(&Status::unavailable("broken pipe")), None);
    }
}
