//! Pixel sensitivity of image sensors, measured without a uniform light source.

pub mod calibrate;
pub mod connectivity;
pub mod control;
pub mod descent;
pub mod error;
pub mod estimate;
pub mod frames;
pub mod geometry;
pub mod model;
pub mod parallel;
mod transform;

pub use error::{Error, Result};
