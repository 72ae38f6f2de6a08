//! Optimization in turns: of many view sets, so that the mesh fits the model and not twenty pictures of
//! it, and of more and fewer triangles, so that it leaves an arrangement from which no single move
//! leads to a better one. Beyond the paper.
//!
//! A turn is a descent of all vertices by the slopes in view after view, then discrete moves judged by
//! the evaluator in one set of views; the next turn takes another set. What the discrete moves have
//! spoilt for other views, the next descent mends. All view sets judge what comes out (`held.rs`). After some
//! turns come cycles (`cycle.rs`), made of turns themselves. Where descents do not pay, turns are all in the
//! run-time views, and sets that nothing looks at judge.
//!
//! Invariants:
//! 1. turn 0 and every (n + 1)-th one after it show the views that the run is judged by; the n turns
//!    between show the others, one set after the other; the last word has a descent in all views, unless
//!    the energy is low enough before;
//! 2. samples come from the turns of 1 outside cycles, from the ends of cycles and from the end, with
//!    the evaluations of all;
//! 3. a descent counts as the evaluations that draw as many triangles.
//!
//! A sample may lie above one of an earlier turn: what other turns do is judged by other views. Samples
//! name their turn, counted from 1; the first sample of all is of turn 0, the last one of a turn of its own.
//!
//! Measured, unseen d2 as a share of the start, bunny from memoryless simplification to 1,336 triangles:
//! at 200 evaluations a triangle .840 in the run-time views alone, .811 with 2 view sets, .803 with 8,
//! .798 with 16; at 40 .837 with 16. Not kept: several view sets at once in the discrete moves (80 views;
//! no gain at four times the cost), pictures of 512² (.003 better at twice the cost), a last turn of vertex
//! moves in the run-time views (their energy falls by a tenth, unseen d2 rises by .015).
//!
//! Where the run-time views alone are looked at, searches begin with steps of random length in random directions, which
//! late in a run find what the same steps never would. Run-time energy in percent of the start, bunny at 1,333 triangles
//! from image-driven simplification at effort fast, after 1, 4, 6 and 10 million evaluations: 77.3, 75.9, 75.6 and 75.4
//! without, 75.9, 75.2 and 75.0 with up to 2 bits less and one more every 500 evaluations a triangle. What
//! was left after 10 million without, after 400,000 more: 99.99% without, 99.58 with up to 6 bits less in directions
//! of all kinds, 99.54 with 8, 99.47 with 8 and tangents that turn about the normal, 99.69 with 12. From memoryless
//! simplification after 525 evaluations a triangle 58.4 and 58.5 (two seeds) without, 58.4 and 58.0 with, 59.1 with 8
//! bits less from the beginning.

use std::ops::ControlFlow;

use crate::{
    mesh::{EditMesh, EditRecord, Sample, Stage, Step},
    metric::{Objective, ViewSet, d2_percent},
    tape::{Question, Tape},
};

use super::{
    descent::{self, Unknowns},
    driver::{OptimizeError, Optimizer, Outcome},
    params::{Params, StoppedBy},
    run::Memory,
};

/// Shows the mesh as it is now, in a view set; number 0 is the one that the run is judged by.
pub type Shower<'a, E> = dyn FnMut(usize, &EditMesh) -> Result<Objective, E> + 'a;

/// Whom to tell.
pub type Listener<'a> = dyn FnMut(Step<'_>) -> ControlFlow<()> + 'a;

/// How view sets take turns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Turns {
    /// Evaluations of a turn's moves.
    pub evaluations: u64,
    /// Turns with other views between two that count.
    pub n_others: usize,
    /// The first so many view sets are looked at by moves and descents; the others only judge.
    pub n_looked_at: usize,
    /// Steps of descents: the first, those between, the last.
    pub steps: [usize; 3],
    /// Evaluations of a cycle of more and fewer triangles; 0: none.
    pub cycle: u64,
}

impl Turns {
    /// Nothing happens between the moves of turns in the run-time views.
    fn is_search(&self) -> bool {
        self.n_looked_at == 1 && self.steps == [0; 3]
    }
}

