//! Logs, metrics and traces: set up once, by `main`; the page that Prometheus reads, and what goes to a collector.
//!
//! Everything else only uses the `tracing` and `metrics` facades, and hands over [`Span`](trace::Span)s.

mod export;
pub mod trace;

use std::{
    io::{self, IsTerminal},
    net::SocketAddr,
    sync::Arc,
};

use axum::{Router, routing::get};
use futures::future::BoxFuture;
use metrics_exporter_prometheus::{BuildError, PrometheusBuilder, PrometheusHandle};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tracing_subscriber::EnvFilter;

pub use export::{Export, Spans, export_to};

/// Sends logs to standard error: everything from `level` on, unless `filter` (the syntax of
/// `RUST_LOG`) says otherwise. A second call changes nothing.
pub fn init_logs(level: &str, filter: Option<&str>, json: bool) {
    let filter = EnvFilter::try_new(filter.unwrap_or(level));
    let filter = filter.unwrap_or_else(|_| EnvFilter::new(level));
    let logs = tracing_subscriber::fmt().with_env_filter(filter).with_writer(io::stderr);
    let set = if json {
        logs.json().flatten_event(true).with_span_list(false).try_init()
    } else {
        logs.with_target(false).with_ansi(io::stderr().is_terminal()).try_init()
    };
    // Only fails when logs are set up already.
    drop(set);
}

/// Collects metrics from now on; the handle renders them.
pub fn install_metrics() -> Result<PrometheusHandle, BuildError> {
    PrometheusBuilder::new().install_recorder()
}

/// Brings the metrics up to date, and says what the page has more of them; its error is shown to whoever asks for them.
pub type Refresh = Arc<dyn Fn() -> BoxFuture<'static, Result<String, String>> + Send + Sync>;

/// Serves `/metrics` (calling `refresh` before each page), `/healthz` (the process lives) and
/// `/readyz` (the store answers) until `shutdown`.
pub fn serve_metrics(
    listener: TcpListener,
    page: PrometheusHandle,
    refresh: Refresh,
    shutdown: CancellationToken,
) -> BoxFuture<'static, io::Result<()>> {
    use axum::http::{StatusCode, header::CONTENT_TYPE};
    let ready = Arc::clone(&refresh);
    let metrics = move || async move {
        match refresh().await {
            Ok(more) => {
                let kind = [(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")];
                Ok((kind, page.render() + &more))
            }
            Err(text) => Err((StatusCode::SERVICE_UNAVAILABLE, text)),
        }
    };
    let readyz = move || async move {
        ready().await.map(|_| "ready\n").map_err(|text| (StatusCode::SERVICE_UNAVAILABLE, text))
    };
    let router = Router::new()
        .route("/metrics", get(metrics))
        .route("/healthz", get(async || "alive\n"))
        .route("/readyz", get(readyz));
    let serve = axum::serve(listener, router).with_graceful_shutdown(shutdown.cancelled_owned());
    Box::pin(serve.into_future())
}

/// Binds a socket; the error names the address and the remedy.
pub async fn bind(flag: &str, address: SocketAddr) -> io::Result<TcpListener> {
    TcpListener::bind(address).await.map_err(|source| {
        let text = format!("{address}: {source}; free the port, or choose another with {flag}");
        io::Error::new(source.kind(), text)
    })
}
