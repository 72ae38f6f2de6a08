//! The optimization of one level, seen from outside: what its samples lack, how far it is, and when
//! its time is over.

use crate::{
    jobs::event::EnergySample,
    mesh::{Edit, EditMesh, Mesh},
    tape::{Question, Tape},
};

use super::{budget::Budget, critic::Critic};

/// The unseen views are drawn at the start, after this many evaluations for each triangle, each time
/// that the evaluations have grown by [`GROWTH`], and at the end.
const FIRST_LOOK: u64 = 16;
const GROWTH: u64 = 4;

/// Of the kind of `studio.rs`.
const UNSEEN: Question = Question { kind: 7, print: 1 };

/// See the module.
pub struct Branch<'a> {
    /// The level, counted from 0 in the order asked for.
    pub(super) level: u32,
    /// d2 on unseen views before and after, percent of full scale.
    pub(super) d2_unseen: Option<[f64; 2]>,
    mesh: Mesh,
    /// Follows the edits.
    mirror: EditMesh,
    critic: &'a Critic<'a>,
    next_look: u64,
    budget: Budget,
    /// By the job's clock.
    start_secs: f64,
    is_out_of_time: bool,
    first_energy: Option<u64>,
    ratio: f64,
    evaluations: u64,
    /// Evaluations of the stage before this level.
    evaluations_before: u64,
    /// Shares of the stage that are done before and after this level.
    span: (f64, f64),
}

impl<'a> Branch<'a> {
    /// Of a level that begins now as `mesh`.
    pub(super) fn new(
        level: u32,
        (mesh, mirror): (Mesh, EditMesh),
        critic: &'a Critic<'a>,
        budget: Budget,
        (evaluations_before, span): (u64, (f64, f64)),
        start_secs: f64,
    ) -> Self {
        Self {
            level,
            d2_unseen: None,
            mesh,
            mirror,
            critic,
            next_look: 0,
            budget,
            start_secs,
            is_out_of_time: false,
            first_energy: None,
            ratio: 1.0,
            evaluations: 0,
            evaluations_before,
            span,
        }
    }

    /// The mesh that it began as.
    pub(super) fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// Whether the cap on the level's seconds ended the work.
    pub(super) fn is_out_of_time(&self) -> bool {
        self.is_out_of_time
    }

    /// Whether its seconds are limited.
    pub(super) fn is_limited(&self) -> bool {
        self.budget.secs.is_some()
    }

    /// It is so late, by the job's clock.
    pub(super) fn look_at(&mut self, now_secs: f64) {
        self.is_out_of_time |= self.budget.secs.is_some_and(|s| now_secs >= self.start_secs + s);
    }

    pub(super) fn follow(&mut self, edit: Edit<'_>) {
        self.mirror.redo(edit);
    }

    pub(super) fn reached(&mut self, evaluations: u64) {
        self.evaluations = self.evaluations.max(evaluations);
    }

    /// Adds to a sample what only the whole job knows.
    pub(super) fn complete(&mut self, sample: &mut EnergySample, tape: &Tape) {
        self.reached(sample.evaluations);
        if let Some(energy) = sample.energy {
            self.first_energy.get_or_insert(energy);
            sample.energy_ratio = self.energy_ratio(energy);
            self.ratio = sample.energy_ratio.unwrap_or(1.0);
        }
        if sample.evaluations >= self.next_look {
            let first = FIRST_LOOK * self.mesh.faces.len() as u64;
            self.next_look = first.max(GROWTH * sample.evaluations);
            sample.d2_unseen = Some(self.judge(tape));
        }
        sample.level = Some(self.level);
        sample.evaluations += self.evaluations_before;
    }

    /// An energy as a share of the one at the start.
    pub(super) fn energy_ratio(&self, energy: u64) -> Option<f64> {
        let first = self.first_energy?;
        Some(if first == 0 { 1.0 } else { energy as f64 / first as f64 })
    }

    /// d2 of the mesh as it is now, on unseen views.
    pub(super) fn judge(&mut self, tape: &Tape) -> f64 {
        let now = tape.known(UNSEEN, || self.critic.d2_percent(&self.mirror.snapshot()));
        self.d2_unseen = Some([self.d2_unseen.map_or(now, |d2| d2[0]), now]);
        now
    }

    /// How much of the stage is done, 0 to 1: by whichever limit is nearest.
    pub(super) fn done(&self, now_secs: f64) -> f64 {
        let by_evaluations = self.budget.evaluations.map(|n| self.evaluations as f64 / n as f64);
        let by_secs = self.budget.secs.map(|s| (now_secs - self.start_secs) / s);
        let by_energy = self.budget.until.map(|u| self.ratio.ln() / u.ln());
        let nearest = [by_evaluations, by_secs, by_energy].into_iter().flatten();
        let done = nearest.filter(|d| d.is_finite()).fold(0.0, f64::max).min(1.0);
        self.span.0 + done * (self.span.1 - self.span.0)
    }
}
