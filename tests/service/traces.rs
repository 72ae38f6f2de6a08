//! Traces, as a collector gets them from real processes: calls, and jobs over lost workers and servers.

use std::{
    collections::BTreeMap,
    net::TcpListener,
    sync::{Arc, Mutex},
    time::Duration,
};

use lookalike::{
    jobs::state::State,
    service::{auth::Secret, proto::v1},
};
use opentelemetry_proto::tonic::{
    collector::trace::v1::{
        ExportTraceServiceRequest, ExportTraceServiceResponse,
        trace_service_server::{TraceService, TraceServiceServer},
    },
    common::v1::{KeyValue, any_value::Value},
    trace::v1::{Span, span::SpanKind, status::StatusCode},
};
use prost::Message;
use rustix::process::Signal;
use tokio::task::JoinSet;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Code, Request, Response, Status, transport};

use crate::{
    auth::{ANN, Guarded},
    support::{
        Server, create, create_request, ended, eventually, free_ports, job, signal, small_torus,
        state, upload_as, with_token,
    },
    web::Web,
};

const CALLER: &str = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
const CREATE: &str = "lookalike.v1.LookalikeService/CreateJob";

/// Takes spans and keeps them.
#[derive(Clone, Default)]
struct Ear(Arc<Mutex<Vec<ExportTraceServiceRequest>>>);

#[tonic::async_trait]
impl TraceService for Ear {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        self.0.lock().unwrap().push(request.into_inner());
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

/// A collector in this process.
struct Collector {
    url: String,
    ear: Ear,
    _tasks: JoinSet<()>,
}

impl Collector {
    async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let ear = Ear::default();
        let service = TraceServiceServer::new(ear.clone());
        let server = transport::Server::builder().add_service(service);
        let mut tasks = JoinSet::new();
        tasks.spawn(async move {
            server.serve_with_incoming(TcpListenerStream::new(listener)).await.unwrap();
        });
        Self { url, ear, _tasks: tasks }
    }

    fn flag(&self) -> String {
        format!("--otlp-endpoint={}", self.url)
    }

    fn requests(&self) -> Vec<ExportTraceServiceRequest> {
        self.ear.0.lock().unwrap().clone()
    }

    /// What came of the trace that the caller has begun.
    fn spans(&self) -> Vec<Span> {
        let of_resource = self.requests().into_iter().flat_map(|request| request.resource_spans);
        let of_scope = of_resource.flat_map(|resource| resource.scope_spans);
        let spans = of_scope.flat_map(|scope| scope.spans);
        spans.filter(|span| CALLER.contains(&hex(&span.trace_id))).collect()
    }

    /// Waits for spans of this name.
    async fn named(&self, name: &str, n_spans: usize) -> Vec<Span> {
        eventually(name, || async {
            let spans = self.spans().into_iter().filter(|span| span.name == name);
            Some(spans.collect::<Vec<_>>()).filter(|spans| spans.len() >= n_spans)
        })
        .await
    }

    fn service_names(&self) -> Vec<String> {
        let resources = self.requests().into_iter().flat_map(|request| request.resource_spans);
        let resources = resources.filter_map(|resource| resource.resource);
        resources.map(|resource| text(&resource.attributes, "service.name")).collect()
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |hex, byte| format!("{hex}{byte:02x}"))
}

/// An attribute as a text; empty where there is none.
fn text(attributes: &[KeyValue], name: &str) -> String {
    let found = attributes.iter().find(|attribute| attribute.key == name);
    match found.and_then(|attribute| attribute.value.as_ref()?.value.as_ref()) {
        Some(Value::StringValue(text)) => text.clone(),
        Some(Value::IntValue(number)) => number.to_string(),
        Some(Value::DoubleValue(number)) => number.to_string(),
        Some(Value::BoolValue(is_so)) => is_so.to_string(),
        _ => String::new(),
    }
}

fn said(span: &Span, name: &str) -> String {
    text(&span.attributes, name)
}

