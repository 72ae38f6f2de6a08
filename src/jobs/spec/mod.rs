//! What a job is asked to do: plain data, validated as a whole, stored as JSON.

mod evaluate;
mod levels;
mod optimize;
mod output;

use serde::{Deserialize, Serialize};

pub use evaluate::Evaluate;
pub use levels::LevelBudget;
pub use optimize::{Optimize, Solver};
pub use output::Output;

/// How the levels are made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Memoryless to `start_factor` times the largest target, then image-driven.
    #[default]
    Image,
    /// Memoryless (geometric) all the way.
    Memoryless,
    /// Vertex clustering, crude and fast: one level.
    Cluster,
}

/// How much work the image-driven stage spends on each collapse.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Effort {
    /// Lazy queue.
    Fast,
    /// More evaluations and placements per collapse.
    #[default]
    Balanced,
    /// Eager queue, every placement.
    Best,
}

/// Surface shading of the pictures.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shading {
    /// One shade a triangle.
    #[default]
    Flat,
    /// Gouraud.
    Smooth,
}

/// Camera projection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Projection {
    /// Perspective, as in the paper.
    #[default]
    Perspective,
    /// Parallel.
    Orthographic,
}

/// Whether the surface keeps its topology.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Topology {
    /// Free where the model has several parts or edges of more than two triangles, preserved where it
    /// is one piece.
    #[default]
    Auto,
    /// Parts stay parts, holes stay holes: a level may end above its target where no collapse
    /// keeps them.
    Preserve,
    /// Any edge may go: handles close, small parts vanish, targets are reached.
    Free,
}

/// By what pictures are compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Metric {
    /// Squared differences of luminances.
    #[default]
    Luminance,
    /// Squared differences of red, green and blue.
    Rgb,
    /// Squared differences of luminances, less where the original is busy.
    Perceptual,
}

impl Metric {
    /// Whether it is the one that specifications need not name.
    pub fn is_luminance(&self) -> bool {
        *self == Self::Luminance
    }
}

/// Edges whose vertices stay where they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Lock {
    /// Edges that have not exactly two triangles.
    Border,
    /// Edges across which the material, texture coordinates or colours change abruptly.
    Seam,
    /// Edges at which the surface turns by `hard_edge_degrees` or more.
    HardEdge,
}

/// Run-time pictures: views, size, light.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Render {
    /// Number of views: 4, 6, 8, 12, 20 or 24; ignored when `custom_views` is given.
    pub n_views: u32,
    /// Directions from the model's centre to the eyes (any length but 0), instead of `n_views`.
    pub custom_views: Vec<[f64; 3]>,
    /// Pixels along each side, 64 to 1024, a multiple of 8; 0: as the finest level needs.
    pub image_size: u32,
    /// Full field of view in degrees (perspective only), 5 to 120.
    pub fov_degrees: f64,
    /// Perspective or orthographic.
    pub projection: Projection,
    /// Background grey, 0 to 1.
    pub background: f64,
    /// Ambient light, 0 to 1; diffuse is 1 − ambient.
    pub ambient: f64,
    /// Angle between view and light direction in degrees, 0 to 90.
    pub light_degrees: f64,
    /// Flat or smooth.
    pub shading: Shading,
    /// How many of the views cull front faces, so that they see the interior.
    pub interior_views: u32,
    /// The other views cull back faces of single-sided materials.
    pub hide_back_faces: bool,
    /// How much each view counts, 0 to 16, one weight a view; empty: all the same.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub view_weights: Vec<u32>,
    /// By what pictures are compared.
    #[serde(skip_serializing_if = "Metric::is_luminance")]
    pub metric: Metric,
}

impl Default for Render {
    fn default() -> Self {
        Self {
            n_views: 20,
            custom_views: Vec::new(),
            image_size: 0,
            fov_degrees: 60.0,
            projection: Projection::Perspective,
            background: 0.5,
            ambient: 0.1,
            light_degrees: 10.0,
            shading: Shading::Flat,
            interior_views: 0,
            hide_back_faces: false,
            view_weights: Vec::new(),
            metric: Metric::Luminance,
        }
    }
}

/// A stored model, named by a specification.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// BLAKE3 of its bytes, lower-case hexadecimal.
    pub mesh: String,
    /// Its file name; the extension gives the format.
    pub file_name: String,
}

/// What a job does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Makes levels of detail.
    Simplify,
    /// Makes a mesh that some tool has simplified look more like the original.
    Optimize,
    /// Tells how much such a mesh looks like the original.
    Evaluate,
}

impl Kind {
    /// Its name on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Simplify => "simplify",
            Self::Optimize => "optimize",
            Self::Evaluate => "evaluate",
        }
    }
}

