//! Draws the original ahead of need, on a thread of its own: memoryless simplification leaves all cores but
//! one idle, and the image-driven stage some of them.
//!
//! Invariant: what is drawn does not depend on who draws it or when. [`Studio`](super::studio::Studio) draws
//! what it lacks.

use std::{
    sync::{
        OnceLock,
        mpsc::{Receiver, channel},
    },
    thread::Scope,
};

use crate::{
    jobs::spec::{Method, Spec},
    mesh::Mesh,
    metric::{Pictures, ViewSet, bounding_sphere},
};

use super::{budget::Budget, critic::Critic, params};

/// What a job will most likely want to see.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Plan {
    /// View sets, the run-time views among them.
    n_sets: usize,
    /// The unseen views too.
    unseen: bool,
}

impl Plan {
    /// Of a job whose coarsest level has so many triangles.
    pub fn new(spec: &Spec, n_coarsest: usize) -> Self {
        let unseen = spec.optimizes();
        let budget = Budget { until: spec.optimize.until, ..Budget::default() };
        let n_sets = match (unseen, spec.method) {
            (true, _) => params::n_view_sets(spec, &budget, n_coarsest),
            (false, Method::Image) => 1,
            (false, Method::Memoryless | Method::Cluster) => 0,
        };
        Self { n_sets, unseen }
    }
}

/// Starts to draw: view sets in order, then the unseen views. Ends early where nobody waits any more.
pub(super) fn draw_ahead<'scope, 'm: 'scope>(
    scope: &'scope Scope<'scope, '_>,
    plan: Plan,
    (spec, original): (&'m Spec, &'m Mesh),
    pictures: Pictures,
    critic: &'m OnceLock<Critic<'m>>,
) -> Receiver<ViewSet> {
    let (sets, drawn) = channel();
    scope.spawn(move || {
        let center = bounding_sphere(original).center;
        for turn in 0..plan.n_sets as u64 {
            if sets.send(ViewSet::turned(original, &pictures, center, turn)).is_err() {
                return;
            }
        }
        if plan.unseen {
            critic.get_or_init(|| Critic::new(spec, original));
        }
    });
    drawn
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::spec::Optimize;

    fn plan(n_coarsest: usize, change: impl FnOnce(&mut Spec)) -> (usize, bool) {
        let mut spec = Spec::new(vec![8000, n_coarsest as u32]);
        spec.render.image_size = 256;
        change(&mut spec);
        let plan = Plan::new(&spec, n_coarsest);
        (plan.n_sets, plan.unseen)
    }

    #[test]
    fn a_job_is_shown_what_it_will_use() {
        let off = Optimize { max_evaluations: Some(0), ..Optimize::default() };
        let (n_sets, unseen) = plan(500, |_| ());
        assert!(n_sets > 1 && unseen);
        // Of so many triangles, all but the run-time views only judge.
        assert!((2..n_sets).contains(&plan(8000, |_| ()).0));
        assert_eq!(plan(500, |s| s.optimize = off.clone()), (1, false));
        assert_eq!(plan(500, |s| (s.optimize, s.method) = (off, Method::Memoryless)), (0, false));
    }
}
