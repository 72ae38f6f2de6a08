//! The flags that say how levels are optimized.

use clap::Args;
use lookalike::jobs::spec::{Optimize, Solver};

use super::job_args::word;

/// Image-driven optimization.
#[derive(Args, Clone, Debug)]
pub(crate) struct OptimizeArgs {
    /// Optimize the levels with this many energy evaluations in all; 0 turns optimization off.
    /// Default: as many as the effort and the triangles call for.
    #[arg(long = "optimize-evaluations", value_name = "N")]
    evaluations: Option<u64>,
    /// Optimize the levels for this many seconds in all; 0 turns optimization off.
    #[arg(long = "optimize-seconds", value_name = "SECS")]
    seconds: Option<f64>,
    /// Optimize each level until its energy has fallen to this share of its start, 0 to 1.
    #[arg(long = "optimize-until", value_name = "RATIO")]
    until: Option<f64>,
    /// First steps of a search, as a share of the mean length of a vertex's edges.
    #[arg(
        long = "optimize-delta",
        default_value_t = Optimize::default().delta,
        value_name = "DELTA"
    )]
    delta: f64,
    /// How places are searched: parabolas along a vertex's axes, or downhill simplex.
    #[arg(
        long = "optimize-solver",
        default_value = "quadratic",
        value_parser = word::<Solver>(&["quadratic", "simplex"])
    )]
    solver: Solver,
    /// Find vertex normals too; needs --shading smooth.
    #[arg(long = "optimize-normals")]
    normals: bool,
    /// Leave texture coordinates and vertex colours as simplification does.
    #[arg(long)]
    keep_attributes: bool,
}

impl OptimizeArgs {
    /// The same as a part of a specification.
    pub(crate) fn optimize(self) -> Optimize {
        Optimize {
            max_evaluations: self.evaluations,
            max_secs: self.seconds,
            until: self.until,
            delta: self.delta,
            solver: self.solver,
            normals: self.normals,
            keep_attributes: self.keep_attributes,
        }
    }
}
