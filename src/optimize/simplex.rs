//! The downhill simplex method (Nelder & Mead 1965, in the form of Press et al., Numerical Recipes,
//! section 10.4) as a state machine that asks for energies and is told them: many searches can run
//! in step, each contributing its points to one batch.
//!
//! Invariants:
//! 1. `values[i]` is the energy at `points[i]`; the best of them never gets worse;
//! 2. `log2_volume` is the simplex's volume relative to the first one's, in bits: reflection keeps
//!    it, expansion doubles it, contraction halves it, shrinking takes off one bit a dimension;
//! 3. the path does not depend on whether points are asked for ahead of need.
//!
//! Knows nothing of meshes.

/// A point of the search space.
pub type Point = Vec<f64>;

/// When a search ends, and how it asks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stop {
    /// The volume has fallen by so many bits for each dimension.
    pub bits: i32,
    /// So many evaluations for each dimension (32: Lindstrom & Turk 2000, section 7.1.3).
    pub evaluations_per_dimension: u32,
    /// Ask for all points that the next step may need at once: fewer rounds, more evaluations.
    pub is_speculative: bool,
}

/// See the module.
#[derive(Clone, Debug)]
pub struct Simplex {
    points: Vec<Point>,
    values: Vec<i64>,
    log2_volume: i32,
    stop: Stop,
    evaluations: u32,
    phase: Phase,
    asked: Vec<Point>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// The corners of the first simplex; the number of those whose energy is known already.
    Start(usize),
    Reflect,
    /// After a reflection to this energy.
    Expand(i64),
    /// After a reflection to this energy, which may have replaced the worst corner.
    Contract,
    Shrink,
    Done,
}

/// How far along the line from the worst corner through the centre of the others: 1 is the mirror
/// image.
const REFLECT: f64 = 1.0;
const EXPAND: f64 = 2.0;
const CONTRACT_OUTSIDE: f64 = 0.5;
const CONTRACT_INSIDE: f64 = -0.5;

impl Simplex {
    /// A search from `start` with first steps along the axes. `value` is the energy at `start`,
    /// where it is known.
    pub fn new(start: Point, value: Option<i64>, steps: &[f64], stop: Stop) -> Self {
        let corner = |i: usize| {
            let mut p = start.clone();
            p[i] += steps[i];
            p
        };
        let n = steps.len().min(start.len());
        let points: Vec<Point> = std::iter::once(start.clone()).chain((0..n).map(corner)).collect();
        let known = usize::from(value.is_some());
        let mut simplex = Self {
            values: value.into_iter().collect(),
            asked: points[known..].to_vec(),
            points,
            log2_volume: 0,
            stop,
            evaluations: 0,
            phase: Phase::Start(known),
        };
        if n == 0 && known == 1 {
            simplex.phase = Phase::Done;
            simplex.asked.clear();
        }
        simplex
    }

    /// The points whose energies are wanted next; none when the search is over.
    pub fn asks(&self) -> &[Point] {
        &self.asked
    }

    /// Takes the energies of [`Self::asks`], in order.
    pub fn told(&mut self, values: &[i64]) {
        self.evaluations += values.len() as u32;
        match self.phase {
            Phase::Start(_) => {
                self.values.extend_from_slice(values);
                self.ask_reflection();
            }
            Phase::Reflect => self.reflected(values),
            Phase::Expand(reflected) => {
                let expanded = values.first().copied().unwrap_or(i64::MAX);
                self.take_farther(reflected, expanded);
            }
            Phase::Contract => {
                let value = values.first().copied().unwrap_or(i64::MAX);
                let point = self.asked.first().cloned().unwrap_or_default();
                self.contracted(point, value);
            }
            Phase::Shrink => {
                let best = self.best_index();
                let others = (0..self.points.len()).filter(|&i| i != best);
                for ((i, point), value) in others.zip(self.asked.drain(..)).zip(values) {
                    self.points[i] = point;
                    self.values[i] = *value;
                }
                self.log2_volume -= self.n_dimensions();
                self.ask_reflection();
            }
            Phase::Done => {}
        }
    }

    /// The best point and its energy; `None` before anything is known.
    pub fn best(&self) -> Option<(&Point, i64)> {
        let at = self.best_index();
        Some((&self.points[at], *self.values.get(at)?))
    }

    /// Energies asked for so far.
    pub fn evaluations(&self) -> u32 {
        self.evaluations
    }

    fn n_dimensions(&self) -> i32 {
        self.points.len() as i32 - 1
    }

    /// The first of the least.
    fn best_index(&self) -> usize {
        (0..self.values.len()).min_by_key(|&i| self.values[i]).unwrap_or(0)
    }

    /// The last of the greatest.
    fn worst_index(&self) -> usize {
        (0..self.values.len()).max_by_key(|&i| self.values[i]).unwrap_or(0)
    }

    /// The point at `factor` along the line from the worst corner through the others' centre.
    fn along(&self, factor: f64) -> Point {
        let worst = self.worst_index();
        let weight = (1.0 + factor) / f64::from(self.n_dimensions());
        let coordinate = |k: usize| {
            let all: f64 = self.points.iter().map(|p| p[k]).sum();
            let from = self.points[worst][k];
            (all - from) * weight - from * factor
        };
        (0..self.n_dimensions() as usize).map(coordinate).collect()
    }