/// A whole job: simplification of the original to levels, each then optimized; or, where
/// `simplified` is given, optimization of that mesh alone; or, where `evaluate` is given too, nothing but a
/// comparison of the two.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spec {
    /// Triangles of each level of detail, in the order the caller wants them back; 0: this level has
    /// no such budget. Levels go as far as all their budgets allow ([`LevelBudget`]).
    #[serde(default)]
    pub triangles: Vec<u32>,
    /// The same as shares of the original's triangles, below 1.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ratios: Vec<f64>,
    /// Each level goes no further than to so much of d2 on the run-time views, in percent of full
    /// scale; one value is for all levels, 0 means none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub max_d2: Vec<f64>,
    /// Each level may stand in for the original where the bounding sphere is so many pixels high on
    /// the screen; one value is for all levels, 0 means none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub screen_size: Vec<f64>,
    /// The GLB file of each level has at most so many bytes; one value is for all levels, 0 means none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub max_bytes: Vec<u64>,
    /// A mesh that some tool has simplified the original to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub simplified: Option<Input>,
    /// It is compared with the original, and nothing else is done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evaluate: Option<Evaluate>,
    /// Image-driven or memoryless.
    #[serde(default)]
    pub method: Method,
    /// How hard to try.
    #[serde(default)]
    pub effort: Effort,
    /// Whether collapses must keep the topology.
    #[serde(default)]
    pub topology: Topology,
    /// The image-driven stage starts at this multiple of the largest target, 1 to 1000; 0: as the model needs.
    #[serde(default)]
    pub start_factor: f64,
    /// Weight of the surface against the boundary in the memoryless cost, 0 to 1.
    #[serde(default = "default_lambda")]
    pub lambda: f64,
    /// Edges whose vertices no stage moves or removes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lock: Vec<Lock>,
    /// Where the surface turns by so much or more, an edge is hard; degrees, 1 to 180.
    #[serde(default = "default_hard_edge_degrees")]
    pub hard_edge_degrees: f64,
    /// The run-time pictures.
    #[serde(default)]
    pub render: Render,
    /// What is done to each level once it is simplified.
    #[serde(default)]
    pub optimize: Optimize,
    /// How levels are written.
    #[serde(default, skip_serializing_if = "Output::is_plain")]
    pub output: Output,
    /// Upper bound on energy evaluations of the whole job; 0 means none.
    #[serde(default)]
    pub max_evaluations: u64,
    /// Additional wall-clock cap in seconds; 0 means none.
    #[serde(default)]
    pub max_secs: f64,
    /// Seed of everything random.
    #[serde(default)]
    pub seed: u64,
}

fn default_lambda() -> f64 {
    0.5
}
fn default_hard_edge_degrees() -> f64 {
    60.0
}

impl Spec {
    /// The default job with the given levels.
    pub fn new(triangles: Vec<u32>) -> Self {
        Self {
            triangles,
            ratios: Vec::new(),
            max_d2: Vec::new(),
            screen_size: Vec::new(),
            max_bytes: Vec::new(),
            simplified: None,
            evaluate: None,
            method: Method::default(),
            effort: Effort::default(),
            topology: Topology::default(),
            start_factor: 0.0,
            lambda: default_lambda(),
            lock: Vec::new(),
            hard_edge_degrees: default_hard_edge_degrees(),
            render: Render::default(),
            optimize: Optimize::default(),
            output: Output::default(),
            max_evaluations: 0,
            max_secs: 0.0,
            seed: 0,
        }
    }
}

/// One thing wrong with a specification or a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// Path of the field, such as `render.image_size` or `triangles[1]`.
    pub field: String,
    /// What is wrong and what is allowed.
    pub text: String,
}

/// Most levels of detail of one job.
pub const MAX_LEVELS: usize = 64;
/// Greatest weight of a view.
pub const MAX_VIEW_WEIGHT: u32 = 16;
/// Most custom views of one job.
pub const MAX_VIEWS: usize = 64;
const VIEW_COUNTS: [u32; 6] = [4, 6, 8, 12, 20, 24];

impl Spec {
    /// The job that optimizes what some tool has simplified the original to.
    pub fn optimizing(simplified: Input) -> Self {
        Self { simplified: Some(simplified), ..Self::new(Vec::new()) }
    }

    /// The job that compares it with the original.
    pub fn evaluating(simplified: Input, evaluate: Evaluate) -> Self {
        Self { evaluate: Some(evaluate), ..Self::optimizing(simplified) }
    }

    /// What the job does.
    pub fn kind(&self) -> Kind {
        match (&self.evaluate, &self.simplified) {
            (Some(_), _) => Kind::Evaluate,
            (None, Some(_)) => Kind::Optimize,
            (None, None) => Kind::Simplify,
        }
    }