/// How many spans there are of each kind: `name < name of the parent`.
fn tree(spans: &[Span]) -> BTreeMap<String, usize> {
    let mut tree = BTreeMap::new();
    for span in spans {
        let parent = spans.iter().find(|parent| parent.span_id == span.parent_span_id);
        let parent = parent.map_or_else(|| hex(&span.parent_span_id), |span| span.name.clone());
        *tree.entry(format!("{} < {parent}", span.name)).or_default() += 1;
    }
    tree
}

fn with_trace<T>(message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.metadata_mut().insert("traceparent", CALLER.parse().unwrap());
    request
}

#[tokio::test]
async fn a_job_is_one_trace_over_lost_workers_and_servers() {
    let collector = Collector::start().await;
    let mut guarded = Guarded::start(&["--workers=1", &collector.flag()]);
    let tokens = guarded.tokens.clone();
    let mut client = with_token(&guarded.server, tokens[ANN].as_deref().unwrap());
    let mesh = upload_as(&mut client, small_torus()).await;
    let created = client.create_job(with_trace(create_request(&mesh, ""))).await.unwrap();
    let name = created.into_inner().job.unwrap().name;
    eventually("the job to run", || {
        let (mut client, request) = (client.clone(), v1::GetJobRequest { name: name.clone() });
        async move {
            let job = client.get_job(request).await.unwrap().into_inner().job.unwrap();
            (state(&job) == State::Running).then_some(())
        }
    })
    .await;
    guarded.server.worker_pids().into_iter().for_each(|pid| signal(pid, Signal::KILL));
    collector.named("attempt", 1).await;
    guarded.server.kill();
    guarded.server.restart();
    assert_eq!(state(&ended(&client, &name).await), State::Succeeded);
    collector.named("job", 1).await;
    check_job(&collector.spans(), &name);
    assert!(collector.service_names().iter().all(|name| name == "lookalike"));
    // Nothing that lets anybody in is told.
    for request in collector.requests() {
        let bytes = request.encode_to_vec();
        let tells = |secret: &str| bytes.windows(secret.len()).any(|w| w == secret.as_bytes());
        assert!(!tokens.iter().flatten().any(|token| tells(token)) && !tells("authorization"));
    }
}

fn check_job(spans: &[Span], name: &str) {
    let tree = tree(spans);
    for (line, n_spans) in [
        (&*format!("{CREATE} < 00f067aa0ba902b7"), 1),
        (&format!("job < {CREATE}"), 1),
        ("queue < job", 2),
        ("attempt < job", 2),
        ("prepare < attempt", 2),
        ("memoryless < attempt", 1),
        ("image < attempt", 1),
        ("optimize < attempt", 2),
        ("write < attempt", 1),
    ] {
        assert!(tree.get(line).is_some_and(|n| *n >= n_spans), "{n_spans} {line}: {tree:#?}");
    }
    assert!(!tree.keys().any(|line| line.contains("GetJob")), "{tree:#?}");
    let named = |name: &'static str| spans.iter().filter(move |span| span.name == name);
    let call = named(CREATE).next().unwrap();
    assert_eq!(call.kind, SpanKind::Server as i32);
    for (attribute, wanted) in [
        ("rpc.method", "CreateJob"),
        ("rpc.grpc.status_code", "0"),
        ("lookalike.principal", "ann"),
        ("lookalike.owner", "ann"),
        ("lookalike.resource", name),
    ] {
        assert_eq!(said(call, attribute), wanted, "{attribute}");
    }
    assert_eq!(said(call, "lookalike.request_id").len(), 36);
    let mut attempts: Vec<_> = named("attempt").collect();
    attempts.sort_by_key(|attempt| attempt.start_time_unix_nano);
    // The server may have died just when it gave the job away again.
    let (first, last) = (attempts[0], attempts[attempts.len() - 1]);
    assert_eq!(said(first, "lookalike.attempt"), "1");
    assert_eq!(said(last, "lookalike.attempt"), attempts.len().to_string(), "{attempts:?}");
    assert_eq!(said(first, "lookalike.reason"), "WORKER_EXITED");
    assert_eq!(said(last, "lookalike.reason"), "COMPLETED");
    assert!(!said(last, "lookalike.device").is_empty());
    let failed = |span: &Span| span.status.as_ref().is_some_and(|s| s.code() == StatusCode::Error);
    assert_eq!((failed(first), failed(last)), (true, false));
    let last = named("optimize").max_by_key(|stage| stage.start_time_unix_nano).unwrap();
    for number in ["evaluations", "triangles", "energy"] {
        let number = said(last, &format!("lookalike.{number}"));
        assert!(number.parse::<u64>().unwrap() > 0, "{last:?}");
    }
    assert_eq!(said(last, "lookalike.level"), "1");
    assert!(spans.iter().all(|span| span.end_time_unix_nano >= span.start_time_unix_nano));
}

