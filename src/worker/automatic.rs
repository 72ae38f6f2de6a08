//! What a specification leaves to the model: topology, the size of the pictures, and where image-driven
//! simplification begins. Rules are tables; `report.json` says what was chosen, and why (`chosen.rs`).

use crate::{
    io::IngestReport,
    jobs::spec::{Method, Spec, Topology},
};

/// What a specification is settled by.
pub(super) struct Model<'a> {
    /// The original, as it was read.
    pub report: &'a IngestReport,
    /// Triangles of the original.
    pub n_triangles: usize,
    /// Triangles of what some tool has simplified it to.
    pub n_simplified: Option<usize>,
}

/// Pixels along a side of a picture, at least and at most.
const SIZES: [u32; 3] = [256, 512, 1024];
/// Pixels that all run-time views have for each triangle of the finest level.
const PIXELS_PER_TRIANGLE: u64 = 870;

/// Multiples of the finest level at which the image-driven stage begins: of models of one piece without
/// textures, and of others.
const START_FACTORS: [f64; 2] = [4.0, 8.0];

impl Model<'_> {
    /// The specification with everything decided.
    pub fn settle(&self, asked: &Spec) -> Spec {
        let mut spec = asked.clone().resolved(self.n_triangles);
        if spec.topology == Topology::Auto {
            spec.topology = self.topology();
        }
        if spec.start_factor == 0.0 {
            spec.start_factor = START_FACTORS[usize::from(self.is_dressed())];
        }
        if spec.render.image_size == 0 {
            spec.render.image_size = self.image_size(&spec);
        }
        spec
    }

    fn topology(&self) -> Topology {
        if self.report.components > 1 || self.report.non_manifold_edges > 0 {
            Topology::Free
        } else {
            Topology::Preserve
        }
    }

    /// Of several parts, or with textures: geometry alone is a bad guide then.
    fn is_dressed(&self) -> bool {
        self.report.components > 1 || self.report.layers.iter().any(|l| l.contains("texture"))
    }

    /// The least size that has pixels enough.
    fn image_size(&self, spec: &Spec) -> u32 {
        if spec.method == Method::Memoryless && !spec.optimizes() {
            return SIZES[0];
        }
        let wanted = PIXELS_PER_TRIANGLE * self.finest(spec).unwrap_or(0) as u64;
        let n_views = spec.render.view_count() as u64;
        let is_enough = |size: &&u32| n_views * u64::from(**size).pow(2) >= wanted;
        *SIZES.iter().find(is_enough).unwrap_or(&SIZES[SIZES.len() - 1])
    }

    /// Triangles of the finest level, as far as they were asked for in triangles.
    pub fn finest(&self, spec: &Spec) -> Option<usize> {
        let asked = spec.triangles.iter().map(|n| (*n as usize).min(self.n_triangles)).max();
        self.n_simplified.or(asked)
    }
}

/// Why pictures are so large.
pub(super) fn why_image_size(n_finest: usize) -> String {
    format!(
        "of {SIZES:?} the least that gives each of {n_finest} triangles {PIXELS_PER_TRIANGLE} pixels in all views \
         together, or the last"
    )
}

/// Why the image-driven stage begins there.
pub(super) fn why_start_factor(model: &IngestReport) -> String {
    let [plain, dressed] = START_FACTORS;
    let n = model.components;
    format!("{plain} for one piece without textures, else {dressed}; the model has {n} parts")
}
