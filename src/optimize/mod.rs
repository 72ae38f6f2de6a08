//! Image-driven optimization.
pub mod driver;
mod quadratic;
mod rng;
pub mod simplex;
mod trial;
