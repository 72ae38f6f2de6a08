//! Follows the stages of an attempt: keeps every record and sample, streams them, tells progress
//! with an estimate, and breaks off when the caller or the clock says so.

use std::{
    collections::VecDeque,
    ops::ControlFlow,
    time::{Duration, Instant},
};

use crate::{
    io::IngestReport,
    jobs::{
        event::{EnergySample, Report},
        spec::{Method, Spec},
    },
    mesh::{Collapse, Edit, Mesh, Stage, Step},
    progressive::{ProgressiveError, Writer, encode_collapse},
};

use super::pipeline::PipelineError;

/// Records are streamed in chunks of so many.
const RECORDS_PER_CHUNK: u32 = 512;
/// Progress is told this often at most.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(200);
/// The estimate looks back over so many progress reports.
const ESTIMATE_WINDOW: usize = 50;

/// The recorder of one attempt.
pub struct Recorder<'a> {
    on: &'a mut dyn FnMut(Report) -> ControlFlow<()>,
    start: Instant,
    deadline: Option<Instant>,
    /// Every collapse of the attempt, in order.
    writer: Writer,
    writer_fault: Option<ProgressiveError>,
    /// Encoded records that were not streamed yet.
    pending: Vec<u8>,
    n_pending: u32,
    /// Every sample, in order.
    pub samples: Vec<EnergySample>,
    n_streamed: u64,
    is_cancelled: bool,
    is_out_of_time: bool,
    stage: Stage,
    stage_span: (usize, usize),
    stage_share: (f64, f64),
    n_faces: usize,
    last_told: Instant,
    history: VecDeque<(Instant, f64)>,
    method: Method,
}

/// Share of a job's time that is over when a stage begins and ends, for progress alone.
const SHARES: [(Method, Stage, (f64, f64)); 3] = [
    (Method::Memoryless, Stage::Memoryless, (0.05, 0.70)),
    (Method::Image, Stage::Memoryless, (0.02, 0.10)),
    (Method::Image, Stage::Image, (0.10, 0.90)),
];

impl<'a> Recorder<'a> {
    /// A recorder of what is done to `original`; it tells `on`.
    pub fn new(
        spec: &Spec,
        original: &Mesh,
        start: Instant,
        on: &'a mut dyn FnMut(Report) -> ControlFlow<()>,
    ) -> Result<Self, PipelineError> {
        let cap = (spec.max_secs > 0.0).then(|| Duration::try_from_secs_f64(spec.max_secs).ok());
        Ok(Self {
            on,
            start,
            deadline: cap.flatten().and_then(|d| start.checked_add(d)),
            writer: Writer::new(original)?,
            writer_fault: None,
            pending: Vec::new(),
            n_pending: 0,
            samples: Vec::new(),
            n_streamed: 0,
            is_cancelled: false,
            is_out_of_time: false,
            stage: Stage::Memoryless,
            stage_span: (0, 0),
            stage_share: (0.0, 0.0),
            n_faces: 0,
            last_told: start,
            history: VecDeque::new(),
            method: spec.method,
        })
    }

    /// Tells what was read, with every remark.
    pub fn announce(&mut self, report: &IngestReport) -> Result<(), PipelineError> {
        self.n_faces = report.triangles as usize;
        let text = format!(
            "read {} triangles, {} vertices, {} components, {} boundary edges, {} non-manifold \
             edges; {} degenerate triangles dropped",
            report.triangles,
            report.vertices,
            report.components,
            report.boundary_edges,
            report.non_manifold_edges,
            report.degenerate_dropped
        );
        self.note("MODEL_READ", &text)?;
        for n in &report.notes {
            self.note(&n.code.to_uppercase(), &format!("{} ({} times)", n.text, n.count))?;
        }
        Ok(())
    }

    /// A remark for the event log.
    pub fn note(&mut self, code: &str, text: &str) -> Result<(), PipelineError> {
        self.tell(Report::Note { code: code.into(), text: text.into() })
    }

    /// An artifact was written.
    pub fn artifact(
        &mut self,
        name: &str,
        media_type: &str,
        size: u64,
    ) -> Result<(), PipelineError> {
        self.tell(Report::Artifact { name: name.into(), media_type: media_type.into(), size })
    }

    fn tell(&mut self, report: Report) -> Result<(), PipelineError> {
        if (self.on)(report).is_break() {
            self.is_cancelled = true;
        }
        self.check()
    }

