//! Quadratic steps: probe both sides of the present place along each axis, fit a parabola to each,
//! and try the place where all are at their lowest.
//!
//! Two rounds of 2n and of a few evaluations bring a point most of the way into the valley that the
//! downhill simplex method needs some 8n for; the axes are the caller's (a vertex normal and two
//! tangents, say), so that the parabolas are nearly independent.
//!
//! Knows nothing of meshes.

use super::simplex::Point;

/// See the module. Search space: coordinates along the caller's axes, the start at the origin.
#[derive(Clone, Debug)]
pub struct Quadratic {
    steps: Vec<f64>,
    center: i64,
    best: (Point, i64),
    phase: Phase,
    asked: Vec<Point>,
    evaluations: u32,
    rounds_left: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Start,
    Probe,
    Leap,
    Done,
}

/// A leap goes at most so many steps along each axis.
const REACH: f64 = 2.5;
/// Shares of the fitted leap that are tried.
const SHARES: [f64; 2] = [1.0, 0.5];

impl Quadratic {
    /// A search with the given steps; `value` is the energy at the start, where it is known.
    pub fn new(steps: Vec<f64>, value: Option<i64>, rounds: u32) -> Self {
        let origin = vec![0.0; steps.len()];
        let mut this = Self {
            center: value.unwrap_or(i64::MAX),
            best: (origin.clone(), value.unwrap_or(i64::MAX)),
            steps,
            phase: Phase::Start,
            asked: vec![origin],
            evaluations: 0,
            rounds_left: rounds,
        };
        if value.is_some() {
            this.ask_probes();
        }
        this
    }

    /// The points whose energies are wanted next; none when the search is over.
    pub fn asks(&self) -> &[Point] {
        &self.asked
    }

    /// The best point and its energy.
    pub fn best(&self) -> (&Point, i64) {
        (&self.best.0, self.best.1)
    }

    /// Energies asked for so far.
    pub fn evaluations(&self) -> u32 {
        self.evaluations
    }

    /// Takes the energies of [`Self::asks`], in order.
    pub fn told(&mut self, values: &[i64]) {
        self.evaluations += values.len() as u32;
        let from = self.best.0.clone();
        for (point, value) in self.asked.drain(..).zip(values) {
            if *value < self.best.1 {
                self.best = (point, *value);
            }
        }
        match self.phase {
            Phase::Start => {
                self.center = self.best.1;
                self.ask_probes();
            }
            Phase::Probe => self.ask_leaps(&from, values),
            Phase::Leap => self.ask_probes(),
            Phase::Done => {}
        }
    }

    fn ask_probes(&mut self) {
        if self.rounds_left == 0 || self.steps.is_empty() {
            self.phase = Phase::Done;
            return;
        }
        self.rounds_left -= 1;
        self.center = self.best.1;
        let probe = |i: usize, sign: f64| {
            let mut p = self.best.0.clone();
            p[i] += sign * self.steps[i];
            p
        };
        self.asked = (0..self.steps.len()).flat_map(|i| [probe(i, 1.0), probe(i, -1.0)]).collect();
        self.phase = Phase::Probe;
    }

    /// Asks for the bottom of the parabolas through the probes around `from`, and adapts the steps.
    fn ask_leaps(&mut self, from: &[f64], values: &[i64]) {
        let center = self.center as f64;
        let leaps: Vec<f64> = (values.chunks_exact(2).zip(&self.steps))
            .map(|(pair, step)| step * bottom(pair[0] as f64, center, pair[1] as f64))
            .collect();
        let at = |share: f64| -> Point {
            from.iter().zip(&leaps).map(|(x, leap)| x + share * leap).collect()
        };
        // A single vertex's three parabolas are nearly independent: their leap is trusted.
        let n_shares = if from.len() <= 3 { 1 } else { SHARES.len() };
        self.asked = SHARES[..n_shares].iter().map(|share| at(*share)).collect();
        for (step, leap) in self.steps.iter_mut().zip(&leaps) {
            *step = leap.abs().clamp(0.35 * *step, *step);
        }
        self.phase = Phase::Leap;
    }
}

/// Where the parabola through (1, plus), (0, center) and (−1, minus) is lowest, within reach.
fn bottom(plus: f64, center: f64, minus: f64) -> f64 {
    let slope = 0.5 * (plus - minus);
    let bend = plus + minus - 2.0 * center;
    if bend > 0.0 {
        (-slope / bend).clamp(-REACH, REACH)
    } else if slope == 0.0 {
        0.0
    } else {
        -slope.signum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_round_finds_the_bottom_of_an_aligned_bowl() {
        let energy = |p: &[f64]| {
            (1e6 * ((p[0] - 0.7).powi(2) + 4.0 * (p[1] + 1.1).powi(2) + p[2].powi(2))) as i64
        };
        let mut search = Quadratic::new(vec![1.0, 1.0, 1.0], Some(energy(&[0.0; 3])), 1);
        while !search.asks().is_empty() {
            let values: Vec<i64> = search.asks().iter().map(|p| energy(p)).collect();
            search.told(&values);
        }
        let (at, value) = search.best();
        assert!((at[0] - 0.7).abs() < 1e-3 && (at[1] + 1.1).abs() < 1e-3, "{at:?} {value}");
        assert_eq!(search.evaluations(), 7);
    }

    #[test]
    fn a_parabola_that_bends_down_is_followed_one_step() {
        assert_eq!(bottom(-10.0, 0.0, -9.0), 1.0);
        assert_eq!(bottom(5.0, 5.0, 5.0), 0.0);
        assert_eq!(bottom(0.0, 1.0, 100.0), 50.0 / 98.0);
        assert_eq!(bottom(-1e9, 0.0, 1e9 + 1.0), REACH);
    }
}
