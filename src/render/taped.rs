//! An evaluator whose answers may be known already.
//!
//! As long as the tape has answers no picture is drawn: edits are made to the scene alone. The first question
//! without one has the pictures drawn of the scene as it is then, which are the same as those that followed every
//! edit (`contract.rs`).

use crate::tape::{Question, Tape};

use super::{
    evaluator::{Evaluator, RenderError},
    moves::Move,
    raster,
    scene::Scene,
};

const EVALUATE: u8 = 0;
const COMMIT: u8 = 1;
const ENERGY: Question = Question::of(2);

/// Builds the evaluator of a scene.
pub type Maker = Box<dyn Fn(&Scene) -> Result<Box<dyn Evaluator>, RenderError> + Send>;

/// See the module.
pub struct Taped {
    tape: Tape,
    make: Maker,
    live: Option<Box<dyn Evaluator>>,
    energy: u64,
}

impl Taped {
    /// Judges moves of `scene`; `make` is asked for who does when the tape does not know.
    pub fn new(tape: &Tape, scene: &Scene, make: Maker) -> Result<Self, RenderError> {
        let mut taped = Self { tape: tape.clone(), make, live: None, energy: 0 };
        taped.energy = tape.answer(ENERGY, || Ok(taped.live(scene)?.energy()))?;
        Ok(taped)
    }

    fn live(&mut self, scene: &Scene) -> Result<&mut Box<dyn Evaluator>, RenderError> {
        if self.live.is_none() {
            self.live = Some((self.make)(scene)?);
        }
        self.live.as_mut().ok_or_else(|| RenderError::Device("no evaluator".into()))
    }
}

impl Evaluator for Taped {
    fn name(&self) -> String {
        self.live.as_ref().map_or_else(|| "tape".into(), |live| live.name())
    }

    fn evaluate(&mut self, scene: &Scene, moves: &[Move]) -> Result<Vec<i64>, RenderError> {
        let print = moves.iter().fold(moves.len() as u64, fold);
        let tape = self.tape.clone();
        tape.answer(Question { kind: EVALUATE, print }, || self.live(scene)?.evaluate(scene, moves))
    }

    fn commit(&mut self, scene: &mut Scene, mv: &Move) -> Result<i64, RenderError> {
        let (tape, question) = (self.tape.clone(), Question { kind: COMMIT, print: fold(0, mv) });
        let mut is_made = false;
        let delta = tape.answer(question, || {
            is_made = true;
            self.live(scene)?.commit(scene, mv)
        })?;
        if !is_made {
            scene.apply(mv);
        }
        self.energy = self.energy.saturating_add_signed(delta);
        Ok(delta)
    }

    fn energy(&self) -> u64 {
        self.energy
    }

    fn picture(&mut self, scene: &Scene, view: usize) -> Result<Vec<u8>, RenderError> {
        match &mut self.live {
            Some(live) => live.picture(scene, view),
            None => Ok(raster::picture(scene, view)),
        }
    }
}

fn fold(print: u64, mv: &Move) -> u64 {
    let first = mv.removed.first().map_or(0, |face| u64::from(*face) + 1);
    print.wrapping_mul(31).wrapping_add(first).wrapping_add(mv.added.len() as u64)
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use glam::DVec3;

    use super::super::{Twin, contract};
    use super::*;
    use crate::tape::pack;

    const N_EDITS: usize = 12;

    fn taped(tape: &Tape, scene: &Scene, n_made: &Arc<Mutex<u32>>) -> Taped {
        let reference = raster::reference(&contract::scene(8, contract::LOOKS[0]));
        let n_made = Arc::clone(n_made);
        let make: Maker = Box::new(move |scene| {
            *n_made.lock().unwrap() += 1;
            Ok(Box::new(Twin::new(scene, &reference)))
        });
        Taped::new(tape, scene, make).unwrap()
    }

    /// A run broken off after each question gives the same answers when it goes on, and draws pictures once at most.
    #[test]
    fn a_run_goes_on_where_it_was_broken_off() {
        let edit = |scene: &Scene, k: usize| {
            contract::random_move(scene, (k * 37, k), DVec3::splat(0.02)).unwrap_or_default()
        };
        let play = |tape: &Tape, n_made: &Arc<Mutex<u32>>| {
            let mut scene = contract::scene(8, contract::LOOKS[0]);
            let mut evaluator = taped(tape, &scene, n_made);
            let mut answers = vec![evaluator.energy() as i64];
            for k in 0..N_EDITS {
                let mv = edit(&scene, k);
                answers.extend(
                    evaluator.evaluate(&scene, &[mv.clone(), edit(&scene, k + 1)]).unwrap(),
                );
                answers.push(evaluator.commit(&mut scene, &mv).unwrap());
                answers.push(evaluator.energy() as i64);
            }
            let pictures: Vec<_> =
                (0..scene.n_views()).map(|v| evaluator.picture(&scene, v).unwrap()).collect();
            (answers, pictures)
        };
        let n_made = Arc::new(Mutex::new(0));
        let wanted = play(&Tape::off(), &n_made);
        let kept: Arc<Mutex<Vec<Vec<u8>>>> = Arc::default();
        let keep = Arc::clone(&kept);
        let every = move |recorded: &mut Vec<u8>| {
            if !recorded.is_empty() {
                keep.lock().unwrap().push(pack(&std::mem::take(recorded)).unwrap());
            }
        };
        assert!(play(&Tape::new(Vec::new(), Box::new(every)), &n_made) == wanted);
        let pieces = kept.lock().unwrap().clone();
        assert_eq!(pieces.len(), 2 * N_EDITS);
        for n in 1..=pieces.len() {
            let (tape, n_made) =
                (Tape::new(pieces[..n].to_vec(), Box::new(|_| ())), Arc::default());
            assert!(play(&tape, &n_made) == wanted, "after {n} answers");
            assert_eq!(tape.fault(), None);
            assert_eq!(*n_made.lock().unwrap(), 1, "the last answer is never on the tape");
        }
    }
}
