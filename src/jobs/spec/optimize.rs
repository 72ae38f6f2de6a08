//! The part of a specification that is about image-driven optimization.

use serde::{Deserialize, Serialize};

use super::{Fault, range};

/// How places of vertices are searched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Solver {
    /// Parabolas along each vertex's normal and two tangents.
    #[default]
    Quadratic,
    /// Downhill simplex, as in the paper.
    Simplex,
}

/// Image-driven optimization of each level once it is simplified.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Optimize {
    /// Energy evaluations for all levels together; 0 turns optimization off. Absent: as many as
    /// the method, the effort and the triangles call for, or no limit where `max_secs` or `until`
    /// sets one.
    pub max_evaluations: Option<u64>,
    /// Seconds for all levels together; 0 turns optimization off. Absent: no limit.
    pub max_secs: Option<f64>,
    /// A level is done when its energy has fallen to this share of its start, 0 to 1. Absent: never.
    pub until: Option<f64>,
    /// First steps of a search, as a share of the mean length of a vertex's edges, 0.001 to 2.
    pub delta: f64,
    /// The search.
    pub solver: Solver,
    /// Vertex normals are found too; needs smooth shading.
    pub normals: bool,
    /// Texture coordinates and vertex colours stay as simplification leaves them; else they are found too.
    pub keep_attributes: bool,
}

impl Default for Optimize {
    fn default() -> Self {
        Self {
            max_evaluations: None,
            max_secs: None,
            until: None,
            delta: 0.1,
            solver: Solver::default(),
            normals: false,
            keep_attributes: false,
        }
    }
}

impl Optimize {
    /// Whether it is turned off.
    pub fn is_off(&self) -> bool {
        self.max_evaluations == Some(0) || self.max_secs == Some(0.0)
    }

    /// Whether the budget was left to us.
    pub fn is_automatic(&self) -> bool {
        self.max_evaluations.is_none() && self.max_secs.is_none() && self.until.is_none()
    }

    pub(super) fn validate(&self, is_smooth: bool, faults: &mut Vec<Fault>) {
        if let Some(secs) = self.max_secs {
            range(faults, "optimize.max_secs", secs, 0.0, 1e9);
        }
        if let Some(until) = self.until {
            range(faults, "optimize.until", until, 0.0, 1.0);
        }
        range(faults, "optimize.delta", self.delta, 0.001, 2.0);
        if self.normals && !is_smooth {
            let text = "normals are not seen in flat shading: use smooth shading".into();
            faults.push(Fault { field: "optimize.normals".into(), text });
        }
    }
}
