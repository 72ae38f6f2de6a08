//! What each operation has brought lately, and which one deserves another try.
//!
//! Invariants:
//! 1. time is counted in evaluations, never in seconds, so a run can be repeated;
//! 2. all means are attenuated exponentially, so they follow the mesh as it improves.
//!
//! Source: Lindstrom & Turk 2000, section 7.1.5; condition (6) in the printed, two-sided form.

use super::operations::{OPERATIONS, Operation};
use crate::mesh::MoveCount;

/// Weight that a mean keeps when a new value comes in.
const KEEP: f64 = 0.97;
/// Weight that frequencies keep when an operation is tried.
const KEEP_FREQUENCY: f64 = 0.99;
/// Tries before condition (6) judges an operation.
const MIN_TRIES: u64 = 8;

/// An exponentially attenuated mean and variance.
#[derive(Clone, Copy, Debug, Default)]
pub struct Average {
    weight: f64,
    mean: f64,
    variance: f64,
}

impl Average {
    /// Takes in a value.
    pub fn add(&mut self, x: f64) {
        self.weight = KEEP * self.weight + 1.0;
        let share = 1.0 / self.weight;
        let off = x - self.mean;
        self.mean += share * off;
        self.variance = (1.0 - share) * (self.variance + share * off * off);
    }

    /// The mean; 0 before any value.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// The standard deviation.
    pub fn deviation(&self) -> f64 {
        self.variance.max(0.0).sqrt()
    }
}

/// The record of one operation.
#[derive(Clone, Copy, Debug, Default)]
pub struct Figures {
    /// Times it was tried, in all.
    pub tried: u64,
    /// Times it was accepted, in all.
    pub accepted: u64,
    /// Evaluations spent on it, in all.
    pub evaluations: u64,
    /// Energy that it has taken off, in all.
    pub reduction: i64,
    /// Energy taken off by a try (0 for a rejected one).
    x: Average,
    /// Evaluations of a try.
    t: Average,
    /// Attenuated number of tries: the frequency of use.
    frequency: f64,
}

impl Figures {
    /// Energy taken off by an evaluation, lately.
    pub fn efficiency(&self) -> f64 {
        self.x.mean() / self.t.mean().max(1.0)
    }
}

/// The records of all operations.
#[derive(Clone, Debug, Default)]
pub struct Statistics {
    figures: [Figures; OPERATIONS.len()],
}

impl Statistics {
    /// The record of an operation.
    pub fn of(&self, operation: Operation) -> &Figures {
        &self.figures[operation.index()]
    }

    /// Counts a try that took off `reduction` with so many evaluations, outside condition (6).
    pub fn count(&mut self, operation: Operation, reduction: i64, evaluations: u64) {
        let f = &mut self.figures[operation.index()];
        f.tried += 1;
        f.accepted += u64::from(reduction != 0);
        f.evaluations += evaluations;
        f.reduction += reduction;
    }

    /// Notes that an operation is about to be tried on an edge.
    pub fn use_once(&mut self, operation: Operation) {
        for figures in &mut self.figures {
            figures.frequency *= KEEP_FREQUENCY;
        }
        self.figures[operation.index()].frequency += 1.0;
    }

    /// Counts a try and learns from it.
    pub fn log(&mut self, operation: Operation, reduction: i64, evaluations: u64) {
        self.count(operation, reduction, evaluations);
        let f = &mut self.figures[operation.index()];
        f.x.add(reduction as f64);
        f.t.add(evaluations as f64);
    }

    /// The records as the caller is told them.
    pub fn counts(&self, n_uphill: u64) -> Vec<MoveCount> {
        let count = |(o, f): (&Operation, &Figures)| MoveCount {
            name: o.name(),
            tried: f.tried,
            accepted: f.accepted,
            evaluations: f.evaluations,
            reduction: f.reduction,
        };
        let uphill = MoveCount {
            name: "uphill teleport",
            tried: n_uphill,
            accepted: n_uphill,
            evaluations: 0,
            reduction: 0,
        };
        let all = OPERATIONS.iter().zip(&self.figures).map(count);
        all.chain(std::iter::once(uphill)).filter(|c| c.tried > 0).collect()
    }

