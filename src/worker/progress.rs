//! How far an attempt is, and when it will end: for people, never for results.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use crate::{
    jobs::{
        event::Report,
        spec::{Method, Spec},
    },
    mesh::Stage,
};

/// Progress is told at once, and then this often at most.
const INTERVAL: Duration = Duration::from_millis(200);
/// The estimate looks back over so many reports.
const WINDOW: usize = 50;
/// Share of a job's time before the first stage and after the last one.
const BEFORE: f64 = 0.02;
const AFTER: f64 = 0.08;

/// Parts of a job's time that its stages take, where they occur.
const PARTS: [(Method, [(Stage, f64); 3]); 3] = [
    (Method::Image, [(Stage::Memoryless, 0.08), (Stage::Image, 0.4), (Stage::Optimize, 0.8)]),
    (Method::Memoryless, [(Stage::Memoryless, 0.5), (Stage::Image, 0.0), (Stage::Optimize, 0.8)]),
    (Method::Cluster, [(Stage::Memoryless, 0.01), (Stage::Image, 0.0), (Stage::Optimize, 0.8)]),
];

/// See the module.
#[derive(Debug)]
pub(super) struct Progress {
    parts: Vec<(&'static str, f64)>,
    stage: &'static str,
    told: Option<Instant>,
    history: VecDeque<(Instant, f64)>,
}

impl Progress {
    /// Of a job that begins.
    pub fn new(spec: &Spec) -> Self {
        let method = if spec.simplified.is_some() { Method::Cluster } else { spec.method };
        let row = PARTS.iter().find(|row| row.0 == method);
        let occurs = |p: &(Stage, f64)| p.0 != Stage::Optimize || spec.optimizes();
        let parts = row.into_iter().flat_map(|row| row.1).filter(occurs);
        Self::of(parts.map(|(stage, part)| (stage.name(), part)).collect())
    }

    /// Of a job that begins, with stages of its own and the parts of its time that they take.
    pub fn of(parts: Vec<(&'static str, f64)>) -> Self {
        let stage = parts.first().map_or("", |p| p.0);
        Self { parts, stage, told: None, history: VecDeque::new() }
    }

    /// A stage begins, or goes on.
    pub fn enter(&mut self, stage: &'static str) {
        self.stage = stage;
    }

    /// What to tell, unless something was told a moment ago. `done` of the stage, 0 to 1.
    pub fn tell(&mut self, now: Instant, done: f64) -> Option<Report> {
        if self.told.is_some_and(|told| now.duration_since(told) < INTERVAL) {
            return None;
        }
        self.told = Some(now);
        let fraction = self.fraction(done.clamp(0.0, 1.0));
        let eta_secs = self.estimate(now, fraction);
        Some(Report::Progress { stage: self.stage.into(), fraction, eta_secs })
    }

    /// Of the whole job, 0 to 1.
    fn fraction(&self, done: f64) -> f64 {
        let total: f64 = self.parts.iter().map(|p| p.1).sum();
        let before = self.parts.iter().take_while(|p| p.0 != self.stage).map(|p| p.1).sum::<f64>();
        let own = self.parts.iter().find(|p| p.0 == self.stage).map_or(0.0, |p| p.1);
        BEFORE + (1.0 - BEFORE - AFTER) * (before + own * done) / total.max(f64::MIN_POSITIVE)
    }

    /// Seconds to the end at the pace of the last reports.
    fn estimate(&mut self, now: Instant, fraction: f64) -> Option<f64> {
        self.history.push_back((now, fraction));
        if self.history.len() > WINDOW {
            self.history.pop_front();
        }
        let (then, before) = *self.history.front()?;
        let pace = (fraction - before) / now.duration_since(then).as_secs_f64();
        (pace.is_finite() && pace > 0.0).then(|| (1.0 - fraction) / pace)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_follow_each_other_without_a_gap() {
        for method in [Method::Image, Method::Memoryless, Method::Cluster] {
            let mut progress = Progress::new(&Spec { method, ..Spec::new(vec![9]) });
            let mut last = BEFORE;
            for stage in progress.parts.clone() {
                progress.enter(stage.0);
                assert!((progress.fraction(0.0) - last).abs() < 1e-12);
                last = progress.fraction(1.0);
            }
            assert!((last - (1.0 - AFTER)).abs() < 1e-12, "{method:?}");
        }
    }

    #[test]
    fn reports_are_rare_and_estimate_from_the_second_on() {
        let start = Instant::now();
        let mut progress = Progress::new(&Spec::new(vec![9]));
        assert!(progress.tell(start, 0.1).is_some());
        assert!(progress.tell(start + INTERVAL / 2, 0.1).is_none());
        let Some(Report::Progress { eta_secs, fraction, .. }) =
            progress.tell(start + INTERVAL, 0.2)
        else {
            panic!("it is time");
        };
        assert!(eta_secs.unwrap() > 0.0 && fraction > BEFORE);
    }
}
