//! The client's side of a connection: channels that come back, and telling answers from failures.

use std::{fs, path::PathBuf, time::Duration};

use futures::future::BoxFuture;
use tonic::{
    Code, Request, Status,
    metadata::AsciiMetadataValue,
    service::{Interceptor, interceptor::InterceptedService},
    transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Error, Identity},
};

use super::{
    auth::Secret,
    status::{AWAY, SHUTTING_DOWN, reason_of},
};

/// A server cannot be called like this.
#[derive(Debug, thiserror::Error)]
pub enum BadTarget {
    /// The text names no server.
    #[error(
        "`{0}` is no server address: use a URL such as http://127.0.0.1:7420 or https://HOST:7420"
    )]
    Url(String),
    /// A file of credentials cannot be used.
    #[error("{}: {fault}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        fault: String,
    },
    /// A certificate without its key, or the other way round.
    #[error("a client certificate needs its key: give both --tls-cert and --tls-key")]
    HalfIdentity,
    /// TLS cannot be set up.
    #[error("TLS cannot be set up for {url}: {source}")]
    Tls {
        /// For which server.
        url: String,
        /// Why.
        source: Error,
    },
    /// The token has characters that no header can carry.
    #[error("the token is not plain ASCII: copy it again")]
    Token,
}

/// What a server asks of its clients.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Access {
    /// Says who calls.
    pub token: Option<Secret>,
    /// The authority of the server's certificate, in PEM; the system's authorities where there is none.
    pub ca: Option<PathBuf>,
    /// The client's own certificate, in PEM.
    pub cert: Option<PathBuf>,
    /// Its private key.
    pub key: Option<PathBuf>,
}

/// A channel whose calls say who makes them.
pub type Connection = InterceptedService<Channel, Bearer>;

/// Adds the token to each call.
#[derive(Clone)]
pub struct Bearer(Option<AsciiMetadataValue>);

impl std::fmt::Debug for Bearer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Bearer(…)")
    }
}

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(value) = &self.0 {
            request.metadata_mut().insert("authorization", value.clone());
        }
        Ok(request)
    }
}

impl Access {
    fn bearer(&self) -> Result<Bearer, BadTarget> {
        let value = |token: &Secret| {
            let mut value = AsciiMetadataValue::try_from(format!("Bearer {}", token.reveal()))
                .map_err(|_| BadTarget::Token)?;
            value.set_sensitive(true);
            Ok(value)
        };
        Ok(Bearer(self.token.as_ref().map(value).transpose()?))
    }

    fn tls(&self) -> Result<ClientTlsConfig, BadTarget> {
        let read = |path: &PathBuf| {
            fs::read(path).map_err(|e| BadTarget::File { path: path.clone(), fault: e.to_string() })
        };
        let tls = ClientTlsConfig::new();
        let tls = match &self.ca {
            Some(ca) => tls.ca_certificate(Certificate::from_pem(read(ca)?)),
            None => tls.with_enabled_roots(),
        };
        match (&self.cert, &self.key) {
            (Some(cert), Some(key)) => {
                Ok(tls.identity(Identity::from_pem(read(cert)?, read(key)?)))
            }
            (None, None) => Ok(tls),
            _ => Err(BadTarget::HalfIdentity),
        }
    }
}

/// How to reach a server; connects at the first call and again after each loss. `unix:PATH` is the
/// socket that a server has for its own workers.
pub fn endpoint(url: &str, access: &Access) -> Result<Endpoint, BadTarget> {
    let bad = || BadTarget::Url(url.escape_default().to_string());
    let is_local = url.starts_with("unix:");
    if url == "unix:" {
        return Err(bad());
    }
    let mut endpoint = Endpoint::from_shared(url.to_owned()).map_err(|_| bad())?;
    let scheme = endpoint.uri().scheme_str().map(str::to_owned);
    match scheme.as_deref() {
        _ if is_local => {}
        _ if endpoint.uri().host().is_none_or(str::is_empty) => return Err(bad()),
        Some("https") => {
            let fault = |source| BadTarget::Tls { url: url.into(), source };
            endpoint = endpoint.tls_config(access.tls()?).map_err(fault)?;
        }
        Some("http") => warn_of_the_clear(&endpoint, access),
        _ => return Err(bad()),
    }
    Ok(endpoint
        .connect_timeout(Duration::from_secs(5))
        .http2_keep_alive_interval(Duration::from_secs(20))
        .keep_alive_timeout(Duration::from_secs(20))
        .keep_alive_while_idle(true)
        .tcp_nodelay(true))
}

