//! Pixel sensitivity of image sensors, measured without a uniform light source.

pub mod calibrate;
pub mod centroid;
pub mod connectivity;
pub mod control;
pub mod descent;
pub mod error;
pub mod estimate;
pub mod frames;
pub mod geometry;
#[cfg(feature = "io")]
pub mod io;
pub mod model;
pub mod parallel;
pub mod statistics;
mod transform;

pub use error::{Error, Result};
