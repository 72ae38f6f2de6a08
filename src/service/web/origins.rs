//! Which pages may call from a browser.
//!
//! 1. Pages of other origins are let in by name only (CORS), and hear nothing otherwise.
//! 2. What a browser sends for any page without asking leave (forms, plain text) changes nothing here.
//! 3. A server that lets everybody in answers browsers under names that nobody else can point at it: addresses,
//!    `localhost`, and hosts of the origins named. A page whose own name is pointed at this machine hears nothing.

use std::{net::IpAddr, str::FromStr, time::Duration};

use http::{HeaderMap, HeaderName, HeaderValue, Method, Request, Uri, header};
use tonic::{Code, body::Body};
use tower_http::cors::{AllowOrigin, CorsLayer};

use super::{
    fault::{Fault, Result},
    routes::{Answer, Found},
};
use crate::telemetry::trace::TRACEPARENT;

/// An origin of pages that may call: `https://HOST` or `https://HOST:PORT`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Origin {
    header: HeaderValue,
    host: String,
}

impl FromStr for Origin {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let fault = || "use https://HOST or https://HOST:PORT, without a path".to_owned();
        let uri: Uri = text.parse().map_err(|_| fault())?;
        let header = HeaderValue::from_str(text).map_err(|_| fault())?;
        let scheme = uri.scheme_str().filter(|scheme| ["http", "https"].contains(scheme));
        let (Some(scheme), Some(authority)) = (scheme, uri.authority()) else {
            return Err(fault());
        };
        // As browsers write it: lower case, and nothing behind the port.
        let is_plain =
            format!("{scheme}://{authority}") == text && !authority.as_str().contains('@');
        if !is_plain || text != text.to_lowercase() {
            return Err(fault());
        }
        Ok(Self { header, host: authority.host().into() })
    }
}

/// What browsers are told about pages of other origins; nothing where none may call.
pub(in crate::service) fn cross_origin(origins: &[Origin]) -> Option<CorsLayer> {
    if origins.is_empty() {
        return None;
    }
    let names = |names: &[&'static str]| -> Vec<HeaderName> {
        names.iter().copied().map(HeaderName::from_static).collect()
    };
    let sent = names(&[
        "authorization",
        "content-type",
        "grpc-timeout",
        "if-none-match",
        "if-range",
        "last-event-id",
        "range",
        TRACEPARENT,
        "x-grpc-web",
        "x-request-id",
        "x-user-agent",
    ]);
    let heard = names(&[
        "accept-ranges",
        "content-length",
        "content-range",
        "etag",
        "grpc-message",
        "grpc-status",
        "grpc-status-details-bin",
        "retry-after",
        "x-request-id",
    ]);
    let origins = origins.iter().map(|origin| origin.header.clone());
    Some(
        CorsLayer::new()
            .allow_origin(AllowOrigin::list(origins))
            .allow_methods([Method::GET, Method::HEAD, Method::POST, Method::DELETE])
            .allow_headers(sent)
            .expose_headers(heard)
            .max_age(Duration::from_hours(1)),
    )
}

/// Names under which browsers may call this server.
#[derive(Clone, Debug)]
pub(in crate::service) struct Hosts {
    /// Callers say who they are: any name will do.
    pub is_guarded: bool,
    /// Named besides addresses and `localhost`.
    pub named: Vec<String>,
}

impl Hosts {
    pub fn new(is_guarded: bool, origins: &[Origin]) -> Self {
        Self { is_guarded, named: origins.iter().map(|origin| origin.host.clone()).collect() }
    }

    pub(super) fn check(&self, request: &Request<Body>) -> Result<()> {
        let header = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
        let authority = request.uri().authority().cloned();
        let authority = authority.or_else(|| header?.parse().ok());
        let host = authority.as_ref().map(http::uri::Authority::host).unwrap_or_default();
        let bare = host.trim_start_matches('[').trim_end_matches(']');
        let is_sure = bare.parse::<IpAddr>().is_ok()
            || host == "localhost"
            || self.named.iter().any(|named| named.eq_ignore_ascii_case(host));
        if self.is_guarded || is_sure {
            return Ok(());
        }
        let text = "without --tokens or --jwks browsers are answered at an address, at localhost, or at a host \
                    that --allow-origin names";
        Err(Fault::new(Code::PermissionDenied, "HOST", text))
    }
}

/// A browser asks leave before it sends these types to another origin.
pub(super) fn check_content_type(found: &Found<'_>, headers: &HeaderMap) -> Result<()> {
    let wanted = match (found.answer, found.is_write) {
        (_, false) => return Ok(()),
        (Answer::Upload, true) => "application/octet-stream",
        // Browsers ask leave for the verb DELETE, whatever is sent with it.
        _ if found.method == "DeleteJob" => return Ok(()),
        _ => "application/json",
    };
    let given = headers.get(header::CONTENT_TYPE).and_then(|given| given.to_str().ok());
    let given = given.unwrap_or_default().split(';').next().unwrap_or_default().trim();
    if given.eq_ignore_ascii_case(wanted) { Ok(()) } else { Err(Fault::content_type(wanted)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn origins_are_read_as_browsers_write_them() {
        for good in ["https://farm.example.org", "http://127.0.0.1:5173", "http://localhost:3000"] {
            assert!(good.parse::<Origin>().is_ok(), "{good}");
        }
        for bad in [
            "",
            "*",
            "farm.example.org",
            "https://farm.example.org/",
            "https://Farm.example.org",
            "https://u@farm.example.org",
            "ftp://farm.example.org",
        ] {
            assert!(bad.parse::<Origin>().unwrap_err().contains("https://HOST"), "{bad}");
        }
    }

    #[test]
    fn names_that_others_can_point_here_are_not_answered() {
        let origins = ["http://farm:8080".parse().unwrap()];
        let table = [
            ("127.0.0.1:7420", true),
            ("[::1]:7420", true),
            ("localhost:7420", true),
            ("FARM:7420", true),
            ("evil.example.org:7420", false),
            ("localhost.evil.example.org", false),
            ("", false),
        ];
        for (host, wanted) in table {
            let request = Request::builder().header("host", host).body(Body::empty()).unwrap();
            let open = Hosts::new(false, &origins).check(&request);
            assert_eq!(open.is_ok(), wanted, "{host}");
            assert!(Hosts::new(true, &[]).check(&request).is_ok());
        }
    }
}
