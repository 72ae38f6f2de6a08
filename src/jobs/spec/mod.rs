//! What a job is asked to do: plain data, validated as a whole, stored as JSON.

mod optimize;
mod output;

use serde::{Deserialize, Serialize};

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

/// Run-time pictures: views, size, light.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Render {
    /// Number of views: 4, 6, 8, 12, 20 or 24; ignored when `custom_views` is given.
    pub n_views: u32,
    /// Directions from the model's centre to the eyes (any length but 0), instead of `n_views`.
    pub custom_views: Vec<[f64; 3]>,
    /// Pixels along each side, 64 to 1024, a multiple of 8.
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
}

impl Default for Render {
    fn default() -> Self {
        Self {
            n_views: 20,
            custom_views: Vec::new(),
            image_size: 256,
            fov_degrees: 60.0,
            projection: Projection::Perspective,
            background: 0.5,
            ambient: 0.1,
            light_degrees: 10.0,
            shading: Shading::Flat,
            interior_views: 0,
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

/// A whole job: simplification of the original to levels, each then optimized; or, where
/// `simplified` is given, optimization of that mesh alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spec {
    /// Triangles of each level of detail, in the order the caller wants them back; none where
    /// `ratios` or `simplified` is given.
    #[serde(default)]
    pub triangles: Vec<u32>,
    /// The same as shares of the original's triangles, each above 0 and below 1.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ratios: Vec<f64>,
    /// A mesh that some tool has simplified the original to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub simplified: Option<Input>,
    /// Image-driven or memoryless.
    #[serde(default)]
    pub method: Method,
    /// How hard to try.
    #[serde(default)]
    pub effort: Effort,
    /// Whether collapses must keep the topology.
    #[serde(default)]
    pub topology: Topology,
    /// The image-driven stage starts at this multiple of the largest target.
    #[serde(default = "default_start_factor")]
    pub start_factor: f64,
    /// Weight of the surface against the boundary in the memoryless cost, 0 to 1.
    #[serde(default = "default_lambda")]
    pub lambda: f64,
    /// The image-driven stage ends before a collapse that would lift d2 on the run-time views, in
    /// percent of full scale, above this; 0 means none.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub max_d2: f64,
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

fn is_zero(x: &f64) -> bool {
    *x == 0.0
}
fn default_start_factor() -> f64 {
    4.0
}
fn default_lambda() -> f64 {
    0.5
}

impl Spec {
    /// The default job with the given levels.
    pub fn new(triangles: Vec<u32>) -> Self {
        Self {
            triangles,
            ratios: Vec::new(),
            simplified: None,
            method: Method::default(),
            effort: Effort::default(),
            topology: Topology::default(),
            start_factor: default_start_factor(),
            lambda: default_lambda(),
            max_d2: 0.0,
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
/// Most custom views of one job.
pub const MAX_VIEWS: usize = 64;
const VIEW_COUNTS: [u32; 6] = [4, 6, 8, 12, 20, 24];

impl Spec {
    /// The job that optimizes what some tool has simplified the original to.
    pub fn optimizing(simplified: Input) -> Self {
        Self { simplified: Some(simplified), ..Self::new(Vec::new()) }
    }

    /// How many levels the job makes.
    pub fn n_levels(&self) -> usize {
        if self.simplified.is_some() { 1 } else { self.triangles.len().max(self.ratios.len()) }
    }

    /// The same job with numbers of triangles in place of shares of so many, which the original has.
    #[must_use]
    pub fn resolved(mut self, n_original: usize) -> Self {
        let count = |ratio: f64| (ratio * n_original as f64).round().max(1.0) as u32;
        self.triangles.extend(self.ratios.drain(..).map(count));
        self
    }

    /// Every fault of the specification; empty when it can run.
    pub fn validate(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        match self.simplified {
            Some(_) => self.validate_given(&mut faults),
            None => self.validate_levels(&mut faults),
        }
        range(&mut faults, "start_factor", self.start_factor, 1.0, 1000.0);
        range(&mut faults, "lambda", self.lambda, 0.0, 1.0);
        range(&mut faults, "max_secs", self.max_secs, 0.0, 1e9);
        range(&mut faults, "max_d2", self.max_d2, 0.0, 100.0);
        self.validate_max_d2(&mut faults);
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
            ("optimize", self.optimize.is_off(), off),
        ];
        let broken = rules.into_iter().filter(|(_, is_broken, _)| *is_broken);
        faults.extend(
            broken.map(|(field, _, text)| Fault { field: field.into(), text: text.into() }),
        );
    }

    /// Whether there is a stage that knows of d2.
    fn validate_max_d2(&self, faults: &mut Vec<Fault>) {
        let text = match (&self.simplified, self.method) {
            (Some(_), _) => "a mesh that is simplified already keeps its triangles: leave this out",
            (None, Method::Memoryless | Method::Cluster) => {
                "only image-driven simplification looks at pictures: leave this out, or ask for that"
            }
            (None, Method::Image) => return,
        };
        if self.max_d2 > 0.0 {
            faults.push(Fault { field: "max_d2".into(), text: text.into() });
        }
    }

    fn validate_levels(&self, faults: &mut Vec<Fault>) {
        let levels = self.n_levels();
        let field = if self.ratios.is_empty() { "triangles" } else { "ratios" };
        let mut fault = |field: &str, text: String| {
            faults.push(Fault { field: field.into(), text });
        };
        if !self.ratios.is_empty() && !self.triangles.is_empty() {
            let text = "numbers of triangles are given too: leave one of the two out";
            fault(field, text.into());
        }
        if levels == 0 || levels > MAX_LEVELS {
            fault(field, format!("{levels} levels of detail: ask for 1 to {MAX_LEVELS}"));
        } else if self.method == Method::Cluster && levels > 1 {
            let text = format!("{levels} levels: vertex clustering makes one, so ask for one");
            fault(field, text);
        }
        for (i, _) in self.triangles.iter().enumerate().filter(|(_, n)| **n == 0) {
            let text = "0 triangles is not a level of detail: ask for at least 1".into();
            fault(&format!("triangles[{i}]"), text);
        }
        for (i, ratio) in self.ratios.iter().enumerate() {
            if !(*ratio > 0.0 && *ratio < 1.0) {
                let text = format!("{ratio} of the triangles: use a share above 0 and below 1");
                fault(&format!("ratios[{i}]"), text);
            }
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
        for (i, view) in self.custom_views.iter().enumerate() {
            let square = view.iter().map(|c| c * c).sum::<f64>();
            if !square.is_normal() {
                let text = format!("{view:?} is not a direction: use a length of 1e-150 to 1e150");
                fault(&format!("custom_views[{i}]"), text);
            }
        }
        if !(64..=1024).contains(&self.image_size) || !self.image_size.is_multiple_of(8) {
            let text = format!("{} pixels: use 64 to 1024, a multiple of 8", self.image_size);
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
        range(faults, "render.fov_degrees", self.fov_degrees, 5.0, 120.0);
        range(faults, "render.background", self.background, 0.0, 1.0);
        range(faults, "render.ambient", self.ambient, 0.0, 1.0);
        range(faults, "render.light_degrees", self.light_degrees, 0.0, 90.0);
    }
}

/// Not a number is outside every range.
fn range(faults: &mut Vec<Fault>, field: &str, value: f64, low: f64, high: f64) {
    if !(low..=high).contains(&value) {
        faults.push(Fault { field: field.into(), text: format!("{value}: use {low} to {high}") });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fields(spec: &Spec) -> Vec<String> {
        spec.validate().into_iter().map(|fault| fault.field).collect()
    }

    #[test]
    fn the_default_job_is_sound() {
        assert_eq!(Spec::new(vec![500, 100]).validate(), []);
        let read: Spec = serde_json::from_str(r#"{"triangles": [500, 100]}"#).unwrap();
        assert_eq!(read, Spec::new(vec![500, 100]));
    }

    #[test]
    fn every_fault_is_listed_at_once() {
        let mut spec = Spec::new(vec![10, 0]);
        spec.start_factor = 0.5;
        spec.lambda = f64::NAN;
        spec.max_secs = f64::INFINITY;
        spec.render.n_views = 7;
        spec.render.image_size = 100;
        spec.render.interior_views = 8;
        spec.render.background = -0.1;
        let wanted = [
            "triangles[1]",
            "start_factor",
            "lambda",
            "max_secs",
            "render.n_views",
            "render.image_size",
            "render.interior_views",
            "render.background",
        ];
        assert_eq!(fields(&spec), wanted);
    }

    #[test]
    fn levels_are_numbers_or_shares_of_triangles() {
        let mut spec = Spec { ratios: vec![0.25, 1e-9], ..Spec::new(Vec::new()) };
        assert_eq!((spec.validate(), spec.n_levels()), (vec![], 2));
        let read: Spec = serde_json::from_str(r#"{"ratios": [0.25, 1e-9]}"#).unwrap();
        assert_eq!(read, spec);
        assert_eq!(read.resolved(1002), Spec::new(vec![251, 1]));
        spec.triangles = vec![7];
        spec.ratios.extend([0.0, 1.0, f64::NAN]);
        assert_eq!(fields(&spec), ["ratios", "ratios[2]", "ratios[3]", "ratios[4]"]);
        assert_eq!(fields(&Spec::new(Vec::new())), ["triangles"]);
    }

    #[test]
    fn d2_is_for_those_who_look_at_pictures() {
        let mut spec = Spec { max_d2: 2.5, ..Spec::new(vec![10]) };
        assert_eq!(spec.validate(), []);
        for method in [Method::Memoryless, Method::Cluster] {
            spec.method = method;
            assert_eq!(fields(&spec), ["max_d2"]);
        }
        spec = Spec { max_d2: f64::NAN, ..Spec::new(vec![10]) };
        assert_eq!(fields(&spec), ["max_d2"]);
    }

    #[test]
    fn custom_views_replace_the_count() {
        let mut spec = Spec::new(vec![10]);
        spec.render.n_views = 7;
        spec.render.custom_views = vec![[0.0, 0.0, 2.0]];
        assert_eq!(spec.validate(), []);
        spec.render.custom_views.push([0.0; 3]);
        spec.render.custom_views.push([f64::INFINITY, 0.0, 0.0]);
        assert_eq!(fields(&spec), ["render.custom_views[1]", "render.custom_views[2]"]);
    }

    #[test]
    fn optimization_has_faults_of_its_own() {
        let mut spec = Spec::new(vec![10, 20]);
        spec.method = Method::Cluster;
        spec.optimize.until = Some(1.5);
        spec.optimize.max_secs = Some(f64::NAN);
        spec.optimize.delta = 0.0;
        spec.optimize.normals = true;
        let wanted = ["triangles", "optimize.max_secs", "optimize.until", "optimize.delta"];
        assert_eq!(fields(&spec), [&wanted[..], &["optimize.normals"]].concat());
        let input = || Input { mesh: "a".repeat(64), file_name: "crude.ply".into() };
        let mut spec = Spec::optimizing(input());
        assert_eq!((spec.validate(), spec.n_levels()), (vec![], 1));
        spec.triangles = vec![9];
        spec.ratios = vec![0.5];
        spec.max_d2 = 1.0;
        spec.optimize.max_evaluations = Some(0);
        assert_eq!(fields(&spec), ["triangles", "ratios", "optimize", "max_d2"]);
    }

    #[test]
    fn numbers_survive_storage() {
        let mut spec = Spec::new(vec![10]);
        spec.seed = u64::MAX;
        spec.render.custom_views = vec![[1.0 / 3.0, std::f64::consts::PI, -1e-300]];
        let text = serde_json::to_string(&spec).unwrap();
        assert_eq!(serde_json::from_str::<Spec>(&text).unwrap(), spec);
    }
}
