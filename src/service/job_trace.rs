//! The trace of a job, made of its log: the call that created it, and below it a span for each time that it ran to an
//! end (more than once only if it was retried), for each wait in the queue, each attempt, and each stage of an attempt.
//!
//! 1. Whatever a span says is in the log, and its number follows from its place there: whichever server tells of it, and
//!    after whatever restart, the spans of a job fit together. Workers know nothing of traces.
//! 2. Spans are told when an attempt or a wait ends. Times are those at which entries were stored, up to a tenth of a
//!    second after the fact (`worker/outbox.rs`).
//! 3. A job whose creation nobody traced is a trace of its own, numbered by its id.
//!
//! Nobody waits for this: what there is no time for is left out.

use futures::future::BoxFuture;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::{
    jobs::{
        Jobs,
        error::Result,
        event::{Body, EnergySample, Event, Report, ServerEvent},
        state::State,
        store::{Job, RESUMED},
    },
    telemetry::{
        Spans,
        trace::{Span, TraceContext, time_of},
    },
};

/// Ends that may wait to be told.
const AHEAD: usize = 1024;
/// Entries of a log read at once.
const PAGE: u32 = 1000;
/// Stages of an attempt that are told apart: workers may say anything.
const MAX_STAGES: usize = 256;
/// Attempts that end so are as wanted.
const IN_PEACE: [&str; 4] = ["COMPLETED", "CANCELLED", "RELEASED", "PREEMPTED"];

/// Told of jobs whose attempt or wait has ended.
#[derive(Clone, Debug, Default)]
pub struct JobTraces(Option<mpsc::Sender<(String, u64)>>);

impl JobTraces {
    /// The log of `job` has just come to an end of that kind.
    pub fn ended(&self, job: &Job) {
        if let Some(ends) = &self.0
            && ends.try_send((job.id.clone(), job.last_seq)).is_err()
        {
            tracing::debug!(job = job.id, "its trace is left out: too much ends at once");
        }
    }
}

/// What is told of jobs that end, and the task that makes spans of it until `stop`.
pub fn trace_jobs(
    jobs: Jobs,
    spans: Spans,
    stop: CancellationToken,
) -> (JobTraces, BoxFuture<'static, ()>) {
    if !spans.is_on() {
        return (JobTraces::default(), Box::pin(stop.cancelled_owned()));
    }
    let (send, mut ends) = mpsc::channel::<(String, u64)>(AHEAD);
    let task = async move {
        loop {
            let end = tokio::select! {
                biased;
                end = ends.recv() => end,
                () = stop.cancelled() => return,
            };
            let Some((id, last_seq)) = end else { return };
            match told(&jobs, &id, last_seq).await {
                Ok(told) => told.into_iter().for_each(|span| spans.send(span)),
                Err(error) => tracing::debug!(job = id, %error, "its trace is left out"),
            }
        }
    };
    (JobTraces(Some(send)), Box::pin(task))
}

/// The spans of what ended with the last change of state up to entry `last_seq`.
async fn told(jobs: &Jobs, id: &str, last_seq: u64) -> Result<Vec<Span>> {
    let job = jobs.job(id).await?;
    let mut walk = Walk::new(&job);
    let mut after_seq = 0;
    while after_seq < last_seq {
        let page = jobs.entries(id, after_seq, PAGE).await?;
        let Some(last) = page.last() else { break };
        after_seq = last.seq;
        page.iter().take_while(|event| event.seq <= last_seq).for_each(|event| walk.pass(event));
    }
    Ok(walk.spans)
}

/// Goes through the log of a job.
struct Walk<'j> {
    job: &'j Job,
    /// Where the job was created, or the place of a trace of its own.
    origin: TraceContext,
    has_parent: bool,
    run: Option<Part>,
    wait: Option<Part>,
    attempt: Option<Attempt>,
    /// Of what ended with the last change of state.
    spans: Vec<Span>,
}

