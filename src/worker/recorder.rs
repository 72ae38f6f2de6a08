//! Follows the stages of an attempt: keeps every record and sample, streams them, tells progress
//! with an estimate, and breaks off when the caller or the clock says so.
//!
//! Invariants:
//! 1. collapses of the chain and edits of each level are separate lists of records, each streamed in
//!    order, without gaps;
//! 2. samples of a stage count its evaluations over all levels;
//! 3. what an attempt does again after a lost one, which told of it, is kept but not told.

use std::{ops::ControlFlow, time::Instant};

use crate::{
    io::{IngestReport, Note},
    jobs::{
        event::{EnergySample, MoveCount, Report},
        spec::Spec,
    },
    mesh::{Edit, Mesh, Sample, Stage, Step},
    progressive::{ProgressiveError, Writer, encode_edit},
    tape::Tape,
};

use super::{branch::Branch, clock::Clock, pipeline::PipelineError, progress::Progress};

/// Records are streamed in chunks of so many.
const RECORDS_PER_CHUNK: u32 = 512;

/// The recorder of one attempt.
pub struct Recorder<'a> {
    on: &'a mut dyn FnMut(Report) -> ControlFlow<()>,
    tape: Tape,
    clock: Clock,
    /// By the clock.
    deadline_secs: Option<f64>,
    /// Every record of the attempt, in order.
    writer: Writer,
    writer_fault: Option<ProgressiveError>,
    /// Encoded records that were not streamed yet.
    pending: Vec<u8>,
    n_pending: u32,
    n_streamed: u64,
    /// Every sample, in order.
    pub samples: Vec<EnergySample>,
    is_cancelled: bool,
    is_out_of_time: bool,
    progress: Progress,
    stage_span: (usize, usize),
    n_faces: usize,
    /// The level that is being optimized.
    branch: Option<Branch<'a>>,
}

impl<'a> Recorder<'a> {
    /// A recorder of what is done to `base`, the original or the mesh in its place; it tells `on`.
    pub fn new(
        spec: &Spec,
        base: &Mesh,
        tape: &Tape,
        on: &'a mut dyn FnMut(Report) -> ControlFlow<()>,
    ) -> Result<Self, PipelineError> {
        let cap = (spec.max_secs > 0.0).then_some(spec.max_secs);
        Ok(Self {
            on,
            tape: tape.clone(),
            clock: Clock::new(tape),
            deadline_secs: cap,
            writer: Writer::new(base)?,
            writer_fault: None,
            pending: Vec::new(),
            n_pending: 0,
            n_streamed: 0,
            samples: Vec::new(),
            is_cancelled: false,
            is_out_of_time: false,
            progress: Progress::new(spec),
            stage_span: (0, 0),
            n_faces: base.faces.len(),
            branch: None,
        })
    }

    /// Tells what was read, with every remark. `what` is read out: `model`, `simplified mesh`.
    pub fn announce(&mut self, what: &str, report: &IngestReport) -> Result<(), PipelineError> {
        announcement(what, report).into_iter().try_for_each(|note| self.tell(note))
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
        let _ = self.report(report);
        self.check()
    }

    /// The time of the job.
    pub fn clock(&self) -> &Clock {
        &self.clock
    }

    /// A stage begins; if it simplifies, from so many triangles down to so many.
    pub fn enter(&mut self, stage: Stage, from: usize, to: usize) {
        self.stage_span = (from, to.min(from));
        self.progress.enter(stage.name());
    }

    /// Whether the wall-clock cap of the job, or of the level being optimized, ended the work.
    pub fn is_out_of_time(&self) -> bool {
        self.is_out_of_time || self.branch.as_ref().is_some_and(Branch::is_out_of_time)
    }

    /// An error when the caller asked to stop.
    pub fn check(&mut self) -> Result<(), PipelineError> {
        if let Some(fault) = self.writer_fault.take() {
            return Err(fault.into());
        }
        if let Some(fault) = self.tape.fault() {
            let text = format!("the checkpoint is not of this job and program: {fault}");
            return Err(PipelineError::Machine(text));
        }
        if self.is_cancelled { Err(PipelineError::Cancelled) } else { Ok(()) }
    }

