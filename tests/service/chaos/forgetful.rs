//! A proxy that carries calls to the server and loses replies on the way back: what the call asked for has
//! happened, and whoever called does not know.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use http_body_util::BodyExt;
use hyper_util::{
    rt::{TokioExecutor, TokioIo},
    server::conn::auto::Builder,
    service::TowerToHyperService,
};
use lookalike::service::client;
use tokio::{net::TcpListener, task::JoinSet};
use tonic::{
    Status,
    body::Body,
    codegen::{Bytes, StdError, http},
    transport::Channel,
};
use tower::Service;

/// Every so many-th reply of a method is lost, the first one always.
const EVERY: u64 = 3;
/// Calls that answer for as long as somebody listens: the other proxy is for them.
const STREAMS: [&str; 3] = ["WatchJob", "ReadArtifact", "FetchMesh"];

/// Calls so far by method, and of them those whose reply was lost.
type Counts = BTreeMap<String, (u64, u64)>;

/// A proxy, as long as it lives.
pub(super) struct Forgetful {
    pub(super) url: String,
    counts: Arc<Mutex<Counts>>,
    _connections: JoinSet<()>,
}

impl Forgetful {
    /// Stands in front of the server at `url`.
    pub(super) async fn start(url: &str) -> Self {
        let channel = client::channel(url).unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let counts = Arc::<Mutex<Counts>>::default();
        let counted = Arc::clone(&counts);
        let mut connections = JoinSet::new();
        connections.spawn(async move {
            let server = Arc::new(Builder::new(TokioExecutor::new()));
            let mut open = JoinSet::new();
            while let Ok((socket, _)) = listener.accept().await {
                let (channel, counts) = (channel.clone(), Arc::clone(&counted));
                let service = tower::service_fn(move |request| {
                    carry(channel.clone(), Arc::clone(&counts), request)
                });
                let (server, service) = (Arc::clone(&server), TowerToHyperService::new(service));
                open.spawn(async move {
                    let _ = server.serve_connection(TokioIo::new(socket), service).await;
                });
            }
        });
        Self { url, counts, _connections: connections }
    }

    /// Lost replies by method.
    pub(super) fn lost(&self) -> BTreeMap<String, u64> {
        let counts = self.counts.lock().unwrap();
        counts
            .iter()
            .filter(|(_, (_, lost))| *lost > 0)
            .map(|(m, (_, n))| (m.clone(), *n))
            .collect()
    }
}

/// Carries a call to its end, and its reply back unless it is to be lost: then the caller's stream is reset.
async fn carry<B>(
    mut channel: Channel,
    counts: Arc<Mutex<Counts>>,
    request: http::Request<B>,
) -> Result<http::Response<Body>, Status>
where
    B: http_body::Body<Data = Bytes> + Send + 'static,
    B::Error: Into<StdError>,
{
    let method = request.uri().path().rsplit('/').next().unwrap_or_default().to_owned();
    std::future::poll_fn(|cx| channel.poll_ready(cx)).await.map_err(away)?;
    let reply = channel.call(request.map(Body::new)).await.map_err(away)?;
    if STREAMS.contains(&&*method) || !is_lost(&counts, method) {
        return Ok(reply);
    }
    // All of it, so that the server is done.
    let _ = reply.into_body().collect().await;
    Err(Status::unavailable("the reply was lost"))
}

fn is_lost(counts: &Mutex<Counts>, method: String) -> bool {
    let mut counts = counts.lock().unwrap();
    let (calls, lost) = counts.entry(method).or_default();
    *calls += 1;
    let is_lost = *calls % EVERY == 1;
    *lost += u64::from(is_lost);
    is_lost
}

fn away(error: tonic::transport::Error) -> Status {
    Status::unavailable(error.to_string())
}