/// Something that has begun: by which entry, and when.
#[derive(Clone, Copy)]
struct Part {
    seq: u64,
    start_ms: i64,
}

impl Part {
    fn new(event: &Event) -> Self {
        Self { seq: event.seq, start_ms: event.at_ms }
    }
}

struct Attempt {
    part: Part,
    wait: Option<Part>,
    number: u32,
    epoch: u64,
    worker: String,
    device: Option<String>,
    is_resumed: bool,
    /// In order; all but the last have ended.
    stages: Vec<Stage>,
}

struct Stage {
    part: Part,
    name: String,
    level: Option<u32>,
    evaluations_before: u64,
    last: Option<EnergySample>,
}

impl<'j> Walk<'j> {
    fn new(job: &'j Job) -> Self {
        let parent = TraceContext::parse(&job.trace);
        let own = u128::from_str_radix(&job.id, 16).unwrap_or_default().max(1);
        let origin = parent.unwrap_or(TraceContext { trace: own, span: 0, is_sampled: true });
        let has_parent = parent.is_some();
        Self { job, origin, has_parent, run: None, wait: None, attempt: None, spans: Vec::new() }
    }

    fn pass(&mut self, event: &Event) {
        match &event.body {
            Body::Server(ServerEvent::StateChanged { state, reason, attempt, worker, .. }) => {
                self.spans.clear();
                self.end(event, reason);
                match state {
                    State::Running => {
                        let (wait, number) = (self.wait.take(), *attempt);
                        self.attempt = Some(Attempt::new(event, wait, number, worker));
                    }
                    State::Queued => {
                        self.run.get_or_insert_with(|| Part::new(event));
                        self.wait = Some(Part::new(event));
                    }
                    State::Succeeded | State::Failed | State::Cancelled => {
                        self.end_run(event, *state, reason);
                    }
                }
            }
            Body::Server(ServerEvent::Restarted { reason, .. }) => {
                self.attempt.iter_mut().for_each(|attempt| attempt.is_resumed |= reason == RESUMED);
            }
            Body::Worker(report) => {
                self.attempt.iter_mut().for_each(|attempt| attempt.report(event, report));
            }
        }
    }

    /// Whatever was under way ends, but for the job itself.
    fn end(&mut self, event: &Event, reason: &str) {
        let job = self.run.map(|run| id_of(self.job, "job", run.seq));
        if let Some(mut attempt) = self.attempt.take() {
            let wait = attempt.wait.take();
            let waited = wait.map(|wait| self.span("queue", wait, attempt.part.start_ms, job));
            self.spans.extend(waited);
            let mut span = self.span("attempt", attempt.part, event.at_ms, job);
            attempt.tell(&mut span, reason);
            let parent = Some(span.at.span);
            self.spans.push(span);
            for (i, stage) in attempt.stages.iter().enumerate() {
                let next = attempt.stages.get(i + 1).map(|next| next.part.start_ms);
                let mut span = self.span("stage", stage.part, next.unwrap_or(event.at_ms), parent);
                stage.tell(&mut span);
                self.spans.push(span);
            }
        } else if event.body.state() != Some(State::Running)
            && let Some(wait) = self.wait.take()
        {
            self.spans.push(self.span("queue", wait, event.at_ms, job));
        }
    }

    fn end_run(&mut self, event: &Event, state: State, reason: &str) {
        let Some(run) = self.run.take() else { return };
        let parent = self.has_parent.then_some(self.origin.span);
        let mut span = self.span("job", run, event.at_ms, parent);
        span.say("lookalike.owner", self.job.owner.as_str());
        span.say("lookalike.mesh", self.job.mesh.as_str());
        span.say("lookalike.state", state.name());
        span.say("lookalike.reason", reason);
        span.error = (state == State::Failed).then(|| reason.into());
        self.spans.push(span);
    }

