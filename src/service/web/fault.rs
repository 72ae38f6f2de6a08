//! Statuses as HTTP: the code of each, and its JSON (`google.rpc.Status`).

use http::{HeaderValue, Response, StatusCode, header};
use serde_json::{Value, json};
use tonic::{Code, Status, body::Body};
use tonic_types::StatusExt;

use super::with_json;
use crate::service::status;

/// The HTTP code of each gRPC code, as `google/rpc/code.proto` has them.
const CODES: [(Code, u16); 17] = [
    (Code::Ok, 200),
    (Code::Cancelled, 499),
    (Code::Unknown, 500),
    (Code::InvalidArgument, 400),
    (Code::DeadlineExceeded, 504),
    (Code::NotFound, 404),
    (Code::AlreadyExists, 409),
    (Code::PermissionDenied, 403),
    (Code::ResourceExhausted, 429),
    (Code::FailedPrecondition, 400),
    (Code::Aborted, 409),
    (Code::OutOfRange, 400),
    (Code::Unimplemented, 501),
    (Code::Internal, 500),
    (Code::Unavailable, 503),
    (Code::DataLoss, 500),
    (Code::Unauthenticated, 401),
];

/// A request that cannot be answered.
#[derive(Debug)]
pub(super) struct Fault {
    http: StatusCode,
    status: Box<Status>,
    header: Option<(header::HeaderName, HeaderValue)>,
}

/// Results of this module.
pub(super) type Result<T> = std::result::Result<T, Fault>;

impl From<Status> for Fault {
    fn from(status: Status) -> Self {
        let row = CODES.iter().find(|(code, _)| *code == status.code());
        let http = row.and_then(|(_, http)| StatusCode::from_u16(*http).ok());
        let http = http.unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        Self { http, status: Box::new(status), header: None }
    }
}

impl Fault {
    pub fn new(code: Code, reason: &str, text: &str) -> Self {
        status::refusal(code, reason, text, None).into()
    }

    /// One fault of a request.
    pub fn invalid(field: &str, text: impl Into<String>) -> Self {
        status::invalid(field, text).into()
    }

    pub fn no_route(path: &str) -> Self {
        let path: String = path.chars().take(128).collect();
        let text =
            format!("`{}` is no route: see README.md for those there are", path.escape_default());
        Self::new(Code::NotFound, "NO_ROUTE", &text)
    }

    pub fn no_verb(verbs: &str) -> Self {
        let fault = Self::new(Code::Unimplemented, "NO_ROUTE", &format!("use {verbs} here"));
        let header = HeaderValue::from_str(verbs).ok().map(|verbs| (header::ALLOW, verbs));
        Self { http: StatusCode::METHOD_NOT_ALLOWED, header, ..fault }
    }

    pub fn content_type(wanted: &str) -> Self {
        let text = format!("send it with the header `content-type: {wanted}`");
        let fault = Self::new(Code::InvalidArgument, "CONTENT_TYPE", &text);
        Self { http: StatusCode::UNSUPPORTED_MEDIA_TYPE, ..fault }
    }

    /// The range begins behind the end of a file of so many bytes.
    pub fn past_the_end(size: u64) -> Self {
        let text = format!("the range begins past the end: the file has {size} bytes");
        let fault = Self::new(Code::OutOfRange, "RANGE", &text);
        let header = HeaderValue::from_str(&format!("bytes */{size}"));
        let header = header.ok().map(|range| (header::CONTENT_RANGE, range));
        Self { http: StatusCode::RANGE_NOT_SATISFIABLE, header, ..fault }
    }

    pub fn response(&self) -> Response<Body> {
        let mut response = with_json(self.http, &to_json(&self.status));
        let headers = response.headers_mut();
        headers.extend(self.header.clone());
        if self.http == StatusCode::UNAUTHORIZED {
            headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
        }
        if let Some(wait) = retry_secs(&self.status) {
            headers.insert(header::RETRY_AFTER, HeaderValue::from(wait.ceil().max(1.0) as u64));
        }
        response
    }
}

fn retry_secs(status: &Status) -> Option<f64> {
    Some(status.get_details_retry_info()?.retry_delay?.as_secs_f64())
}

/// `google.rpc.Status` in proto-JSON.
pub(super) fn to_json(status: &Status) -> Value {
    let mut details = Vec::new();
    if let Some(info) = status.get_details_error_info() {
        details.push(json!({
            "@type": "type.googleapis.com/google.rpc.ErrorInfo",
            "reason": info.reason, "domain": info.domain, "metadata": info.metadata,
        }));
    }
    if let Some(request) = status.get_details_bad_request() {
        let violations = request.field_violations.into_iter();
        let violations =
            violations.map(|v| json!({"field": v.field, "description": v.description}));
        details.push(json!({
            "@type": "type.googleapis.com/google.rpc.BadRequest",
            "fieldViolations": violations.collect::<Vec<_>>(),
        }));
    }
    if let Some(secs) = retry_secs(status) {
        details.push(json!({
            "@type": "type.googleapis.com/google.rpc.RetryInfo", "retryDelay": format!("{secs:.3}s"),
        }));
    }
    json!({"code": status.code() as i32, "message": status.message(), "details": details})
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::jobs::{error::Error, spec};

    #[test]
    fn every_code_has_a_row() {
        for code in (0..17).map(Code::from) {
            assert_eq!(CODES.iter().filter(|(row, _)| *row == code).count(), 1, "{code:?}");
        }
    }

    #[test]
    fn details_reach_the_caller() {
        let fault = spec::Fault { field: "mesh".into(), text: "is none".into() };
        let body = to_json(&status::status_of(&Error::Invalid(vec![fault])));
        assert_eq!(body["code"], 3);
        assert_eq!(body["details"][0]["domain"], status::DOMAIN);
        let violations = &body["details"][1]["fieldViolations"];
        assert_eq!(violations, &json!([{"field": "mesh", "description": "is none"}]));
        let wait = Some(Duration::from_millis(1500));
        let busy = status::refusal(Code::ResourceExhausted, "RATE_LIMITED", "wait", wait);
        assert_eq!(to_json(&busy)["details"][1]["retryDelay"], "1.500s");
        let response = Fault::from(busy).response();
        assert_eq!(
            (response.status().as_u16(), &response.headers()["retry-after"]),
            (429, &HeaderValue::from(2))
        );
    }
}
