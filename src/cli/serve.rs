//! `lookalike serve`: wires store, gRPC, metrics and workers together, and takes them down in order.
//!
//! The end: workers hand their jobs back and end, then open streams are told to come back, then open
//! calls finish; a hard deadline cuts short whatever hangs.

use std::{sync::Arc, time::Duration};

use anyhow::Context;
use lookalike::{
    jobs::Jobs,
    service::{
        accept::{self, Listeners},
        auth::Gate,
        job_trace::trace_jobs,
        observe::{Observer, queue_page},
        server::{self, Doors},
        tls::ServerTls,
        webhook,
    },
    telemetry::{self, Export, Spans},
    worker::supervisor::Crew,
};
use tokio_util::sync::CancellationToken;

use super::{
    exit::{Exit, Failure},
    show, signals,
};
use crate::config::{Port, ServeArgs, ServeConfig};

/// Leases are looked at this often, or four times a lease if that is more often.
const SWEEP: Duration = Duration::from_secs(1);
/// Results whose time is up are looked for this often.
const TIDY: Duration = Duration::from_secs(60);
/// What nobody wants is looked for this often, and at the start.
const TIDY_ORPHANS: Duration = Duration::from_hours(1);
/// What open calls get to finish once the workers have ended.
const GRACE: Duration = Duration::from_secs(3);
/// What a collector gets to take the last spans.
const LAST_SPANS: Duration = Duration::from_secs(2);

pub(crate) async fn run(args: ServeArgs) -> Result<(), Failure> {
    let config = args.check().map_err(|faults| Failure::faults(&faults))?;
    let usage = |fault| Failure::new(Exit::Usage, fault);
    let gate = Gate::open(&config.guard.credentials, config.guard.rates.clone()).map_err(usage)?;
    let tls = config.guard.tls.as_ref().map(ServerTls::open).transpose().map_err(usage)?;
    let page = telemetry::install_metrics().context("metrics cannot be collected")?;
    let jobs = Jobs::open(config.places.clone(), config.terms.clone(), config.limits.clone());
    let jobs = jobs.await.map_err(|error| Failure::new(Exit::Failed, error.to_string()))?;
    let tcp = telemetry::bind("--listen", config.listen).await.context("gRPC")?;
    let unix = accept::bind_unix(&jobs.workers_dir()).context("the socket of local workers")?;
    let metrics =
        telemetry::bind("--metrics-listen", config.metrics_listen).await.context("metrics")?;
    let address = tcp.local_addr().context("gRPC")?;
    let scheme = if tls.is_some() { "https" } else { "http" };
    show::print(&format!("listening on {scheme}://{address}\n"));
    warn_of(&config.guard.exposed);
    let crowding = config.guard.crowding.clone();
    if let Err(n_files) = accept::allow_files(crowding.max_connections) {
        tracing::warn!(
            n_files,
            "so many files may be open: too few for --max-connections (ulimit -n, LimitNOFILE)"
        );
    }
    let listeners = Listeners { tcp, tls, crowding, unix };
    tracing::info!(%address, metrics = %config.metrics_listen, data_dir = %config.places.data_dir.display(), "ready");

    let (spans, export) = export(config.otlp_endpoint.as_deref())?;
    let (stop_workers, stop_serving) = (CancellationToken::new(), CancellationToken::new());
    let (traces, job_spans) = trace_jobs(jobs.clone(), spans.clone(), stop_serving.clone());
    let observer = Arc::new(Observer::new(traces));
    let refresh = refresh(jobs.clone(), Arc::clone(&observer));
    let observing = Arc::clone(&observer);
    let (origins, webhooks) = (config.guard.origins.clone(), config.webhooks.clone());
    let doors = Doors { gate, origins, webhooks: webhooks.clone(), spans };
    let grpc = server::serve(listeners, doors, jobs.clone(), observing, stop_serving.clone());
    let calls = Box::pin(webhook::run(jobs.clone(), webhooks, stop_serving.clone()));
    let http = telemetry::serve_metrics(metrics, page, refresh, stop_serving.clone());
    let crew = crew(&config);
    let workers = async {
        crew.run(stop_workers.clone(), async |id: String| gone(&jobs, &observer, &id).await).await;
        // A server without workers of its own has nobody to wait for.
        stop_workers.cancelled().await;
        stop_serving.cancel();
        Ok(())
    };
    let all = async {
        tokio::try_join!(
            async { grpc.await.context("gRPC") },
            async { http.await.context("metrics") },
            async { calls.await.context("webhooks") },
            workers,
            sweep(&jobs, &observer, config.terms.lease, &stop_serving),
            tidy(&jobs, &stop_serving),
            async {
                job_spans.await;
                Ok(())
            },
        )
    };
    tokio::select! {
        ended = all => { ended?; }
        () = deadline(&stop_workers, &stop_serving) => {
            tracing::warn!("some calls did not end in time and are cut off");
        }
    }
    jobs.close().await;
    if let Some(export) = export {
        export.finish(LAST_SPANS).await;
    }
    tracing::info!("ended");
    Ok(())
}

