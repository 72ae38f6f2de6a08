//! The flags that say how the run-time pictures are taken.

use clap::Args;
use lookalike::jobs::spec::{Metric, Projection, Render, Shading};

use super::job_args::{automatic, word};

/// The run-time pictures.
#[derive(Args, Clone, Debug)]
pub(crate) struct PictureArgs {
    /// Number of views: 4, 6, 8, 12, 20 or 24.
    #[arg(long, default_value_t = 20, value_name = "N")]
    views: u32,
    /// A direction from the model's centre to an eye; repeat it. Replaces --views.
    #[arg(long = "view", value_parser = direction, value_name = "X,Y,Z", allow_hyphen_values = true)]
    custom_views: Vec<[f64; 3]>,
    /// Pixels along each side of a picture, 64 to 1024, a multiple of 8; `auto`: 256, 512 or, at effort
    /// best, 1024, as the finest level needs.
    #[arg(long, default_value = "auto", value_parser = automatic::<u32>, value_name = "PIXELS")]
    image_size: u32,
    /// Surface shading.
    #[arg(long, default_value = "flat", value_parser = word::<Shading>(&["flat", "smooth"]))]
    shading: Shading,
    /// Camera projection.
    #[arg(
        long,
        default_value = "perspective",
        value_parser = word::<Projection>(&["perspective", "orthographic"])
    )]
    projection: Projection,
    /// Field of view in degrees, 5 to 120 (perspective only).
    #[arg(long, default_value_t = 60.0, value_name = "DEGREES")]
    fov: f64,
    /// Background grey, 0 to 1.
    #[arg(long, default_value_t = 0.5, value_name = "GREY")]
    background: f64,
    /// Ambient light, 0 to 1.
    #[arg(long, default_value_t = 0.1, value_name = "LIGHT")]
    ambient: f64,
    /// Angle between view and light, 0 to 90 degrees.
    #[arg(long, default_value_t = 10.0, value_name = "DEGREES")]
    light_degrees: f64,
    /// How many of the views look at the inside.
    #[arg(long, default_value_t = 0, value_name = "N")]
    interior_views: u32,
    /// Leave out back faces of single-sided materials, as glTF viewers do. Without it both sides are drawn.
    #[arg(long)]
    hide_back_faces: bool,
    /// How much each view counts, 0 to 16, one weight a view.
    #[arg(long, value_delimiter = ',', value_name = "W")]
    view_weights: Vec<u32>,
    /// By what pictures are compared: luminance; red, green and blue (three times the work; colours of equal
    /// luminance are told apart); or luminance that counts less where the original is busy.
    #[arg(
        long,
        default_value = "luminance",
        value_parser = word::<Metric>(&["luminance", "rgb", "perceptual"])
    )]
    metric: Metric,
}

impl PictureArgs {
    /// The same as a part of a specification.
    pub(crate) fn render(self) -> Render {
        Render {
            n_views: self.views,
            custom_views: self.custom_views,
            image_size: self.image_size,
            fov_degrees: self.fov,
            projection: self.projection,
            background: self.background,
            ambient: self.ambient,
            light_degrees: self.light_degrees,
            shading: self.shading,
            interior_views: self.interior_views,
            hide_back_faces: self.hide_back_faces,
            view_weights: self.view_weights,
            metric: self.metric,
        }
    }
}

fn direction(text: &str) -> Result<[f64; 3], String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    let numbers =
        numbers.map_err(|error| format!("{error}: use three numbers, such as 1,0,-0.5"))?;
    let n_numbers = numbers.len();
    numbers.try_into().map_err(|_| format!("{n_numbers} numbers: use three, such as 1,0,-0.5"))
}