    /// Takes a step of a stage.
    pub fn step(&mut self, step: &Step<'_>) -> ControlFlow<()> {
        self.look_at_clock();
        match step {
            Step::Edit(edit) => self.edit(*edit)?,
            Step::Sample(sample) => self.sample(sample)?,
            Step::Moves(moves) => self.moves(moves)?,
            Step::Progress { done, .. } => {
                self.branch.iter_mut().for_each(|b| b.reached(*done));
                self.progress()?;
            }
        }
        let goes_on = !self.is_out_of_time() && self.tape.fault().is_none();
        if goes_on { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    }

    /// Finds out whether time is over, where it is limited.
    fn look_at_clock(&mut self) {
        let is_limited = |branch: &Branch<'_>| branch.is_limited();
        if self.deadline_secs.is_some() || self.branch.as_ref().is_some_and(is_limited) {
            let secs = self.clock.read();
            self.is_out_of_time |= self.deadline_secs.is_some_and(|deadline| secs >= deadline);
            self.branch.iter_mut().for_each(|b| b.look_at(secs));
        }
    }

    fn edit(&mut self, edit: Edit<'_>) -> ControlFlow<()> {
        let pushed = match (&mut self.branch, edit) {
            (Some(branch), edit) => {
                branch.follow(edit);
                self.writer.push_edit(edit)
            }
            (None, Edit::Collapse(collapse)) => {
                self.n_faces = self.n_faces.saturating_sub(collapse.removed.len());
                self.writer.push(collapse)
            }
            // The stages that simplify make collapses only.
            (None, _) => Ok(()),
        };
        if let Err(fault) = pushed {
            self.writer_fault = Some(fault);
            return ControlFlow::Break(());
        }
        encode_edit(edit, &mut self.pending);
        self.n_pending += 1;
        if self.n_pending >= RECORDS_PER_CHUNK {
            self.stream_records()?;
            return self.progress();
        }
        ControlFlow::Continue(())
    }

    fn sample(&mut self, sample: &Sample) -> ControlFlow<()> {
        let mut told = EnergySample {
            stage: sample.stage.name().into(),
            evaluations: sample.evaluations,
            seconds: self.clock.read(),
            triangles: sample.triangles,
            energy: sample.energy,
            d2: sample.d2,
            level: None,
            energy_ratio: None,
            d2_unseen: None,
            turn: None,
        };
        if let Some(branch) = &mut self.branch {
            told.turn = Some(sample.turn);
            branch.complete(&mut told, &self.tape);
        }
        self.samples.push(told.clone());
        self.report(Report::Sample(told))
    }

    fn moves(&mut self, moves: &[crate::mesh::MoveCount]) -> ControlFlow<()> {
        let Some(branch) = &self.branch else { return ControlFlow::Continue(()) };
        self.report(Report::Moves { level: branch.level, moves: counts(moves) })
    }

    /// Streams the records that were not streamed yet.
    fn stream_records(&mut self) -> ControlFlow<()> {
        if self.n_pending == 0 {
            return ControlFlow::Continue(());
        }
        let (first, count) = (self.n_streamed, std::mem::take(&mut self.n_pending));
        self.n_streamed += u64::from(count);
        let bytes = std::mem::take(&mut self.pending);
        let level = self.branch.as_ref().map(|b| b.level);
        self.report(Report::Records { level, first, count, bytes })
    }

    /// Gives the present level a name in the progressive mesh.
    pub fn mark_level(&mut self, name: &str) {
        self.writer.mark_level(name);
    }

    /// Collapses so far.
    pub fn n_records(&self) -> u32 {
        self.writer.n_records()
    }

    /// From now on edits belong to the optimization of a level.
    pub fn begin_branch(&mut self, name: &str, branch: Branch<'a>) -> Result<(), PipelineError> {
        let _ = self.stream_records();
        self.check()?;
        self.writer.begin_edits(name, branch.mesh())?;
        self.n_streamed = 0;
        self.branch = Some(branch);
        Ok(())
    }

    /// The optimization of a level is over: a last sample says what the unseen views make of it.
    /// It ended with this energy and d2. Returns the branch and the number of its edits.
    pub fn end_branch(
        &mut self,
        energy: u64,
        d2: f64,
    ) -> Result<(Option<Branch<'a>>, u32), PipelineError> {
        let _ = self.stream_records();
        self.writer.end_edits()?;
        let n_records = u64::from(self.n_records());
        let edits = std::mem::replace(&mut self.n_streamed, n_records);
        let mut branch = self.branch.take();
        if let (Some(branch), Some(last)) = (&mut branch, self.samples.last().cloned()) {
            let mut told = EnergySample { energy: Some(energy), d2: Some(d2), ..last.clone() };
            told.energy_ratio = branch.energy_ratio(energy);
            // Time may have run out in a turn of other views, which no sample has told of.
            let is_higher = last.energy.is_some_and(|before| energy > before);
            told.turn = last.turn.map(|turn| turn + u32::from(is_higher));
            told.d2_unseen = Some(branch.judge(&self.tape));
            self.samples.push(told.clone());
            self.tell(Report::Sample(told))?;
        }
        self.check()?;
        Ok((branch, edits as u32))
    }

    /// Streams what is left; returns the progressive mesh as a file.
    pub fn finish(&mut self) -> Result<Vec<u8>, PipelineError> {
        let _ = self.stream_records();
        self.check()?;
        Ok(self.writer.clone().finish()?)
    }

    fn report(&mut self, report: Report) -> ControlFlow<()> {
        let is_known = self.tape.is_replaying() && !matches!(report, Report::Progress { .. });
        if !is_known && (self.on)(report).is_break() {
            self.is_cancelled = true;
            return ControlFlow::Break(());
        }
        ControlFlow::Continue(())
    }

    fn progress(&mut self) -> ControlFlow<()> {
        let (from, to) = self.stage_span;
        let done = match &self.branch {
            Some(branch) => branch.done(self.clock.glance()),
            None => from.saturating_sub(self.n_faces) as f64 / (from - to).max(1) as f64,
        };
        match self.progress.tell(Instant::now(), done) {
            Some(report) => self.report(report),
            None => ControlFlow::Continue(()),
        }
    }
}

/// What was read, with every remark.
pub(super) fn announcement(what: &str, report: &IngestReport) -> Vec<Report> {
    let text = format!(
        "{what}: read {} triangles, {} vertices, {} components, {} boundary edges, {} \
         non-manifold edges; {} degenerate triangles dropped",
        report.triangles,
        report.vertices,
        report.components,
        report.boundary_edges,
        report.non_manifold_edges,
        report.degenerate_dropped
    );
    let read = Report::Note { code: "MODEL_READ".into(), text };
    let remark = |n: &Note| {
        let text = format!("{} ({} times)", n.text, n.count);
        Report::Note { code: n.code.to_uppercase(), text }
    };
    std::iter::once(read).chain(report.notes.iter().map(remark)).collect()
}

/// Counts of moves as jobs tell them.
pub(super) fn counts(moves: &[crate::mesh::MoveCount]) -> Vec<MoveCount> {
    let count = |m: &crate::mesh::MoveCount| MoveCount {
        name: m.name.into(),
        tried: m.tried,
        accepted: m.accepted,
        evaluations: m.evaluations,
        reduction: m.reduction,
    };
    moves.iter().map(count).collect()
}