    /// Condition (6): whether to try an operation on an edge that has already brought
    /// `reduction_so_far`.
    pub fn deserves_try(&self, operation: Operation, reduction_so_far: i64) -> bool {
        let own = self.of(operation);
        if own.tried < MIN_TRIES {
            return reduction_so_far == 0;
        }
        let best = self.best();
        let usual = own.t.mean() / best.t.mean().max(1.0) * best.x.mean();
        let share = best.frequency / (own.frequency + best.frequency).max(f64::MIN_POSITIVE);
        let doubt = std::f64::consts::SQRT_2 * inverse_erf(share) * own.x.deviation();
        // With equality the best itself passes when it never varies, and all when nothing helps.
        let has_brought = reduction_so_far as f64;
        own.x.mean() >= usual - doubt && (own.x.mean() > has_brought || has_brought == 0.0)
    }

    /// The operation that takes off most energy for its evaluations.
    fn best(&self) -> &Figures {
        let first = &self.figures[0];
        self.figures.iter().fold(first, |a, b| if b.efficiency() > a.efficiency() { b } else { a })
    }
}

/// The inverse of the error function on 0..1 (Giles 2010, single-precision branch: enough to
/// choose by), at most 3.
fn inverse_erf(x: f64) -> f64 {
    let x = x.clamp(0.0, 0.999_98);
    let w = -libm::log((1.0 - x) * (1.0 + x));
    let horner = |w: f64, c: &[f64]| c.iter().fold(0.0, |sum, c| sum * w + c);
    if w < 5.0 { x * horner(w - 2.5, &CENTRAL) } else { x * horner(w.sqrt() - 3.0, &TAIL) }
}

const CENTRAL: [f64; 9] = [
    2.810_226_36e-8,
    3.432_739_39e-7,
    -3.523_387_7e-6,
    -4.391_506_54e-6,
    0.000_218_580_87,
    -0.001_253_725_03,
    -0.004_177_681_64,
    0.246_640_727,
    1.501_409_41,
];
const TAIL: [f64; 9] = [
    -0.000_200_214_257,
    0.000_100_950_558,
    0.001_349_343_22,
    -0.003_673_428_44,
    0.005_739_507_73,
    -0.007_622_461_3,
    0.009_438_870_47,
    1.001_674_06,
    2.832_976_82,
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_inverse_error_function_meets_its_known_points() {
        for (x, y) in [(0.0, 0.0), (0.5, 0.476_936_3), (0.842_700_8, 1.0), (0.995_322_3, 2.0)] {
            assert!((inverse_erf(x) - y).abs() < 1e-5, "{x}: {}", inverse_erf(x));
        }
    }

    #[test]
    fn averages_follow_what_comes_and_forget_what_was() {
        let mut average = Average::default();
        for _ in 0..400 {
            average.add(10.0);
        }
        assert!((average.mean() - 10.0).abs() < 1e-9 && average.deviation() < 1e-6);
        for i in 0..400 {
            average.add(if i % 2 == 0 { 0.0 } else { 2.0 });
        }
        assert!((average.mean() - 1.0).abs() < 0.05 && (average.deviation() - 1.0).abs() < 0.05);
    }

    #[test]
    fn the_best_operation_is_tried_and_a_hopeless_one_is_not() {
        let mut statistics = Statistics::default();
        let [good, bad, rough] = [OPERATIONS[0], OPERATIONS[1], OPERATIONS[2]];
        for i in 0..100 {
            statistics.log(good, 1000, 10);
            statistics.log(bad, 1, 100);
            statistics.log(rough, if i % 10 == 0 { 90_000 } else { 0 }, 100);
            [good, bad, rough].into_iter().for_each(|o| statistics.use_once(o));
        }
        assert!(statistics.deserves_try(good, 0));
        assert!(!statistics.deserves_try(bad, 0));
        // As efficient as nine tenths of the best, and uncertain: worth a try now and then.
        assert!(statistics.deserves_try(rough, 0));
        assert!(!statistics.deserves_try(good, 1000), "the edge has brought as much already");
        assert!(statistics.deserves_try(OPERATIONS[5], 0), "never tried");
    }
}
