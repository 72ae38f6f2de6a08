//! What the server counts: the queue, claims, losses, evaluations, stage times, energy, bytes.
//!
//! Workers report running totals; this turns them into counters. Batches that are sent again are
//! recognised by their index and not counted twice. A lost attempt's work stays counted: it was done.

mod queue;

use std::{
    collections::BTreeMap,
    sync::{Mutex, MutexGuard, PoisonError},
};

use futures::{Stream, TryStreamExt};
use metrics::{Counter, counter, describe_counter, describe_gauge, gauge};
use prost::bytes::Bytes;

use super::job_trace::JobTraces;
use crate::jobs::{
    error::Error,
    event::{EnergySample, Report},
    lease::Lease,
    state::State,
    store::{Job, Service, Worker},
};

pub use queue::queue_page;

/// Attempts that are known at a time.
const MOST_HEARD: usize = 10_000;

/// What was last heard of an attempt.
#[derive(Debug, Default)]
struct Heard {
    epoch: u64,
    n_events: u64,
    stage: String,
    evaluations: u64,
    seconds: f64,
    /// The next totals include what was done before, which is counted already.
    goes_on: bool,
}

/// What is counted of a report.
#[derive(Clone, Debug)]
pub enum Counted {
    /// A point of the energy curve.
    Sample(EnergySample),
    /// Bytes of records.
    Records(u64),
    /// Who judges pictures.
    Device(String),
    /// Nothing.
    Nothing,
}

impl Counted {
    /// What is counted of this one.
    pub fn of(report: &Report) -> Self {
        match report {
            Report::Sample(sample) => Self::Sample(sample.clone()),
            Report::Records { bytes, .. } => Self::Records(bytes.len() as u64),
            Report::Note { code, text } if code == "DEVICE_CHOSEN" => {
                Self::Device(text.chars().take(64).collect())
            }
            _ => Self::Nothing,
        }
    }
}

/// Counts what workers report.
#[derive(Debug, Default)]
pub struct Observer {
    attempts: Mutex<BTreeMap<String, Heard>>,
    traces: JobTraces,
}

impl Observer {
    /// A new observer, which passes on which jobs end; describes the metrics to the recorder, if there is one.
    pub fn new(traces: JobTraces) -> Self {
        describe_gauge!("lookalike_jobs", "Jobs by state");
        describe_counter!("lookalike_claims_total", "Attempts begun");
        describe_counter!(
            "lookalike_lost_attempts_total",
            "Attempts lost or handed back, by reason"
        );
        describe_counter!("lookalike_device_attempts_total", "Attempts by who judges pictures");
        describe_counter!("lookalike_received_bytes_total", "Bytes received, by what they are of");
        describe_counter!("lookalike_sent_bytes_total", "Bytes sent, by what they are of");
        describe_counter!("lookalike_quarantines_total", "Times a host was taken out of service");
        describe_gauge!("lookalike_workers", "Hosts of workers, by whether they get jobs");
        describe_counter!("lookalike_preemptions_total", "Jobs that had to make room for others");
        describe_counter!("lookalike_ended_jobs_total", "Jobs ended, by state");
        describe_counter!("lookalike_evaluations_total", "Energy evaluations, by stage");
        describe_gauge!("lookalike_stage_seconds", "Seconds spent, by stage");
        describe_gauge!("lookalike_evaluations_per_second", "Latest rate, by stage");
        describe_gauge!("lookalike_energy", "Latest energy, sum of squared luminance differences");
        describe_gauge!("lookalike_d2_percent", "Latest d2, percent of full scale");
        Self { traces, ..Self::default() }
    }

    /// An attempt began, or goes on from a checkpoint of another one.
    pub fn claimed(&self, lease: &Lease, goes_on: bool) {
        counter!("lookalike_claims_total").increment(1);
        let heard = Heard { epoch: lease.epoch, goes_on, ..Heard::default() };
        let mut attempts = self.attempts();
        attempts.insert(lease.job.clone(), heard);
        // Some end where another server hears of it. Ids grow with time.
        if attempts.len() > MOST_HEARD {
            attempts.pop_first();
        }
    }