/// Optimizes in turns, each with the objective that `show` makes for it. If one of `sets` is looked at, turns
/// search single vertices too. What the tape knows is not drawn. `params.max_evaluations` must not be 0, and is
/// for all turns together.
pub fn alternate<E: From<OptimizeError>>(
    mesh: &mut EditMesh,
    params: &Params,
    turns: Turns,
    (sets, tape): (&[ViewSet], &Tape),
    show: &mut Shower<'_, E>,
    on: &mut Listener<'_>,
) -> Result<Outcome, E> {
    let mut run = Alternation::new(mesh, &show(0, mesh)?, params, turns, (sets, tape));
    let ended = run.all(mesh, show, on);
    run.outcome.stopped_by = match ended {
        Ok(()) => StoppedBy::Evaluations,
        Err(Halt::By(by)) => by,
        Err(Halt::Fault(fault)) => return Err(fault),
    };
    if run.outcome.stopped_by != StoppedBy::Evaluations {
        // A run that comes to its end has looked.
        run.outcome.energy_after = show(0, mesh)?.energy();
    }
    run.n_turns += 1;
    // What moves have done is told even where nothing of it was kept.
    let is_broken = run.sample(mesh, on).is_break()
        || !run.outcome.moves.is_empty() && on(Step::Moves(&run.outcome.moves)).is_break();
    if is_broken {
        run.outcome.stopped_by = StoppedBy::Caller;
    }
    Ok(run.outcome)
}

/// Why a run goes no further.
pub(super) enum Halt<E> {
    By(StoppedBy),
    Fault(E),
}

/// What the caller says, so that `?` breaks off.
pub(super) fn heard<E>(flow: ControlFlow<()>) -> Result<(), Halt<E>> {
    match flow {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(Halt::By(StoppedBy::Caller)),
    }
}

/// Tells of edits that were made, all of them: whatever the caller says, the mesh has them.
pub(super) fn tell(edits: &[EditRecord], on: &mut Listener<'_>) -> ControlFlow<()> {
    let mut flow = ControlFlow::Continue(());
    for edit in edits {
        if on(Step::Edit(edit.edit())).is_break() {
            flow = ControlFlow::Break(());
        }
    }
    flow
}

/// What a tape is asked here and in the modules beside (0 to 2: `render/taped.rs`).
const DESCENT: Question = Question::of(3);
pub(super) const RESIDUAL: Question = Question::of(4);
pub(super) const JUDGED: Question = Question::of(5);

/// [`Params::step_bits`] at first, and at most; one more after so many evaluations a triangle.
const FIRST_BITS: f64 = 2.0;
const MOST_BITS: f64 = 8.0;
const BIT_EVERY: f64 = 500.0;

/// A run ends when so many cycles in a row have brought nothing.
const MAX_FRUITLESS: u32 = 6;

/// One turn.
pub(super) struct Turn {
    set: usize,
    /// Steps of the descent before it.
    pub n_steps: usize,
}

/// Some turns and the descent after them.
#[derive(Clone, Copy)]
pub(super) struct Stretch {
    /// Evaluations of the whole run at its end.
    pub end: u64,
    /// The mesh has as many triangles as it should, so that its energy is to be heard of.
    pub counts: bool,
    /// It is cut into patches, and vertices do not go from one to another.
    pub is_cut: bool,
}

/// See [`alternate`].
pub(super) struct Alternation<'a> {
    pub params: &'a Params,
    pub turns: Turns,
    pub sets: &'a [ViewSet],
    /// Knows what was drawn and found before.
    pub tape: &'a Tape,
    /// Triangles at first.
    pub n_faces: usize,
    n_turns: usize,
    /// Descents so far, in steps: where the next one goes on in the view sets.
    n_steps: usize,
    pub has_own_normals: bool,
    pub memory: Option<Memory>,
    /// In the views that count.
    n_pixels: u64,
    /// Cycles in a row that have brought nothing.
    pub n_fruitless: u32,
    pub outcome: Outcome,
}

impl<'a> Alternation<'a> {
    fn new(
        mesh: &EditMesh,
        objective: &Objective,
        params: &'a Params,
        turns: Turns,
        (sets, tape): (&'a [ViewSet], &'a Tape),
    ) -> Self {
        let energy = objective.energy();
        let outcome = Outcome {
            evaluations: 0,
            energy_before: energy,
            energy_after: energy,
            moves: Vec::new(),
            stopped_by: StoppedBy::Evaluations,
        };
        Self {
            params,
            turns,
            sets,
            tape,
            n_faces: mesh.n_faces(),
            n_turns: 0,
            n_steps: 0,
            has_own_normals: objective.has_own_normals(),
            memory: None,
            n_pixels: objective.n_counted_pixels(),
            n_fruitless: 0,
            outcome,
        }
    }