    fn span(&self, name: &str, part: Part, end_ms: i64, parent: Option<u64>) -> Span {
        let mut span = Span {
            at: TraceContext { span: id_of(self.job, name, part.seq), ..self.origin },
            parent,
            is_call: false,
            name: name.into(),
            start: time_of(part.start_ms),
            end: time_of(end_ms.max(part.start_ms)),
            attributes: Vec::new(),
            error: None,
        };
        span.say("lookalike.job", self.job.id.as_str());
        span
    }
}

impl Attempt {
    fn new(event: &Event, wait: Option<Part>, number: u32, worker: &str) -> Self {
        let part = Part::new(event);
        let (epoch, worker) = (event.epoch, worker.to_owned());
        let reading = Stage::new(part, "prepare", None, 0);
        let stages = vec![reading];
        Self { part, wait, number, epoch, worker, device: None, is_resumed: false, stages }
    }

    fn report(&mut self, event: &Event, report: &Report) {
        match report {
            Report::Sample(sample) => {
                self.enter(event, &sample.stage, sample.level);
                self.stages.last_mut().iter_mut().for_each(|s| s.last = Some(sample.clone()));
            }
            Report::Progress { stage, .. } => self.enter(event, stage, None),
            Report::Artifact { .. } => self.enter(event, "write", None),
            Report::Note { code, text } if code == "DEVICE_CHOSEN" => {
                self.device = Some(text.clone());
            }
            Report::Note { .. } | Report::Moves { .. } | Report::Records { .. } => {}
        }
    }

    /// What comes now is of this stage; a level that is not said may be any.
    fn enter(&mut self, event: &Event, name: &str, level: Option<u32>) {
        let is_same = |stage: &&mut Stage| {
            stage.name == name && (stage.level.is_none() || level.is_none() || stage.level == level)
        };
        let has_room = self.stages.len() < MAX_STAGES;
        if let Some(same) = self.stages.last_mut().filter(|stage| !has_room || is_same(stage)) {
            same.level = same.level.or(level);
            return;
        }
        let before = self.stages.iter().rev().find(|stage| stage.name == name);
        let before = before.and_then(|stage| stage.last.as_ref()).map_or(0, |s| s.evaluations);
        self.stages.push(Stage::new(Part::new(event), name, level, before));
    }

    fn tell(&self, span: &mut Span, reason: &str) {
        span.say("lookalike.attempt", self.number);
        span.say("lookalike.epoch", self.epoch);
        span.say("lookalike.worker", self.worker.as_str());
        span.say("lookalike.reason", reason);
        span.say("lookalike.resumed", self.is_resumed);
        if let Some(device) = &self.device {
            span.say("lookalike.device", device.as_str());
        }
        span.error = (!IN_PEACE.contains(&reason)).then(|| reason.into());
    }
}

impl Stage {
    fn new(part: Part, name: &str, level: Option<u32>, evaluations_before: u64) -> Self {
        Self { part, name: name.into(), level, evaluations_before, last: None }
    }

    fn tell(&self, span: &mut Span) {
        span.name.clone_from(&self.name);
        if let Some(level) = self.level {
            span.say("lookalike.level", level);
        }
        let Some(last) = &self.last else { return };
        let evaluations = last.evaluations.saturating_sub(self.evaluations_before);
        span.say("lookalike.evaluations", evaluations);
        span.say("lookalike.triangles", last.triangles);
        if let Some(energy) = last.energy {
            span.say("lookalike.energy", energy);
        }
        if let Some(d2) = last.d2 {
            span.say("lookalike.d2_percent", d2);
        }
    }
}

/// The number of a part of a job's trace.
fn id_of(job: &Job, what: &str, seq: u64) -> u64 {
    let hash = blake3::hash(format!("{}/{what}/{seq}", job.id).as_bytes());
    let mut bytes = [0; 8];
    bytes.copy_from_slice(&hash.as_bytes()[..8]);
    u64::from_le_bytes(bytes).max(1)
}

#[cfg(test)]
mod tests;
