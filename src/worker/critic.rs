//! Judges a level by pictures that the job does not work with: the papers' off-line evaluation.

use crate::{
    compare::{self, Appearance, Look},
    jobs::spec::{self, Spec},
    mesh::Mesh,
    metric::{Metric, is_white},
};

use super::params::metric;

/// How the original and its levels are drawn: as the run-time pictures are.
pub(super) fn look(spec: &Spec, original: &Mesh) -> Look {
    let render = &spec.render;
    Look {
        shading: match render.shading {
            spec::Shading::Flat => compare::Shading::Flat,
            spec::Shading::Smooth => compare::Shading::Smooth,
        },
        appearance: if is_white(original) { Appearance::White } else { Appearance::Coloured },
        ambient: render.ambient,
        background: render.background,
        hides_back_faces: render.hide_back_faces,
        metric: match metric(render.metric) {
            // Figures of jobs that differ in what hides differences can be compared.
            Metric::Perceptual => Metric::Luminance,
            other => other,
        },
        ..Look::default()
    }
}

/// The original in 24 views of 512², anti-aliased, lit and shaded as the run-time pictures are.
pub(super) struct Critic<'m>(compare::Reference<'m>);

impl<'m> Critic<'m> {
    /// Draws the original.
    pub fn new(spec: &Spec, original: &'m Mesh) -> Self {
        let (render, look) = (&spec.render, look(spec, original));
        let params = compare::Params {
            look,
            fov_degrees: render.fov_degrees,
            light_degrees: render.light_degrees,
            stored_normals: spec.optimize.normals,
            surface: None,
        };
        Self(compare::Reference::new(original, &params))
    }

    /// d2 of a simplified mesh, percent of full scale.
    pub fn d2_percent(&self, simplified: &Mesh) -> f64 {
        self.0.compare(simplified).d2_percent
    }
}
