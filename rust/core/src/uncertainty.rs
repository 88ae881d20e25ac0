//! How far noise may have moved what a fit found: the error map, and the error of any functional.
//!
//! Set up once, asked often: [`Uncertainty`] holds the linear problem at the solution with its
//! preconditioner. Each question starts a search of its own, so no answer depends on those before.
//! With the beam eliminated see `uncertainty/reduced.rs`, after a joint fit `uncertainty/joint.rs`.

mod ask;
mod joint;
mod joint_dark;
mod joint_gauge;
mod joint_pulls;
mod reduced;
mod sampling;
mod smoothed;

pub use ask::{Uncertainty, misfit_by_dark};
pub use sampling::ErrorMap;