/// A token that leaves this machine without TLS can be read on the way.
fn warn_of_the_clear(endpoint: &Endpoint, access: &Access) {
    let host = endpoint.uri().host().unwrap_or_default();
    let address = host.trim_matches(['[', ']']).parse::<std::net::IpAddr>();
    let is_here = host == "localhost" || address.is_ok_and(|address| address.is_loopback());
    if access.token.is_some() && !is_here {
        tracing::warn!(host, "the token travels in the clear: use https:// if the server has TLS");
    }
}

/// Connects now. Boxed, so that it is compiled with this crate.
pub fn connect(
    endpoint: Endpoint,
    access: &Access,
) -> Result<BoxFuture<'static, Result<Connection, Error>>, BadTarget> {
    let bearer = access.bearer()?;
    Ok(Box::pin(async move { Ok(InterceptedService::new(endpoint.connect().await?, bearer)) }))
}

/// [`endpoint`] as a connection that is made when first used.
pub fn connection(url: &str, access: &Access) -> Result<Connection, BadTarget> {
    let channel = endpoint(url, access)?.connect_lazy();
    Ok(InterceptedService::new(channel, access.bearer()?))
}

/// [`connection`] to a server that asks for nothing.
pub fn channel(url: &str) -> Result<Channel, BadTarget> {
    Ok(endpoint(url, &Access::default())?.connect_lazy())
}

/// Whether the call may work later: the connection failed, or the server or what it stores things in
/// is away for a moment. Any other answer of a server (it carries an `ErrorInfo`) is final.
pub fn is_transient(status: &Status) -> bool {
    use Code::{Aborted, Cancelled, DeadlineExceeded, Internal, Unavailable, Unknown};
    match reason_of(status) {
        Some(reason) => [SHUTTING_DOWN, AWAY].contains(&&*reason),
        None => matches!(
            status.code(),
            Unavailable | Unknown | Cancelled | DeadlineExceeded | Internal | Aborted
        ),
    }
}

/// Growing pauses between attempts: 50 ms, doubling up to 2 s.
#[derive(Debug)]
pub struct Backoff {
    next: Duration,
}

impl Default for Backoff {
    fn default() -> Self {
        Self { next: Duration::from_millis(50) }
    }
}

impl Backoff {
    /// The longest pause.
    pub const MAX: Duration = Duration::from_secs(2);

    /// Waits, longer each time.
    pub async fn pause(&mut self) {
        tokio::time::sleep(self.next).await;
        self.next = (self.next * 2).min(Self::MAX);
    }

    /// After a success.
    pub fn reset(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_checked() {
        let access = Access::default();
        for good in ["http://127.0.0.1:7420", "https://example.org:7420", "unix:grpc.sock"] {
            assert!(endpoint(good, &access).is_ok(), "{good}");
        }
        for bad in ["", "127.0.0.1:7420", "ftp://x", "http://", "unix:", "not a url"] {
            assert!(endpoint(bad, &access).is_err(), "{bad}");
        }
        let half = Access { cert: Some("cert.pem".into()), ..Access::default() };
        assert!(matches!(endpoint("https://x", &half), Err(BadTarget::HalfIdentity)));
    }

    #[test]
    fn only_broken_connections_are_worth_another_try() {
        assert!(is_transient(&Status::unavailable("connection refused")));
        assert!(is_transient(&super::super::status::shutting_down()));
        assert!(!is_transient(&super::super::status::invalid("name", "wrong")));
        assert!(!is_transient(&Status::unimplemented("another server")));
    }
}
