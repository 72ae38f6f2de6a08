//! The client's side of a connection: channels that come back, and telling answers from failures.

use std::time::Duration;

use futures::future::BoxFuture;
use tonic::{
    Code, Status,
    transport::{Channel, Endpoint, Error},
};

use super::status::{AWAY, SHUTTING_DOWN, reason_of};

/// The text names no server.
#[derive(Debug, thiserror::Error)]
#[error("`{url}` is no server address: use a URL such as http://127.0.0.1:7420")]
pub struct BadUrl {
    url: String,
}

/// How to reach a server; connects at the first call and again after each loss.
pub fn endpoint(url: &str) -> Result<Endpoint, BadUrl> {
    let bad = || BadUrl { url: url.escape_default().to_string() };
    let endpoint = Endpoint::from_shared(url.to_owned()).map_err(|_| bad())?;
    if endpoint.uri().scheme_str() != Some("http") || endpoint.uri().host().is_none() {
        return Err(bad());
    }
    Ok(endpoint
        .connect_timeout(Duration::from_secs(5))
        .http2_keep_alive_interval(Duration::from_secs(20))
        .keep_alive_timeout(Duration::from_secs(20))
        .keep_alive_while_idle(true)
        .tcp_nodelay(true))
}

/// Connects now. Boxed, so that it is compiled with this crate.
pub fn connect(endpoint: Endpoint) -> BoxFuture<'static, Result<Channel, Error>> {
    Box::pin(async move { endpoint.connect().await })
}

/// [`endpoint`] as a channel that connects when first used.
pub fn channel(url: &str) -> Result<Channel, BadUrl> {
    Ok(endpoint(url)?.connect_lazy())
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
        assert!(endpoint("http://127.0.0.1:7420").is_ok());
        for bad in ["", "127.0.0.1:7420", "ftp://x", "https://x", "http://", "not a url"] {
            assert!(endpoint(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn only_broken_connections_are_worth_another_try() {
        assert!(is_transient(&Status::unavailable("connection refused")));
        assert!(is_transient(&super::super::status::shutting_down()));
        assert!(!is_transient(&super::super::status::invalid("name", "wrong")));
        assert!(!is_transient(&Status::unimplemented("another server")));
    }
}
