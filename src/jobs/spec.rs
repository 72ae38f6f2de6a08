//! What a job is asked to do: plain data, validated as a whole, stored as JSON.

use serde::{Deserialize, Serialize};

/// How the levels are made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Memoryless to `start_factor` times the largest target, then image-driven.
    #[default]
    Image,
    /// Memoryless (geometric) all the way.
    Memoryless,
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

/// A whole simplification job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spec {
    /// Triangles of each level of detail, in the order the caller wants them back.
    pub triangles: Vec<u32>,
    /// Image-driven or memoryless.
    #[serde(default)]
    pub method: Method,
    /// How hard to try.
    #[serde(default)]
    pub effort: Effort,
    /// The image-driven stage starts at this multiple of the largest target.
    #[serde(default = "default_start_factor")]
    pub start_factor: f64,
    /// Weight of the surface against the boundary in the memoryless cost, 0 to 1.
    #[serde(default = "default_lambda")]
    pub lambda: f64,
    /// The run-time pictures.
    #[serde(default)]
    pub render: Render,
    /// Upper bound on energy evaluations; 0 means none.
    #[serde(default)]
    pub max_evaluations: u64,
    /// Additional wall-clock cap in seconds; 0 means none.
    #[serde(default)]
    pub max_secs: f64,
    /// Seed of everything random.
    #[serde(default)]
    pub seed: u64,
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
            method: Method::default(),
            effort: Effort::default(),
            start_factor: default_start_factor(),
            lambda: default_lambda(),
            render: Render::default(),
            max_evaluations: 0,
            max_secs: 0.0,
            seed: 0,
        }
    }
}
