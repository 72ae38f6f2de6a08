//! The flags that say how levels are optimized.

use clap::Args;
use lookalike::jobs::spec::{Optimize, Solver};

use super::job_args::word;

/// Image-driven optimization.
#[derive(Args, Clone, Debug)]
pub(crate) struct OptimizeArgs {
    /// Optimize the levels with this many energy evaluations in all; 0 turns optimization off.
    /// Default: as many as the effort and the triangles call for.
    #[arg(long, value_name = "N")]
    optimize_evaluations: Option<u64>,
    /// Optimize the levels for this many seconds in all; 0 turns optimization off.
    #[arg(long, value_name = "SECS")]
    optimize_seconds: Option<f64>,
    /// Optimize each level until its energy has fallen to this share of its start, 0 to 1.
    #[arg(long, value_name = "RATIO")]
    optimize_until: Option<f64>,
    /// First steps of a search, as a share of the mean length of a vertex's edges.
    #[arg(long, default_value_t = Optimize::default().delta, value_name = "DELTA")]
    optimize_delta: f64,
    /// How places are searched: parabolas along a vertex's axes, or downhill simplex.
    #[arg(
        long,
        default_value = "quadratic",
        value_parser = word::<Solver>(&["quadratic", "simplex"])
    )]
    optimize_solver: Solver,
    /// Find vertex normals too; needs --shading smooth.
    #[arg(long)]
    optimize_normals: bool,
}

impl OptimizeArgs {
    /// The same as a part of a specification.
    pub(crate) fn optimize(self) -> Optimize {
        Optimize {
            max_evaluations: self.optimize_evaluations,
            max_secs: self.optimize_seconds,
            until: self.optimize_until,
            delta: self.optimize_delta,
            solver: self.optimize_solver,
            normals: self.optimize_normals,
        }
    }
}
