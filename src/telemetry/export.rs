//! Spans on their way to an OpenTelemetry collector, by OTLP over gRPC.
//!
//! 1. Nobody waits: who has a span puts it into a bounded queue, or loses it. What is lost is counted.
//! 2. One task sends what is in the queue. A collector that cannot be reached costs one warning a minute.
//! 3. The end waits for no collector longer than it is told to.

use std::{
    fmt,
    time::{Duration, Instant},
};

use metrics::{counter, describe_counter};
use opentelemetry::{
    InstrumentationScope, Key, KeyValue, SpanId, TraceFlags, TraceId,
    trace::{SpanContext, SpanKind, Status, TraceState},
};
use opentelemetry_otlp::{
    ExporterBuildError, SpanExporter, WithExportConfig, WithTonicConfig,
    tonic_types::transport::ClientTlsConfig,
};
use opentelemetry_sdk::{
    Resource,
    trace::{SpanData, SpanExporter as _},
};
use tokio::{
    sync::mpsc,
    task::JoinSet,
    time::{sleep, timeout},
};
use tokio_util::sync::CancellationToken;

use super::trace::{Span, Value};

/// Spans that may wait, and that are sent at once.
const QUEUE: usize = 8192;
const BATCH: usize = 512;
/// Between batches that are not full.
const DELAY: Duration = Duration::from_millis(500);
/// What a batch may take, repetitions included, whatever the environment says.
const LONGEST_EXPORT: Duration = Duration::from_secs(30);
const BETWEEN_WARNINGS: Duration = Duration::from_mins(1);

/// Where spans go: to a collector or, by default, nowhere.
#[derive(Clone, Default)]
pub struct Spans(Option<mpsc::Sender<Span>>);

impl Spans {
    /// Whether there is a collector.
    pub fn is_on(&self) -> bool {
        self.0.is_some()
    }

    /// Sends a span, if it is wanted.
    pub fn send(&self, span: Span) {
        if let Some(queue) = self.0.as_ref().filter(|_| span.at.is_sampled)
            && queue.try_send(span).is_err()
        {
            count("LOST", 1);
        }
    }

    /// Spans as they come, for a test.
    #[cfg(test)]
    pub fn kept() -> (Self, mpsc::Receiver<Span>) {
        let (send, spans) = mpsc::channel(QUEUE);
        (Self(Some(send)), spans)
    }
}

impl fmt::Debug for Spans {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.is_on() { "Spans(on)" } else { "Spans(off)" })
    }
}

/// The task that sends spans.
#[derive(Debug)]
pub struct Export {
    stop: CancellationToken,
    /// Ends with this.
    task: JoinSet<()>,
}

impl Export {
    /// Sends what is in the queue, for so long at most.
    pub async fn finish(mut self, patience: Duration) {
        self.stop.cancel();
        if timeout(patience, self.task.join_next()).await.is_err() {
            tracing::warn!("the last spans are lost: the collector does not answer in time");
        }
    }
}

/// Sends spans to the collector at `endpoint`, from within a runtime. Headers, time limits and attributes of the
/// service are read from the usual OTEL_* variables.
pub fn export_to(endpoint: &str) -> Result<(Spans, Export), ExporterBuildError> {
    let exporter = SpanExporter::builder().with_tonic().with_endpoint(endpoint);
    let exporter = if endpoint.starts_with("https:") {
        exporter.with_tls_config(ClientTlsConfig::new().with_enabled_roots())
    } else {
        exporter
    };
    let mut exporter = exporter.build()?;
    exporter.set_resource(&resource());
    describe_counter!("lookalike_spans_total", "Spans of traces, by whether a collector got them");
    let (send, spans) = mpsc::channel(QUEUE);
    let stop = CancellationToken::new();
    let sender = Sender { exporter, scope: scope(), endpoint: endpoint.into(), warned: None };
    let mut task = JoinSet::new();
    task.spawn(sender.run(spans, stop.clone()));
    Ok((Spans(Some(send)), Export { stop, task }))
}

/// Who speaks: `lookalike`, unless OTEL_SERVICE_NAME or OTEL_RESOURCE_ATTRIBUTES say otherwise.
fn resource() -> Resource {
    let said = Resource::builder().build();
    let name = said.get(&Key::from_static_str("service.name")).map(|name| name.to_string());
    let is_named = name.is_some_and(|name| !name.starts_with("unknown_service"));
    let version = KeyValue::new("service.version", env!("CARGO_PKG_VERSION"));
    let named = Resource::builder().with_attribute(version);
    if is_named { named.build() } else { named.with_service_name("lookalike").build() }
}

