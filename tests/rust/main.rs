//! The tests of the core, in one program: the core's generic code is then compiled for them once.

#![allow(clippy::unwrap_used, reason = "what a test calls fails with it")]

mod apply;
mod choice;
mod common;
mod curves;
mod dense;
mod descent;
mod estimate;
mod experiment;
mod far_positions;
mod few_measurements;
mod fit;
mod fixed_point;
mod fixed_point_limits;
mod fraction;
mod joint;
mod laws;
mod multiscale;
mod scene;
mod simulation;
mod statistics;
mod uncertainty;
mod weak_light;
mod workers;