    /// A stage begins that goes from so many triangles down to so many.
    pub fn enter(&mut self, stage: Stage, from: usize, to: usize) {
        self.stage = stage;
        self.stage_span = (from, to.min(from));
        let share = SHARES.iter().find(|s| s.0 == self.method && s.1 == stage);
        self.stage_share = share.map_or((0.9, 1.0), |s| s.2);
    }

    /// Whether the wall-clock cap ended the work.
    pub fn is_out_of_time(&self) -> bool {
        self.is_out_of_time
    }

    /// An error when the caller asked to stop.
    pub fn check(&mut self) -> Result<(), PipelineError> {
        if let Some(fault) = self.writer_fault.take() {
            return Err(fault.into());
        }
        if self.is_cancelled { Err(PipelineError::Cancelled) } else { Ok(()) }
    }

    /// Takes a step of a stage.
    pub fn step(&mut self, step: &Step<'_>) -> ControlFlow<()> {
        match step {
            Step::Edit(Edit::Collapse(collapse)) => self.edit(collapse),
            // The stages that simplify make collapses only, and the log holds nothing else.
            Step::Edit(_) | Step::Moves(_) => ControlFlow::Continue(()),
            Step::Sample(sample) => {
                let sample = EnergySample {
                    stage: sample.stage.name().into(),
                    evaluations: sample.evaluations,
                    seconds: self.start.elapsed().as_secs_f64(),
                    triangles: sample.triangles,
                    energy: sample.energy,
                    d2: sample.d2,
                };
                self.samples.push(sample.clone());
                self.report(Report::Sample(sample))
            }
            Step::Progress { .. } => self.progress(),
        }
    }

    fn edit(&mut self, collapse: &Collapse) -> ControlFlow<()> {
        self.n_faces = self.n_faces.saturating_sub(collapse.removed.len());
        if let Err(fault) = self.writer.push(collapse) {
            self.writer_fault = Some(fault);
            return ControlFlow::Break(());
        }
        encode_collapse(collapse, &mut self.pending);
        self.n_pending += 1;
        if self.n_pending >= RECORDS_PER_CHUNK {
            self.stream_records()?;
            return self.progress();
        }
        ControlFlow::Continue(())
    }

    /// Streams the records that were not streamed yet.
    fn stream_records(&mut self) -> ControlFlow<()> {
        if self.n_pending == 0 {
            return ControlFlow::Continue(());
        }
        let (first, count) = (self.n_streamed, std::mem::take(&mut self.n_pending));
        self.n_streamed += u64::from(count);
        let bytes = std::mem::take(&mut self.pending);
        self.report(Report::Records { first, count, bytes })
    }

    /// Gives the present level a name in the progressive mesh.
    pub fn mark_level(&mut self, name: &str) {
        self.writer.mark_level(name);
    }

    /// Collapses so far.
    pub fn n_records(&self) -> u32 {
        self.writer.n_records()
    }

    /// Streams what is left; returns the progressive mesh as a file.
    pub fn finish(&mut self) -> Result<Vec<u8>, PipelineError> {
        let _ = self.stream_records();
        self.check()?;
        Ok(self.writer.clone().finish()?)
    }

    fn report(&mut self, report: Report) -> ControlFlow<()> {
        if (self.on)(report).is_break() {
            self.is_cancelled = true;
            return ControlFlow::Break(());
        }
        if self.deadline.is_some_and(|d| Instant::now() >= d) {
            self.is_out_of_time = true;
            return ControlFlow::Break(());
        }
        ControlFlow::Continue(())
    }

    fn progress(&mut self) -> ControlFlow<()> {
        let now = Instant::now();
        if now.duration_since(self.last_told) < PROGRESS_INTERVAL {
            return ControlFlow::Continue(());
        }
        self.last_told = now;
        let (from, to) = self.stage_span;
        let done = from.saturating_sub(self.n_faces) as f64 / (from - to).max(1) as f64;
        let (share_from, share_to) = self.stage_share;
        let fraction = share_from + (share_to - share_from) * done.min(1.0);
        let eta_secs = self.estimate(now, fraction);
        self.report(Report::Progress { stage: self.stage.name().into(), fraction, eta_secs })
    }

    /// Seconds to the end at the pace of the last reports.
    fn estimate(&mut self, now: Instant, fraction: f64) -> Option<f64> {
        self.history.push_back((now, fraction));
        if self.history.len() > ESTIMATE_WINDOW {
            self.history.pop_front();
        }
        let (then, before) = *self.history.front()?;
        let pace = (fraction - before) / now.duration_since(then).as_secs_f64();
        (pace.is_finite() && pace > 0.0).then(|| (1.0 - fraction) / pace)
    }
}
