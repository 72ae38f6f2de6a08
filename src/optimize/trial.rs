//! Searches for the best places of a few vertices, many at once.
//!
//! Invariants:
//! 1. every round asks each unfinished search for its points and has them judged in one batch, so
//!    a batch holds the points of all searches (evaluator.md: parallel simplex);
//! 2. a search sees the energies of its own points alone, so its path does not depend on which
//!    others run beside it.

use glam::DVec3;

use crate::{
    metric::{Free, Objective, Template},
    render::{Move, RenderError},
};

use super::{
    quadratic::Quadratic,
    simplex::{Point, Simplex},
};

/// The most moves judged in one call of the evaluator.
const CHUNK: usize = 1024;

/// How the places are searched.
#[derive(Clone, Debug)]
pub enum Search {
    /// Not at all: the start is judged.
    Start(Option<i64>),
    /// Downhill simplex.
    Simplex(Simplex),
    /// Quadratic steps.
    Quadratic(Quadratic),
}

/// One candidate edit with free vertices, and the search for their places.
#[derive(Clone, Debug)]
pub struct Trial {
    /// What the edit does for any places.
    pub template: Template,
    /// Where the free vertices start.
    pub free: Vec<Free>,
    /// Axes of the search space of each free vertex.
    pub frames: Vec<[DVec3; 3]>,
    /// Whether normals follow the places in the vector of unknowns.
    pub has_normals: bool,
    /// How the best places are found.
    pub search: Search,
}

impl Trial {
    /// Places and normals of the free vertices at a point of the search space.
    pub fn unpack(&self, point: &[f64]) -> (Vec<DVec3>, Vec<DVec3>) {
        let triple = |i: usize| match point.get(3 * i..3 * i + 3) {
            Some(&[x, y, z]) => DVec3::new(x, y, z),
            _ => DVec3::ZERO,
        };
        let n = self.free.len();
        let place = |(i, f): (usize, &Free)| {
            let ([x, y, z], by) = (self.frames[i], triple(i));
            f.at + x * by.x + y * by.y + z * by.z
        };
        let places = self.free.iter().enumerate().map(place).collect();
        let offset = |i: usize| if self.has_normals { triple(n + i) } else { DVec3::ZERO };
        let normals = self.free.iter().enumerate().map(|(i, f)| f.normal + offset(i)).collect();
        (places, normals)
    }

    /// The move of a point of the search space.
    pub fn move_at(&self, point: &[f64]) -> Move {
        let (places, normals) = self.unpack(point);
        self.template.at(&places, &normals)
    }

    /// The best point and its energy relative to the mesh before the edit.
    pub fn best(&self) -> (Point, i64) {
        match &self.search {
            Search::Start(value) => (Vec::new(), value.unwrap_or(i64::MAX)),
            Search::Simplex(s) => s.best().map_or((Vec::new(), i64::MAX), |b| (b.0.clone(), b.1)),
            Search::Quadratic(s) => (s.best().0.clone(), s.best().1),
        }
    }

    /// Energies asked for so far.
    pub fn evaluations(&self) -> u32 {
        match &self.search {
            Search::Start(_) => 1,
            Search::Simplex(s) => s.evaluations(),
            Search::Quadratic(s) => s.evaluations(),
        }
    }

    fn asks(&self, moves: &mut Vec<Move>) -> usize {
        let before = moves.len();
        match &self.search {
            Search::Start(None) => moves.push(self.template.start().clone()),
            Search::Start(Some(_)) => {}
            Search::Simplex(s) => moves.extend(s.asks().iter().map(|p| self.move_at(p))),
            Search::Quadratic(s) => moves.extend(s.asks().iter().map(|p| self.move_at(p))),
        }
        moves.len() - before
    }

    fn told(&mut self, values: &[i64]) {
        match &mut self.search {
            Search::Start(value) => *value = values.first().copied(),
            Search::Simplex(s) => s.told(values),
            Search::Quadratic(s) => s.told(values),
        }
    }
}

/// Runs all searches to their ends.
pub fn run<'t>(
    objective: &mut Objective,
    trials: impl Iterator<Item = &'t mut Trial>,
) -> Result<(), RenderError> {
    let mut trials: Vec<&mut Trial> = trials.collect();
    loop {
        let mut moves = Vec::new();
        let counts: Vec<usize> = trials.iter().map(|t| t.asks(&mut moves)).collect();
        if moves.is_empty() {
            return Ok(());
        }
        let mut values = Vec::with_capacity(moves.len());
        for chunk in moves.chunks(CHUNK) {
            values.extend(objective.evaluate(chunk)?);
        }
        let mut rest = values.as_slice();
        for (trial, count) in trials.iter_mut().zip(counts).filter(|t| t.1 > 0) {
            let (own, others) = rest.split_at(count);
            trial.told(own);
            rest = others;
        }
    }
}