    /// Begins a step, or ends the search.
    fn ask_reflection(&mut self) {
        let n = self.n_dimensions();
        let limit = self.stop.evaluations_per_dimension * n as u32;
        if n == 0 || self.log2_volume <= -self.stop.bits * n || self.evaluations >= limit {
            self.phase = Phase::Done;
            self.asked.clear();
            return;
        }
        self.phase = Phase::Reflect;
        self.asked = vec![self.along(REFLECT)];
        if self.stop.is_speculative {
            let ahead = [EXPAND, CONTRACT_OUTSIDE, CONTRACT_INSIDE];
            self.asked.extend(ahead.map(|factor| self.along(factor)));
        }
    }

    /// What comes of a reflection; `values` beyond the first were asked for ahead of need.
    fn reflected(&mut self, values: &[i64]) {
        let Some((&value, ahead)) = values.split_first() else { return self.ask_reflection() };
        let asked = std::mem::take(&mut self.asked);
        let worst = self.worst_index();
        let next_worst = (0..self.values.len()).filter(|&i| i != worst).map(|i| self.values[i]);
        if value < self.values[self.best_index()] {
            if let Some(&expanded) = ahead.first() {
                self.take_farther(value, expanded);
            } else {
                self.asked = vec![self.along(EXPAND)];
                self.phase = Phase::Expand(value);
            }
        } else if next_worst.max().is_some_and(|next| value < next) {
            self.replace_worst(asked[0].clone(), value, 0);
            self.ask_reflection();
        } else {
            let is_outside = value < self.values[worst];
            let factor = if is_outside { CONTRACT_OUTSIDE } else { CONTRACT_INSIDE };
            let point = self.along(factor);
            if is_outside {
                self.replace_worst(asked[0].clone(), value, 0);
            }
            if let Some(&contracted) = ahead.get(if is_outside { 1 } else { 2 }) {
                self.contracted(point, contracted);
            } else {
                self.asked = vec![point];
                self.phase = Phase::Contract;
            }
        }
    }

    fn replace_worst(&mut self, point: Point, value: i64, bits: i32) {
        let worst = self.worst_index();
        self.points[worst] = point;
        self.values[worst] = value;
        self.log2_volume += bits;
    }

    /// The better of a reflected and an expanded point replaces the worst corner.
    fn take_farther(&mut self, reflected: i64, expanded: i64) {
        if expanded < reflected {
            self.replace_worst(self.along(EXPAND), expanded, 1);
        } else {
            self.replace_worst(self.along(REFLECT), reflected, 0);
        }
        self.ask_reflection();
    }

    /// A contracted point replaces the worst corner, or all shrink towards the best.
    fn contracted(&mut self, point: Point, value: i64) {
        if value < self.values[self.worst_index()] {
            self.replace_worst(point, value, -1);
            self.ask_reflection();
            return;
        }
        let best = self.best_index();
        let towards = |p: &Point| -> Point {
            p.iter().zip(&self.points[best]).map(|(a, b)| f64::midpoint(*a, *b)).collect()
        };
        let others = (0..self.points.len()).filter(|&i| i != best);
        self.asked = others.map(|i| towards(&self.points[i])).collect();
        self.phase = Phase::Shrink;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const STOP: Stop = Stop { bits: 12, evaluations_per_dimension: 64, is_speculative: false };

    fn run(mut simplex: Simplex, energy: &dyn Fn(&[f64]) -> i64) -> Simplex {
        for _ in 0..10_000 {
            if simplex.asks().is_empty() {
                return simplex;
            }
            let values: Vec<i64> = simplex.asks().iter().map(|p| energy(p)).collect();
            simplex.told(&values);
        }
        panic!("the search does not end");
    }

    fn bowl(p: &[f64]) -> i64 {
        let square: f64 =
            p.iter().enumerate().map(|(i, x)| (i + 1) as f64 * (x - 1.0).powi(2)).sum();
        (square * 1e6) as i64
    }

    #[test]
    fn it_finds_the_bottom_of_a_bowl() {
        for n in 1..=6 {
            let start = Simplex::new(vec![0.0; n], None, &vec![0.3; n], STOP);
            let simplex = run(start, &bowl);
            let (at, value) = simplex.best().unwrap();
            assert!(at.iter().all(|x| (x - 1.0).abs() < 0.05), "{n}: {at:?} {value}");
        }
    }

    #[test]
    fn nothing_to_search_is_one_evaluation_or_none() {
        let simplex = run(Simplex::new(vec![], None, &[], STOP), &|_| 7);
        assert_eq!((simplex.best().unwrap().1, simplex.evaluations()), (7, 1));
        assert!(Simplex::new(vec![], Some(0), &[], STOP).asks().is_empty());
    }

    proptest! {
        #[test]
        fn asking_ahead_does_not_change_the_path(
            start in prop::collection::vec(-2.0_f64..2.0, 1..5),
            roughness in 0.0_f64..3.0,
        ) {
            let rough = |p: &[f64]| {
                let ripple: f64 = p.iter().map(|x| libm::sin(7.0 * x)).sum();
                bowl(p) + (roughness * ripple * 1e5) as i64
            };
            let steps = vec![0.25; start.len()];
            let ahead = Stop { is_speculative: true, evaluations_per_dimension: 10_000, ..STOP };
            let plain = Stop { is_speculative: false, ..ahead };
            let a = run(Simplex::new(start.clone(), Some(rough(&start)), &steps, plain), &rough);
            let b = run(Simplex::new(start.clone(), Some(rough(&start)), &steps, ahead), &rough);
            prop_assert_eq!(&a.points, &b.points);
            prop_assert!(a.evaluations() <= b.evaluations());
            prop_assert!(a.best().unwrap().1 <= rough(&start));
        }
    }
}
