//! The server: both gRPC APIs, gRPC-Web, HTTP/JSON, health and reflection on one port, until told to stop.

use std::{sync::Arc, time::Duration};

use futures::future::BoxFuture;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::Server;
use tonic_web::GrpcWebLayer;
use tower::util::option_layer;

use super::{
    accept::Listeners,
    api::Api,
    auth::{Gate, GateLayer},
    observe::Observer,
    proto::{
        DESCRIPTORS, v1::lookalike_service_server::LookalikeServiceServer,
        worker::v1::worker_service_server::WorkerServiceServer,
    },
    web::{Hosts, Origin, WebLayer, cross_origin},
    webhook::WebhookRules,
    worker_api::WorkerApi,
};
use crate::{jobs::Jobs, telemetry::Spans};

/// Largest message received: a batch of events with one large record chunk, and room to spare.
pub const MAX_MESSAGE_BYTES: usize = 16 << 20;

/// The server could not be set up, or its socket failed.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The protos and the binary disagree.
    #[error("the reflection service cannot be built: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
    /// The same.
    #[error("the HTTP/JSON routes cannot be built: {0}")]
    Descriptors(#[from] prost_reflect::DescriptorError),
    /// The socket failed.
    #[error("the gRPC socket failed: {0}")]
    Transport(#[from] tonic::transport::Error),
}

/// Who may come in, and who may be called.
#[derive(Debug)]
pub struct Doors {
    /// Lets calls in, or not.
    pub gate: Gate,
    /// Pages that may call from a browser.
    pub origins: Vec<Origin>,
    /// Whom jobs may have called.
    pub webhooks: WebhookRules,
    /// Where it is told of calls.
    pub spans: Spans,
}

/// Serves `jobs` on `listeners`, behind `doors`, until `shutdown`, then waits for open calls. Give it a deadline from
/// outside: peers that never close can hold hyper's graceful shutdown for an hour.
///
/// Boxed, so that the server is compiled with this crate and not again with every user of it.
pub fn serve(
    listeners: Listeners,
    doors: Doors,
    jobs: Jobs,
    observer: Arc<Observer>,
    shutdown: CancellationToken,
) -> BoxFuture<'static, Result<(), ServeError>> {
    Box::pin(run(listeners, doors, jobs, observer, shutdown))
}

async fn run(
    listeners: Listeners,
    doors: Doors,
    jobs: Jobs,
    observer: Arc<Observer>,
    shutdown: CancellationToken,
) -> Result<(), ServeError> {
    let Doors { gate, origins, webhooks, spans } = doors;
    let web = WebLayer::new(Hosts::new(gate.asks(), &origins))?;
    let uploads = gate.uploads();
    let gate = GateLayer::new(Arc::new(gate), jobs.clone(), spans);
    let api = Api {
        jobs: jobs.clone(),
        shutdown: shutdown.clone(),
        observer: Arc::clone(&observer),
        webhooks: Arc::new(webhooks),
        uploads,
    };
    let worker_api = WorkerApi { jobs, shutdown: shutdown.clone(), observer };
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<LookalikeServiceServer<Api>>().await;
    health.set_serving::<WorkerServiceServer<WorkerApi>>().await;
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(DESCRIPTORS)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .build_v1()?;
    let server = Server::builder()
        .max_concurrent_streams(256)
        .http2_max_header_list_size(16 << 10)
        .http2_keepalive_interval(Some(Duration::from_secs(20)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        .max_connection_age(Duration::from_hours(1))
        .accept_http1(true)
        .layer(option_layer(cross_origin(&origins)))
        .layer(web)
        .layer(GrpcWebLayer::new())
        .layer(gate)
        .add_service(health_service)
        .add_service(reflection)
        .add_service(LookalikeServiceServer::new(api).max_decoding_message_size(MAX_MESSAGE_BYTES))
        .add_service(
            WorkerServiceServer::new(worker_api).max_decoding_message_size(MAX_MESSAGE_BYTES),
        );
    let stop = async move {
        shutdown.cancelled().await;
        health.set_not_serving::<LookalikeServiceServer<Api>>().await;
        health.set_not_serving::<WorkerServiceServer<WorkerApi>>().await;
    };
    let (ready, connections) = mpsc::channel(1);
    let serve = server.serve_with_incoming_shutdown(ReceiverStream::new(connections), stop);
    // The sockets close as soon as the server takes no more connections.
    let (served, ()) = tokio::join!(serve, listeners.accept(ready));
    Ok(served?)
}
