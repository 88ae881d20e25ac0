//! The linear problem of the joint fit, with the pixels eliminated: what whole shifts and a steady lamp
//! do not need.
//!
//! ```text
//! F = Σ_k Σ_p w [ y − c_k L(A p + t + d_k) M(p) − O(p) ]² + τ ‖G a‖² + priors on ln c and d
//! ```
//!
//! L is a spline of coefficients a where shifts are no whole numbers (`layout.rs`), so its part of the
//! normal matrix is banded while that of M stays diagonal. Hence M is eliminated, not L as in `reduced`,
//! and Gauss-Newton steps are taken in (a, ln c, d) (`system.rs`), by conjugate gradients
//! (`conjugate_gradients.rs`) with a preconditioner on two scales (`preconditioner.rs`). The penalty
//! (`penalty.rs`) is slight: τ is 1e-5 of the mean weight of a cell. A product is one pass over the
//! pixels (`pass.rs`).

mod aggregated;
mod bands;
mod conjugate_gradients;
mod connected;
mod few;
mod first_beam;
mod first_fluxes;
mod flux;
mod freedom;
mod fused;
mod fused_kernel;
mod kernel;
mod layout;
mod lost;
mod memory;
mod outcome;
mod pass;
mod penalty;
mod pixels;
mod preconditioner;
mod rim;
mod shift_information;
mod shift_noise;
mod survey;
mod system;
#[cfg(test)]
mod tests;
mod tiles;
mod unknowns;
mod waves;
mod weak_light;
mod wide;
mod workspace;

pub(crate) use conjugate_gradients::{ConjugateGradients, Known};
pub(crate) use first_beam::{Source, first_beam};
pub(crate) use first_fluxes::first_fluxes;
pub(crate) use flux::Fluxes;
pub(crate) use kernel::{Propagate, Row};
pub(crate) use layout::Grid;
pub(crate) use memory::{bytes_needed, bytes_needed_by_covariance};
pub(crate) use outcome::{coefficients, components, freedom, unknowns, values_at_cells};
pub(crate) use pass::Pass;
pub use penalty::SMOOTHING;
pub(crate) use preconditioner::Preconditioner;
pub(crate) use shift_information::Directions;
pub(crate) use system::{Precision, System};
pub(crate) use unknowns::{Prior, ShiftPrior, State};
pub(crate) use workspace::Workspace;