fn scope() -> InstrumentationScope {
    InstrumentationScope::builder("lookalike").with_version(env!("CARGO_PKG_VERSION")).build()
}

fn count(outcome: &'static str, n_spans: usize) {
    counter!("lookalike_spans_total", "outcome" => outcome).increment(n_spans as u64);
}

struct Sender {
    exporter: SpanExporter,
    scope: InstrumentationScope,
    endpoint: String,
    warned: Option<Instant>,
}

impl Sender {
    async fn run(mut self, mut spans: mpsc::Receiver<Span>, stop: CancellationToken) {
        loop {
            let mut batch = Vec::with_capacity(BATCH);
            let n_spans = tokio::select! {
                n_spans = spans.recv_many(&mut batch, BATCH) => n_spans,
                () = stop.cancelled(), if !spans.is_closed() => {
                    spans.close();
                    continue;
                }
            };
            if n_spans == 0 {
                return;
            }
            self.export(batch).await;
            if n_spans < BATCH {
                tokio::select! {
                    () = sleep(DELAY) => {}
                    () = stop.cancelled() => {}
                }
            }
        }
    }

    async fn export(&mut self, batch: Vec<Span>) {
        let n_spans = batch.len();
        let batch = batch.into_iter().map(|span| on_wire(span, &self.scope)).collect();
        let fault = match timeout(LONGEST_EXPORT, self.exporter.export(batch)).await {
            Ok(Ok(())) => return count("SENT", n_spans),
            Ok(Err(error)) => error.to_string(),
            Err(_) => "it does not answer".into(),
        };
        count("LOST", n_spans);
        if self.warned.is_none_or(|warned| warned.elapsed() > BETWEEN_WARNINGS) {
            self.warned = Some(Instant::now());
            tracing::warn!(
                endpoint = self.endpoint,
                fault,
                n_spans,
                "spans are lost: see that a collector takes OTLP over gRPC at --otlp-endpoint"
            );
        }
    }
}

fn on_wire(span: Span, scope: &InstrumentationScope) -> SpanData {
    let attribute = |(name, value): (&'static str, Value)| match value {
        Value::Text(text) => KeyValue::new(name, text),
        Value::Int(number) => KeyValue::new(name, number),
        Value::Float(number) => KeyValue::new(name, number),
        Value::Bool(is_so) => KeyValue::new(name, is_so),
    };
    let (trace, id) = (TraceId::from(span.at.trace), SpanId::from(span.at.span));
    SpanData {
        span_context: SpanContext::new(
            trace,
            id,
            TraceFlags::SAMPLED,
            false,
            TraceState::default(),
        ),
        parent_span_id: span.parent.map_or(SpanId::INVALID, SpanId::from),
        parent_span_is_remote: span.is_call && span.parent.is_some(),
        span_kind: if span.is_call { SpanKind::Server } else { SpanKind::Internal },
        name: span.name.into(),
        start_time: span.start,
        end_time: span.end,
        attributes: span.attributes.into_iter().map(attribute).collect(),
        dropped_attributes_count: 0,
        events: opentelemetry_sdk::trace::SpanEvents::default(),
        links: opentelemetry_sdk::trace::SpanLinks::default(),
        status: span.error.map_or(Status::Unset, Status::error),
        instrumentation_scope: scope.clone(),
    }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;
    use crate::telemetry::trace::TraceContext;

    fn span(is_sampled: bool) -> Span {
        let now = SystemTime::now();
        let at = TraceContext { is_sampled, ..TraceContext::below(None) };
        let (name, attributes) = ("x".into(), Vec::new());
        Span {
            at,
            parent: None,
            is_call: false,
            name,
            start: now,
            end: now,
            attributes,
            error: None,
        }
    }

    #[tokio::test]
    async fn nobody_waits_for_a_collector() {
        let recorder = metrics_exporter_prometheus::PrometheusBuilder::new().build_recorder();
        for endpoint in ["http://127.0.0.1:1", "https://127.0.0.1:1"] {
            let (spans, export) = export_to(endpoint).unwrap();
            // The task has not had its turn yet.
            metrics::with_local_recorder(&recorder, || {
                (0..QUEUE + 3).for_each(|_| spans.send(span(true)));
                spans.send(span(false));
            });
            let start = Instant::now();
            export.finish(Duration::from_millis(200)).await;
            assert!(start.elapsed() < Duration::from_secs(5));
        }
        let page = recorder.handle().render();
        assert!(page.contains("lookalike_spans_total{outcome=\"LOST\"} 6"), "{page}");
    }

    #[test]
    fn without_a_collector_nothing_is_kept() {
        let spans = Spans::default();
        spans.send(span(true));
        assert!(!spans.is_on());
    }
}
