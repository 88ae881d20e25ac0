//! Weak light: the prior of M there.
//!
//! In a pixel whose light is below its noise the measurements do not determine M, nor the cells of L that
//! such pixels see: M L fits noise at any M, and F has no minimum. So there
//!
//! ```text
//! R = Σ_p λ_p (M_p/μ − 1)²,   λ = σ²/A² · (1 − D/D₀)²   where D < D₀, else 0
//! ```
//!
//! is added to F, with the mean μ of M over the piece of connected pixels, σ² the variance of a measurement of
//! weight 1 and D = Σ w c² L². It acts on weak pixels alone: D₀ is 100 σ², but no more than a sixteenth of a
//! bright pixel's D. A prior on all pixels would count N of them as N measurements of a mean, and bias patterns
//! of the sensor's own size. Where M is not known to 50 % it has a prior however even the light.
//!
//! ```text
//! decision    the noise that decides where light is weak, for any linear problem
//! prior       λ, R and its slope
//! operator    the part of R in the linear problem of whole shifts
//! ```
//!
//! A linear problem takes part as a [`Problem`]: `reduced/weak_light.rs` and `joint/weak_light.rs`.

mod decision;
mod operator;
mod prior;

pub(crate) use decision::{Problem, WeakLight};
pub(crate) use operator::{Site, Term};
pub(crate) use prior::{Prior, range, variance};
