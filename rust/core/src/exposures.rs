//! The exposures of one experiment: what a calibration is made from.
//!
//! ```text
//! F = Σ_k Σ_p w_k(p) [ y_k(p) − c_k L(u_k(p)) M(p) ]²
//! ```
//!
//! (Stukachev and Kozhevatov 2011, where all weights are 1; here w = 1/variance.) [`Exposures`] holds
//! the [`Measurements`] y with their weights, the [`Positions`] u and the [`Flux`] c. A measurement is
//! *used* if its mask is not set and its value is finite; any other has weight 0.

mod checked;
mod flux;
mod measurements;
mod positions;
mod stretch;
mod tally;
mod typical;

pub use checked::{Checked, Exposures};
pub use flux::{Flux, FluxKind};
pub use measurements::{Mask, Measurements, Variance};
pub use positions::Positions;
pub(crate) use stretch::Stretch;
