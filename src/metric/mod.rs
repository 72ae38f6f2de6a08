//! How far apart two pictures, or two surfaces, are.

mod albedo;
mod objective;
pub use objective::{Objective, Pictures, bounding_sphere, d2_percent, reference_pictures, scene_of_edit_mesh};