    /// Turns, cycles, turns.
    fn all<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        show: &mut Shower<'_, E>,
        on: &mut Listener<'_>,
    ) -> Result<(), Halt<E>> {
        heard(self.sample(mesh, on))?;
        let (max, length) = (self.params.max_evaluations, self.turns.cycle);
        // Measured with cycles of 100 evaluations a triangle after the first 40.
        let before_cycles = 2 * length / 5;
        let n_cycles = max.saturating_sub(before_cycles).checked_div(length).unwrap_or(0);
        if n_cycles > 0 {
            self.take_judged_turns(mesh, before_cycles, show, on)?;
            self.settle(mesh, show)?;
        }
        for k in 1..=n_cycles {
            self.cycle(mesh, (k, before_cycles + k * length), show, on)?;
            let settled = self.settle(mesh, show);
            heard(self.sample(mesh, on))?;
            settled?;
            if self.n_fruitless == MAX_FRUITLESS {
                return Err(Halt::By(StoppedBy::Converged));
            }
        }
        self.take_judged_turns(mesh, max, show, on)?;
        self.settle(mesh, show)
    }

    /// Looks whether the energy is as low as was asked.
    fn settle<E>(&mut self, mesh: &EditMesh, show: &mut Shower<'_, E>) -> Result<(), Halt<E>> {
        self.outcome.energy_after = show(0, mesh).map_err(Halt::Fault)?.energy();
        let wanted = self.params.until * self.outcome.energy_before as f64;
        let is_low = self.outcome.energy_after as f64 <= wanted;
        if is_low { Err(Halt::By(StoppedBy::Energy)) } else { Ok(()) }
    }

    /// A point of the energy curve between turns.
    pub fn sample(&self, mesh: &EditMesh, on: &mut Listener<'_>) -> ControlFlow<()> {
        on(Step::Sample(Sample {
            stage: Stage::Optimize,
            evaluations: self.outcome.evaluations,
            triangles: mesh.n_faces() as u32,
            energy: Some(self.outcome.energy_after),
            d2: Some(d2_percent(self.outcome.energy_after, self.n_pixels)),
            turn: self.n_turns as u32,
        }))
    }

    /// Takes turns as long as there are evaluations left, then descends.
    pub fn take_turns<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        stretch: Stretch,
        show: &mut Shower<'_, E>,
        on: &mut Listener<'_>,
    ) -> Result<(), Halt<E>> {
        let Some(mut turn) = self.next_turn(mesh, stretch) else {
            return heard(self.descend(mesh, self.affordable(mesh, stretch), on));
        };
        heard(self.descend(mesh, turn.n_steps, on))?;
        while let Some(next) = self.take_turn(mesh, (&turn, stretch), show, on)? {
            turn = next;
        }
        Ok(())
    }

    /// The moves of a turn, and the descent after it. Returns the next turn.
    pub fn take_turn<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        (turn, stretch): (&Turn, Stretch),
        show: &mut Shower<'_, E>,
        on: &mut Listener<'_>,
    ) -> Result<Option<Turn>, Halt<E>> {
        let mut objective = show(turn.set, mesh).map_err(Halt::Fault)?;
        self.make_moves(mesh, (turn, stretch), &mut objective, on)?;
        let next = self.next_turn(mesh, stretch);
        let n_steps = next.as_ref().map_or_else(|| self.affordable(mesh, stretch), |t| t.n_steps);
        heard(self.descend(mesh, n_steps, on))?;
        Ok(next)
    }

    /// Steps of the descent that ends a stretch, if there are evaluations enough.
    fn last_steps(&self, stretch: Stretch) -> usize {
        self.turns.steps[if stretch.counts { 2 } else { 1 }]
    }

    /// What is left of a stretch when the last descent is paid for.
    fn left(&self, mesh: &EditMesh, stretch: Stretch) -> u64 {
        let reserved = descent::cost(mesh, self.last_steps(stretch));
        stretch.end.saturating_sub(self.outcome.evaluations + reserved)
    }

    /// The next turn; `None` when there are no evaluations left for one.
    pub fn next_turn(&mut self, mesh: &EditMesh, stretch: Stretch) -> Option<Turn> {
        let (number, n_others) = (self.n_turns, self.turns.n_looked_at - 1);
        let n_steps = self.turns.steps[usize::from(number > 0)];
        if self.left(mesh, stretch) <= descent::cost(mesh, n_steps) {
            return None;
        }
        self.n_turns += 1;
        Some(Turn { set: self.set_of(number, n_others), n_steps })
    }

    fn set_of(&self, number: usize, n_others: usize) -> usize {
        let counts = n_others == 0 || number.is_multiple_of(self.turns.n_others + 1);
        let n_before = number - number.div_ceil(self.turns.n_others + 1);
        if counts { 0 } else { 1 + n_before % n_others }
    }

    /// A view set for what happens between turns.
    pub fn some_set(&self) -> usize {
        self.n_turns % self.turns.n_looked_at
    }

    /// Steps of the last descent that a stretch allows.
    pub fn affordable(&self, mesh: &EditMesh, stretch: Stretch) -> usize {
        let left = stretch.end.saturating_sub(self.outcome.evaluations);
        let mut n_steps = self.last_steps(stretch);
        while n_steps > 0 && descent::cost(mesh, n_steps) > left {
            n_steps -= 1;
        }
        n_steps
    }

    /// A descent in so many steps.
    pub fn descend(
        &mut self,
        mesh: &mut EditMesh,
        n_steps: usize,
        on: &mut Listener<'_>,
    ) -> ControlFlow<()> {
        let unknowns = Unknowns {
            has_own_normals: self.has_own_normals,
            normals: self.has_own_normals && self.params.optimizes_normals,
            attributes: self.params.optimizes_attributes,
        };
        let (spent, total) = (self.outcome.evaluations, self.params.max_evaluations);
        if n_steps == 0 {
            return ControlFlow::Continue(());
        }
        let cost = descent::cost(mesh, n_steps);
        let mut on_step = |k: usize| {
            let done = spent + cost * k as u64 / n_steps as u64;
            on(Step::Progress { done: done.min(total), total })
        };
        let steps = (self.n_steps, n_steps);
        self.n_steps += n_steps;
        self.outcome.evaluations += cost;
        let sets = &self.sets[..self.turns.n_looked_at];
        let find = || descent::descend(mesh, sets, steps, unknowns, &mut on_step).continue_value();
        match self.tape.known(DESCENT, find) {
            Some(destination) => tell(&descent::go(mesh, &destination), on),
            None => ControlFlow::Break(()),
        }
    }

    /// [`Params::step_bits`] of a turn: the longer the run, the finer its searches. Where many sets are looked at, none.
    fn step_bits(&self) -> f64 {
        if self.turns.n_looked_at > 1 {
            return 0.0;
        }
        let per_triangle = self.outcome.evaluations as f64 / self.n_faces.max(1) as f64;
        (FIRST_BITS + per_triangle / BIT_EVERY).min(MOST_BITS)
    }

    /// The discrete moves of a turn.
    fn make_moves<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        (turn, stretch): (&Turn, Stretch),
        objective: &mut Objective,
        on: &mut Listener<'_>,
    ) -> Result<(), Halt<E>> {
        let (spent, total) = (self.outcome.evaluations, self.params.max_evaluations);
        let is_heard = turn.set == 0 && stretch.counts;
        // What the run began with, as this turn sees it.
        let first = self.outcome.energy_before as f64 / (objective.energy() as f64).max(1.0);
        let params = Params {
            max_evaluations: self.left(mesh, stretch).min(self.turns.evaluations).max(1),
            until: if is_heard { self.params.until * first } else { 0.0 },
            // Descents know no pixels: what is left to find for one set of pictures, searches find.
            has_vertex_moves: self.params.has_vertex_moves && self.turns.n_looked_at == 1,
            has_teleports: self.params.has_teleports && !stretch.is_cut,
            step_bits: self.step_bits(),
            ..self.params.clone()
        };
        let is_search = self.turns.is_search();
        let mut optimizer = match self.memory.take() {
            Some(known) if is_search => Optimizer::resume(mesh, objective, params, known),
            Some(known) => Optimizer::resume(mesh, objective, params, known.seen_anew()),
            None => Optimizer::new(mesh, objective, params),
        };
        let told = Told { is_heard, turn: self.n_turns as u32, spent, total };
        let outcome = optimizer.run(&mut |step| match told.of(step) {
            Some(step) => on(step),
            None => ControlFlow::Continue(()),
        });
        let outcome = outcome.map_err(|fault| Halt::Fault(fault.into()))?;
        self.memory = Some(optimizer.into_memory());
        self.outcome.evaluations += outcome.evaluations;
        self.outcome.moves = outcome.moves;
        match outcome.stopped_by {
            by @ (StoppedBy::Caller | StoppedBy::Energy) if by == StoppedBy::Caller || is_heard => {
                Err(Halt::By(by))
            }
            StoppedBy::Converged if is_search => Err(Halt::By(StoppedBy::Converged)),
            _ => Ok(()),
        }
    }
}

/// What the caller hears of a turn's steps.
#[derive(Clone, Copy)]
struct Told {
    /// Its energies can be compared with those of other turns.
    is_heard: bool,
    turn: u32,
    /// Evaluations before it.
    spent: u64,
    total: u64,
}

impl Told {
    fn of(self, step: Step<'_>) -> Option<Step<'_>> {
        let Self { is_heard, turn, spent, total } = self;
        match step {
            Step::Sample(_) | Step::Moves(_) if !is_heard => None,
            Step::Sample(sample) => {
                let evaluations = spent + sample.evaluations;
                Some(Step::Sample(Sample { evaluations, turn, ..sample }))
            }
            Step::Progress { done, .. } => {
                Some(Step::Progress { done: (spent + done).min(total), total })
            }
            edit => Some(edit),
        }
    }
}
