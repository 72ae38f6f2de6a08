//! How much work the optimization of each level is worth.
//!
//! Invariant: budgets count energy evaluations and depend on the specification and on triangles
//! alone; seconds are an additional cap that the user may set.

use crate::jobs::spec::{Effort, Method, Spec};

/// Evaluations for each triangle of a level, where the user set no limit.
///
/// Measured with `benches/optimizer.rs`; `docs/results.md` has the curves.
const PER_TRIANGLE: [(Effort, u64); 3] =
    [(Effort::Fast, 40), (Effort::Balanced, 200), (Effort::Best, 1000)];

/// Limits of the optimization of one level.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Budget {
    /// Evaluations; `None` means no limit.
    pub evaluations: Option<u64>,
    /// Seconds; `None` means no limit.
    pub secs: Option<f64>,
    /// Share of the energy at the start.
    pub until: Option<f64>,
}

impl Budget {
    /// Whether nothing is to be done.
    pub fn is_nothing(&self) -> bool {
        self.evaluations == Some(0) || self.secs == Some(0.0)
    }
}

/// The budgets of levels with so many triangles. `n_spent` evaluations of the job are spent already.
pub(super) fn budgets(spec: &Spec, triangles: &[usize], n_spent: u64) -> Vec<Budget> {
    let total = n_optimized(spec, triangles);
    let share = |n: usize| n_optimized(spec, &[n]) as f64 / total.max(1) as f64;
    let left = (spec.max_evaluations > 0).then(|| spec.max_evaluations.saturating_sub(n_spent));
    let wanted = evaluations(spec, total);
    let all = match (wanted, left) {
        (Some(wanted), Some(left)) => Some(wanted.min(left)),
        (wanted, left) => wanted.or(left),
    };
    let of = |n: &usize| Budget {
        evaluations: all.map(|all| (all as f64 * share(*n)) as u64),
        secs: spec.optimize.max_secs.map(|secs| secs * share(*n)),
        until: spec.optimize.until,
    };
    triangles.iter().map(of).collect()
}

/// Triangles of those levels that are optimized. Where nobody asked for it, those that were left to geometry because
/// they are finer than pictures show are not: a few pictures would be fitted instead of the model.
pub(super) fn n_optimized(spec: &Spec, triangles: &[usize]) -> usize {
    let is_asked = !spec.optimize.is_automatic() || spec.simplified.is_some();
    let finest = spec.triangles.iter().max().map_or(0.0, |n| f64::from(*n));
    let is_some_left = spec.start_factor > 0.0 && spec.start_factor < 1.0;
    let most_shown = if is_some_left { spec.start_factor * finest } else { f64::INFINITY };
    triangles.iter().filter(|n| is_asked || **n as f64 <= most_shown.ceil()).sum()
}

/// Evaluations for so many triangles; `None` means no limit.
pub(super) fn evaluations(spec: &Spec, triangles: usize) -> Option<u64> {
    if !spec.optimizes() {
        return Some(0);
    }
    if !spec.optimize.is_automatic() {
        return spec.optimize.max_evaluations;
    }
    let row = PER_TRIANGLE.iter().find(|row| row.0 == spec.effort);
    Some(row.map_or(0, |row| row.1) * triangles as u64)
}

impl Spec {
    /// Whether the job optimizes its levels. Someone who asks for geometry alone, and says nothing
    /// of optimization, gets geometry alone.
    pub(super) fn optimizes(&self) -> bool {
        let is_plain = self.method == Method::Memoryless && self.simplified.is_none();
        !(self.optimize.is_off() || is_plain && self.optimize.is_automatic())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::spec::Optimize;

    fn spec(optimize: Optimize) -> Spec {
        Spec { optimize, ..Spec::new(vec![1000, 100]) }
    }

    fn evaluations_of(spec: &Spec, n_spent: u64) -> Vec<Option<u64>> {
        budgets(spec, &[900, 100], n_spent).into_iter().map(|b| b.evaluations).collect()
    }

    #[test]
    fn a_budget_is_shared_by_triangles() {
        let n = |max| Optimize { max_evaluations: Some(max), ..Optimize::default() };
        assert_eq!(evaluations_of(&spec(n(5000)), 0), [Some(4500), Some(500)]);
        let capped = Spec { max_evaluations: 3000, ..spec(n(5000)) };
        assert_eq!(evaluations_of(&capped, 1000), [Some(1800), Some(200)]);
        assert!(budgets(&spec(n(0)), &[900, 100], 0).iter().all(Budget::is_nothing));
    }

    #[test]
    fn a_limit_of_another_kind_lifts_the_automatic_one() {
        let until = Optimize { until: Some(0.5), ..Optimize::default() };
        assert_eq!(evaluations_of(&spec(until), 0), [None, None]);
        let secs = Optimize { max_secs: Some(10.0), ..Optimize::default() };
        let found = budgets(&spec(secs), &[900, 100], 0);
        assert_eq!((found[0].evaluations, found[0].secs), (None, Some(9.0)));
    }

    #[test]
    fn without_a_word_it_grows_with_triangles_unless_geometry_was_asked_for() {
        let automatic = spec(Optimize::default());
        let found = evaluations_of(&automatic, 0);
        assert!(found[0] > Some(100 * 900) && found[1] == found[0].map(|n| n / 9));
        // What was left to geometry stays so; the other level gets no more for it.
        let finer = Spec { start_factor: 0.5, ..automatic.clone() };
        assert_eq!(evaluations_of(&finer, 0), [Some(0), found[1]]);
        let memoryless = Spec { method: Method::Memoryless, ..automatic };
        assert_eq!(evaluations_of(&memoryless, 0), [Some(0), Some(0)]);
    }
}
