//! How far apart two pictures, or two surfaces, are; and the objective of the image-driven stages:
//! what a local edit of the mesh does to the pictures.
//!
//! Knows nothing of queues, jobs or files.

mod appearance;
mod attributes;
#[cfg(test)]
mod attributes_tests;
mod bvh;
mod channels;
#[cfg(test)]
mod channels_tests;
mod drawn;
pub mod image;
pub mod masking;
mod objective;
mod palette;
mod regional;
mod shade;
mod shown;
mod slopes;
#[cfg(test)]
mod slopes_tests;
pub mod surface;
mod template;
#[cfg(test)]
mod template_tests;

pub use appearance::is_white;
pub use attributes::{Attributes, Unknown};
pub use channels::{Metric, is_grey};
pub use objective::{
    Objective, Pictures, ViewSet, bounding_sphere, d2_percent, energy_of_d2, pictures_and_unseen,
    reference_pictures, scene_as_drawn, scene_of_edit_mesh, scene_with_normals, stored_normal,
    with_vertex_normals,
};
pub use palette::Palette;
pub use regional::{NOWHERE, changes_by_region};
pub use slopes::{Slope, Slopes, slopes};
pub use template::{Change, Free, Template};