/// Where spans go, and the task that sends them.
fn export(endpoint: Option<&str>) -> anyhow::Result<(Spans, Option<Export>)> {
    let Some(endpoint) = endpoint else { return Ok((Spans::default(), None)) };
    let exported = telemetry::export_to(endpoint).context("traces cannot be exported");
    let (spans, export) = exported.context("see --otlp-endpoint and the OTEL_* variables")?;
    tracing::info!(endpoint, "traces are exported");
    Ok((spans, Some(export)))
}

/// Says which ports anybody can reach.
fn warn_of(exposed: &[Port]) {
    for port in exposed {
        tracing::warn!(
            ?port,
            "--insecure-listen: this port has no TLS or no authentication, and anybody who reaches it is let in"
        );
    }
}

/// Waits for a signal, starts the end, and returns when the end takes too long: the workers have
/// their own limit, and open calls get [`GRACE`] after that. A second signal cuts it short.
async fn deadline(stop_workers: &CancellationToken, stop_serving: &CancellationToken) {
    signals::asked_to_end().await;
    tracing::info!("asked to end: workers hand their jobs back");
    stop_workers.cancel();
    let patience = async {
        stop_serving.cancelled().await;
        tokio::time::sleep(GRACE).await;
    };
    tokio::select! {
        () = patience => {}
        () = signals::asked_to_end() => {}
    }
}

/// Takes away leases that ran out, and makes room for jobs of higher priority, until the end.
async fn sweep(
    jobs: &Jobs,
    observer: &Observer,
    lease: Duration,
    stop: &CancellationToken,
) -> anyhow::Result<()> {
    let mut tick = tokio::time::interval(SWEEP.min(lease / 4));
    let mut room = tokio::time::interval(SWEEP);
    room.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            _ = tick.tick() => match jobs.sweep_leases().await {
                Ok(lost) => observer.lost(&lost),
                Err(error) => tracing::error!(%error, "leases cannot be checked"),
            },
            _ = room.tick() => match jobs.preempt().await {
                Ok(asked) => observer.preempted(&asked),
                Err(error) => tracing::error!(%error, "no room can be made for jobs that wait"),
            },
            () = stop.cancelled() => return Ok(()),
        }
    }
}

/// Removes results and jobs whose time is up, what is left of checkpoints, and what nobody wants, until the end.
async fn tidy(jobs: &Jobs, stop: &CancellationToken) -> anyhow::Result<()> {
    let mut tick = tokio::time::interval(TIDY);
    let mut rarely = tokio::time::interval(TIDY_ORPHANS);
    loop {
        tokio::select! {
            _ = tick.tick() => {
                match jobs.sweep_results().await {
                    Ok(0) => {}
                    Ok(n_jobs) => tracing::info!(n_jobs, "results were removed: their time was up"),
                    Err(error) => tracing::error!(%error, "results cannot be removed"),
                }
                match jobs.sweep_jobs().await {
                    Ok(0) => {}
                    Ok(n_jobs) => tracing::info!(n_jobs, "jobs were deleted: their time was up"),
                    Err(error) => tracing::error!(%error, "jobs cannot be deleted"),
                }
                if let Err(error) = jobs.sweep_checkpoints().await {
                    tracing::error!(%error, "checkpoints of ended jobs cannot be removed");
                }
            }
            _ = rarely.tick() => tokio::select! {
                swept = jobs.sweep_orphans() => if let Err(error) = swept {
                    tracing::error!(%error, "what nobody wants cannot be removed");
                },
                () = stop.cancelled() => return Ok(()),
            },
            () = stop.cancelled() => return Ok(()),
        }
    }
}

async fn gone(jobs: &Jobs, observer: &Observer, worker: &str) {
    match jobs.worker_gone(worker).await {
        Ok(lost) => observer.lost(&lost),
        // Its lease runs out by itself.
        Err(error) => tracing::error!(worker, %error, "a worker's jobs cannot be taken back"),
    }
}

fn refresh(jobs: Jobs, observer: Arc<Observer>) -> telemetry::Refresh {
    Arc::new(move || {
        let (jobs, observer) = (jobs.clone(), Arc::clone(&observer));
        Box::pin(async move {
            let counts = jobs.counts().await.map_err(|error| error.to_string())?;
            observer.depth(&counts);
            observer.fleet(&jobs.workers().await.map_err(|error| error.to_string())?);
            let queue = jobs.queue().await.map_err(|error| error.to_string())?;
            Ok(queue_page(&queue))
        })
    })
}

fn crew(config: &ServeConfig) -> Crew {
    // Children are started in whatever folder; their paths must not depend on it.
    let data_dir = std::path::absolute(&config.places.data_dir)
        .unwrap_or_else(|_| config.places.data_dir.clone());
    Crew {
        memory_mib: config.worker_memory_mib,
        cpu_secs: config.worker_cpu_secs,
        device: config.device.clone(),
        n_workers: config.n_workers,
        locks: data_dir.join("workers"),
        scratch: data_dir.join("scratch"),
        runtime_dir: data_dir.join("run"),
        log_json: config.log_json,
        drain: config.drain,
    }
}