    fn attempts(&self) -> MutexGuard<'_, BTreeMap<String, Heard>> {
        self.attempts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A worker got no job for a fault of its own.
    pub fn refused(&self, error: &Error) {
        if let Error::OutOfService { host, is_news: true, .. } = error {
            tracing::warn!(host, %error, "a worker is taken out of service");
            counter!("lookalike_quarantines_total").increment(1);
        }
    }

    /// Workers were asked to hand these jobs back.
    pub fn preempted(&self, jobs: &[Job]) {
        for job in jobs {
            tracing::info!(job = job.id, priority = job.priority, "to make room for another job");
            counter!("lookalike_preemptions_total").increment(1);
        }
    }

    /// Attempts were lost without a word from their workers.
    pub fn lost(&self, jobs: &[Job]) {
        for job in jobs {
            tracing::warn!(job = job.id, attempt = job.attempt, state = %job.state, "attempt lost");
            self.ended(job);
        }
    }

    /// An attempt ended and its job is now as given.
    pub fn ended(&self, job: &Job) {
        self.attempts().remove(&job.id);
        self.traces.ended(job);
        if let Some(loss) = job.loss {
            counter!("lookalike_lost_attempts_total", "reason" => loss.reason()).increment(1);
        }
        if job.state.is_final() {
            counter!("lookalike_ended_jobs_total", "state" => job.state.name()).increment(1);
        }
    }

    /// How many jobs are in each state.
    pub fn depth(&self, counts: &[(State, u64)]) {
        for (state, count) in counts {
            gauge!("lookalike_jobs", "state" => state.name()).set(*count as f64);
        }
    }

    /// How many hosts get jobs, and how many do not.
    pub fn fleet(&self, workers: &[Worker]) {
        for (service, name) in Service::ALL {
            let n = workers.iter().filter(|worker| worker.service() == service).count();
            gauge!("lookalike_workers", "state" => name).set(n as f64);
        }
    }

    /// A batch of reports was stored; `first` is the number of its first event in the attempt.
    pub fn reported(&self, lease: &Lease, first: u64, reports: &[Counted]) {
        let mut attempts = self.attempts();
        let heard = attempts.entry(lease.job.clone()).or_default();
        if heard.epoch < lease.epoch {
            // Another server heard of it before, if this is not its beginning.
            let goes_on = first > 0;
            *heard = Heard { epoch: lease.epoch, n_events: first, goes_on, ..Heard::default() };
        }
        if heard.epoch > lease.epoch {
            return;
        }
        let known = heard.n_events.saturating_sub(first) as usize;
        heard.n_events = heard.n_events.max(first + reports.len() as u64);
        for report in reports.iter().skip(known) {
            match report {
                Counted::Sample(sample) => heard.count(sample),
                Counted::Records(n_bytes) => received("records").increment(*n_bytes),
                Counted::Device(device) => {
                    let device = device.clone();
                    counter!("lookalike_device_attempts_total", "device" => device).increment(1);
                }
                Counted::Nothing => {}
            }
        }
    }
}

/// Bytes received of meshes, artifacts, checkpoints or records.
pub(super) fn received(what: &'static str) -> Counter {
    counter!("lookalike_received_bytes_total", "what" => what)
}

/// Counts what goes out.
pub(super) fn sent<E>(
    what: &'static str,
    bytes: impl Stream<Item = Result<Bytes, E>>,
) -> impl Stream<Item = Result<Bytes, E>> {
    let n_bytes = counter!("lookalike_sent_bytes_total", "what" => what);
    bytes.inspect_ok(move |chunk| n_bytes.increment(chunk.len() as u64))
}