#[tokio::test]
async fn calls_of_all_kinds_are_told_with_their_ends() {
    let collector = Collector::start().await;
    // As other programs have it.
    let variable = |name: &str, value: &str| (name.to_owned(), value.to_owned());
    let endpoint = variable("OTEL_EXPORTER_OTLP_ENDPOINT", &collector.url);
    let environment = vec![endpoint, variable("OTEL_SERVICE_NAME", "farm")];
    let server = Server::start_in(&["--workers=0"], environment);
    let mut client = server.client();
    let name = create(&mut client).await;
    let watch = v1::WatchJobRequest { name: name.clone(), after_seq: 0 };
    let mut log = client.watch_job(with_trace(watch)).await.unwrap().into_inner();
    log.message().await.unwrap();
    drop(log);
    let trace = [("traceparent", CALLER)];
    Web::new(&server, None).send("GET", "/api/v1/jobs/0", &trace, String::new()).await;
    for (method, code) in [("GetJob", Code::NotFound), ("WatchJob", Code::Cancelled)] {
        let span = format!("lookalike.v1.LookalikeService/{method}");
        let span = collector.named(&span, 1).await.remove(0);
        assert_eq!(said(&span, "rpc.grpc.status_code"), (code as i32).to_string(), "{method}");
        assert_eq!(hex(&span.parent_span_id), "00f067aa0ba902b7");
        // It is the caller's fault, not the server's.
        assert!(span.status.is_none_or(|status| status.code() == StatusCode::Unset), "{method}");
    }
    assert!(collector.service_names().iter().all(|name| name == "farm"));
}

#[tokio::test]
async fn refused_calls_are_told_without_what_they_tried() {
    let collector = Collector::start().await;
    let guarded = Guarded::start(&["--workers=0", &collector.flag()]);
    let mut stranger = with_token(&guarded.server, "lkl_wrong");
    let list = stranger.list_jobs(with_trace(v1::ListJobsRequest::default())).await;
    assert_eq!(list.unwrap_err().code(), Code::Unauthenticated);
    let span = collector.named("lookalike.v1.LookalikeService/ListJobs", 1).await.remove(0);
    assert_eq!(said(&span, "rpc.grpc.status_code"), (Code::Unauthenticated as i32).to_string());
    assert_eq!(said(&span, "lookalike.principal"), "");
    assert!(!format!("{:?}", collector.requests()).contains(Secret::new("lkl_wrong").reveal()));
}

#[tokio::test]
async fn a_collector_that_is_not_there_holds_nobody_up() {
    let [nobody] = free_ports();
    // Takes connections, and says nothing.
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    for address in [nobody, silent.local_addr().unwrap().to_string()] {
        let flag = format!("--otlp-endpoint=http://{address}");
        let mut server = Server::start_with(&["--workers=1", &flag]);
        let mut client = server.client();
        let name = create(&mut client).await;
        assert_eq!(state(&ended(&client, &name).await), State::Succeeded);
        assert_eq!(job(&mut client, &name).await.attempt, 1);
        drop(client);
        let (took, well) = server.terminate();
        assert!(well && took < Duration::from_secs(10), "{address}: {took:?}");
        let log = server.logged();
        assert!(log.matches("spans are lost: see that").count() <= 1, "{log}");
        assert!(log.contains("spans are lost: "), "{log}");
    }
}
