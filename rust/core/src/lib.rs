//! Pixel sensitivity of image sensors, measured without a uniform light source.

pub mod control;
pub mod error;
pub mod frames;
pub mod parallel;

pub use error::{Error, Result};