impl Heard {
    fn count(&mut self, sample: &EnergySample) {
        if self.stage != sample.stage {
            // Evaluations count from the stage's beginning, seconds from the attempt's.
            self.stage.clone_from(&sample.stage);
            self.evaluations = 0;
        }
        if std::mem::take(&mut self.goes_on) {
            (self.evaluations, self.seconds) = (sample.evaluations, sample.seconds);
        }
        let n_evaluations = sample.evaluations.saturating_sub(self.evaluations);
        let seconds = (sample.seconds - self.seconds).max(0.0);
        let stage = || sample.stage.clone();
        counter!("lookalike_evaluations_total", "stage" => stage()).increment(n_evaluations);
        // Counters are whole numbers; a gauge that only grows serves for the fractions.
        gauge!("lookalike_stage_seconds", "stage" => stage()).increment(seconds);
        if seconds > 0.0 && n_evaluations > 0 {
            let rate = n_evaluations as f64 / seconds;
            gauge!("lookalike_evaluations_per_second", "stage" => stage()).set(rate);
        }
        if let Some(energy) = sample.energy {
            gauge!("lookalike_energy").set(energy as f64);
        }
        if let Some(d2) = sample.d2 {
            gauge!("lookalike_d2_percent").set(d2);
        }
        self.evaluations = sample.evaluations;
        self.seconds = sample.seconds;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(evaluations: u64, seconds: f64) -> Counted {
        Counted::Sample(EnergySample {
            stage: "image".into(),
            evaluations,
            seconds,
            triangles: 1,
            energy: None,
            d2: None,
            level: None,
            energy_ratio: None,
            d2_unseen: None,
            turn: None,
        })
    }

    #[test]
    fn repeated_batches_count_once() {
        let recorder = metrics_exporter_prometheus::PrometheusBuilder::new().build_recorder();
        let page = recorder.handle();
        metrics::with_local_recorder(&recorder, || {
            let observer = Observer::new(JobTraces::default());
            let lease = Lease { job: "a".into(), epoch: 1, worker: "w".into() };
            observer.claimed(&lease, false);
            observer.reported(&lease, 0, &[sample(100, 1.0), sample(300, 2.0)]);
            observer.reported(&lease, 0, &[sample(100, 1.0), sample(300, 2.0)]);
            observer.reported(&lease, 2, &[sample(400, 4.0)]);
        });
        let page = page.render();
        assert!(page.contains("lookalike_evaluations_total{stage=\"image\"} 400"), "{page}");
        assert!(page.contains("lookalike_stage_seconds{stage=\"image\"} 4"), "{page}");
        assert!(page.contains("lookalike_evaluations_per_second{stage=\"image\"} 50"), "{page}");
    }

    /// Totals go on where another attempt, or this server before its restart, has counted them.
    #[test]
    fn what_goes_on_counts_what_is_new() {
        let recorder = metrics_exporter_prometheus::PrometheusBuilder::new().build_recorder();
        let page = recorder.handle();
        let lease = |epoch| Lease { job: "a".into(), epoch, worker: "w".into() };
        metrics::with_local_recorder(&recorder, || {
            let observer = Observer::new(JobTraces::default());
            observer.reported(&lease(1), 7, &[sample(100, 1.0), sample(300, 2.0)]);
            observer.claimed(&lease(2), true);
            observer.reported(&lease(2), 0, &[sample(200, 1.5), sample(250, 2.0)]);
            // It was frozen, and wakes up.
            observer.reported(&lease(1), 9, &[sample(900, 9.0)]);
            observer.reported(&lease(2), 2, &[sample(350, 3.0)]);
        });
        let page = page.render();
        assert!(page.contains("lookalike_evaluations_total{stage=\"image\"} 350"), "{page}");
        assert!(page.contains("lookalike_stage_seconds{stage=\"image\"} 2.5"), "{page}");
    }
}
