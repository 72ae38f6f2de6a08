//! How far apart two pictures, or two surfaces, are.
//!
//! Pure functions of their arguments; knows nothing of views, queues or files.

mod bvh;
pub mod image;
pub mod surface;