    /// Every fault of the specification; empty when it can run.
    pub fn validate(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        match self.kind() {
            Kind::Evaluate => {
                self.validate_evaluation(&mut faults);
                return faults;
            }
            Kind::Optimize => self.validate_given(&mut faults),
            Kind::Simplify => self.validate_levels(&mut faults),
        }
        if self.start_factor != 0.0 {
            range(&mut faults, "start_factor", self.start_factor, 1.0, 1000.0);
        }
        range(&mut faults, "lambda", self.lambda, 0.0, 1.0);
        range(&mut faults, "max_secs", self.max_secs, 0.0, 1e9);
        range(&mut faults, "hard_edge_degrees", self.hard_edge_degrees, 1.0, 180.0);
        self.validate_lock(&mut faults);
        self.render.validate(&mut faults);
        self.optimize.validate(self.render.shading == Shading::Smooth, &mut faults);
        faults
    }

    /// Of a mesh that is simplified already.
    fn validate_given(&self, faults: &mut Vec<Fault>) {
        let kept = "a mesh that is simplified already keeps its triangles: leave this out";
        let off = "0 turns off all that this job would do: ask for more, or leave it out";
        let rules = [
            ("triangles", !self.triangles.is_empty(), kept),
            ("ratios", !self.ratios.is_empty(), kept),
            ("max_d2", !self.max_d2.is_empty(), kept),
            ("screen_size", !self.screen_size.is_empty(), kept),
            ("max_bytes", !self.max_bytes.is_empty(), kept),
            ("optimize", self.optimize.is_off(), off),
        ];
        let broken = rules.into_iter().filter(|(_, is_broken, _)| *is_broken);
        faults.extend(
            broken.map(|(field, _, text)| Fault { field: field.into(), text: text.into() }),
        );
    }

    fn validate_lock(&self, faults: &mut Vec<Fault>) {
        if !self.lock.is_empty() && self.simplified.is_none() && self.method == Method::Cluster {
            let text = "vertex clustering keeps no vertex for certain: leave this out, or simplify otherwise";
            faults.push(Fault { field: "lock".into(), text: text.into() });
        }
    }
}

impl Render {
    /// How many pictures are taken.
    pub fn view_count(&self) -> usize {
        if self.custom_views.is_empty() { self.n_views as usize } else { self.custom_views.len() }
    }

    fn validate(&self, faults: &mut Vec<Fault>) {
        let mut fault = |field: &str, text: String| {
            faults.push(Fault { field: format!("render.{field}"), text });
        };
        if self.custom_views.is_empty() && !VIEW_COUNTS.contains(&self.n_views) {
            fault("n_views", format!("{} views: use 4, 6, 8, 12, 20 or 24", self.n_views));
        }
        if self.custom_views.len() > MAX_VIEWS {
            let n_views = self.custom_views.len();
            fault("custom_views", format!("{n_views} views: at most {MAX_VIEWS} are allowed"));
        }
        for (i, view) in self.custom_views.iter().enumerate().take(MAX_VIEWS) {
            let square = view.iter().map(|c| c * c).sum::<f64>();
            if !square.is_normal() {
                let text = format!("{view:?} is not a direction: use a length of 1e-150 to 1e150");
                fault(&format!("custom_views[{i}]"), text);
            }
        }
        let is_size = (64..=1024).contains(&self.image_size) && self.image_size.is_multiple_of(8);
        if self.image_size != 0 && !is_size {
            let size = self.image_size;
            let text = format!("{size} pixels: use 64 to 1024, a multiple of 8, or leave it out");
            fault("image_size", text);
        }
        if self.interior_views as usize > self.view_count() {
            let text = format!(
                "{} interior views of {}: at most all of them can be interior",
                self.interior_views,
                self.view_count()
            );
            fault("interior_views", text);
        }
        self.validate_weights(faults);
        range(faults, "render.fov_degrees", self.fov_degrees, 5.0, 120.0);
        range(faults, "render.background", self.background, 0.0, 1.0);
        range(faults, "render.ambient", self.ambient, 0.0, 1.0);
        range(faults, "render.light_degrees", self.light_degrees, 0.0, 90.0);
    }
}

impl Render {
    fn validate_weights(&self, faults: &mut Vec<Fault>) {
        let weights = &self.view_weights;
        let mut fault = |field: String, text: String| faults.push(Fault { field, text });
        for (i, weight) in weights.iter().enumerate().filter(|(_, w)| **w > MAX_VIEW_WEIGHT) {
            let text = format!("{weight}: use 0 to {MAX_VIEW_WEIGHT}");
            fault(format!("render.view_weights[{i}]"), text);
        }
        let (n_weights, n_views) = (weights.len(), self.view_count());
        if n_weights > 0 && n_weights != n_views {
            let text = format!("{n_weights} weights for {n_views} views: give one a view");
            fault("render.view_weights".into(), text);
        } else if n_weights > 0 && weights.iter().all(|w| *w == 0) {
            let text = "no view counts anything: give one a weight above 0".to_owned();
            fault("render.view_weights".into(), text);
        }
    }
}

/// Not a number is outside every range.
fn range(faults: &mut Vec<Fault>, field: &str, value: f64, low: f64, high: f64) {
    if !(low..=high).contains(&value) {
        faults.push(Fault { field: field.into(), text: format!("{value}: use {low} to {high}") });
    }
}

#[cfg(test)]
mod tests;
