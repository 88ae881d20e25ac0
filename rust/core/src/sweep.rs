//! A sweep of coordinate descent, the method of the paper: the beam L, then the sensitivity M.
//!
//! With M fixed each cell of the beam has a closed form, and with L fixed each pixel has:
//!
//! ```text
//! L(u) = Σ w c M y / Σ w c² M²     over the measurements that see cell u
//! M(p) = Σ w c L y / Σ w c² L²     over the exposures of pixel p
//! ```
//!
//! One sweep updates all L, then all M (Stukachev and Kozhevatov 2011, section 2, who take the
//! method from Vasil'ev 1988). The objective F never rises. Pixel-scale errors of M fade in some
//! twenty sweeps, an error of the sensor's own size in (size/shift)² sweeps: see
//! [`convergence`](crate::convergence) for the criterion.
//!
//! Both are updated in the form M += Σ w c L r / Σ w c² L² with the residuals r = y − c L M, which
//! gives F in the same pass and keeps its accuracy when the residuals become small.

mod estimate;
mod kernel;
mod lines;

pub use estimate::Estimate;
pub(crate) use kernel::{Difference, Logarithmic, Plain};
