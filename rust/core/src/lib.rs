//! Pixel sensitivity of image sensors, measured without a uniform light source.
//!
//! # The problem
//!
//! An image sensor looks at a steady beam from several positions, some pixels apart. In exposure k
//! pixel p measures
//!
//! ```text
//! y_k(p) = c_k · L(u_k(p)) · M(p) + noise,   u_k(p) = A_k p + t_k + d_k
//! ```
//!
//! with the sensitivity M, which moves with the sensor, the beam L, which stands still, the flux c,
//! the shift d and the rotation (A, t). The beam may have any form: since M and L move against each
//! other, a few exposures determine both, up to one common factor. It is fixed by mean(M) = 1. What
//! is sought is the minimum of
//!
//! ```text
//! F = Σ_k Σ_p w_k(p) [ y_k(p) − c_k L(u_k(p)) M(p) ]²,   w = 1/variance
//! ```
//!
//! # The modules
//!
//! A module uses only those below it, as far as they are on its way down (a test checks this).
//!
//! ```text
//! calibrate       from measurements to a Solution: method, gauge, flags
//! uncertainty     how far noise may have moved M
//! joint           the joint fit of beam, fluxes and shifts, with the pixels eliminated
//! multiscale      the fast solver: Gauss-Newton steps on all scales at once
//! descent         coordinate descent, the method of the paper
//! estimate        how far M still is from the minimum, large scales included; when to stop
//! conjugate       conjugate gradients, and the Ritz values that they yield
//! precondition    the two levels: the diagonal, and hats on a coarse grid
//! reduced         the linear problem of one step, with the beam eliminated
//! connectivity    what the measurements can compare; connected pixels
//! model           measurements, weights, masks; the checks of their values
//! geometry        shifts, rotations, the padded grid of the beam
//! linalg          sparse Cholesky factors
//! parallel        threads; the same bytes for any number of them
//! memory          what memory may still be had
//! random          random signs
//! control         cancellation and progress
//! frames          views of frame stacks, pixel types, flag bits; the checks of shapes
//! error           what can go wrong
//!
//! statistics      streaming mean and variance of frames         (uses parallel and below)
//! io              frames from image files, feature `io`         (uses statistics)
//! centroid        a spot's centroid with its standard error     (uses connectivity)
//! parts           the parts of a step of multiscale, for a bench (uses descent and below)
//! ```
//!
//! # Where to start
//!
//! - To **calibrate from Rust**: the example below, then [`calibrate`] and [`estimate::Stop`].
//! - To **understand the method**: docs/method.md of the repository, then [`model`], [`descent`],
//!   [`multiscale`] and [`estimate`].
//! - To **average or read frames**: [`statistics::Accumulator`], and `io` for files.
//! - To **work on this crate**: ARCHITECTURE.md and CONTRIBUTING.md of the repository; a new kernel
//!   starts from the NumPy reference in `python/equipix/reference`.
//!
//! # Example
//!
//! ```
//! use equipix_core::calibrate::{Method, calibrate};
//! use equipix_core::control::Control;
//! use equipix_core::estimate::{Ended, Stop};
//! use equipix_core::frames::{Shape, Stack};
//! use equipix_core::geometry::{Geometry, Rotation};
//! use equipix_core::model::{Mask, Model, Variance};
//! use equipix_core::parallel::Workers;
//!
//! // A sensor of 12 by 16 pixels sees a beam that falls off, from the positions of a cross.
//! let sensor = Shape::new(12, 16);
//! let shifts = [[0, 0], [0, 2], [0, 3], [2, 0], [3, 0]];
//! let sensitivity = |r: i64, c: i64| 1.0 + 0.05 * ((3 * r + 5 * c) as f64).sin();
//! let beam = |r: i64, c: i64| (-((r * r + c * c) as f64) / 1e3).exp();
//! let pixels = || (0..12).flat_map(|r| (0..16).map(move |c| (r, c)));
//! let frames: Vec<f64> = shifts
//!     .iter()
//!     .flat_map(|&[dr, dc]| pixels().map(move |(r, c)| sensitivity(r, c) * beam(r + dr, c + dc)))
//!     .collect();
//!
//! let (workers, control) = (Workers::new(None)?, Control::new());
//! let model = Model::new(
//!     Stack::new("frames", &frames, shifts.len(), sensor)?,
//!     Geometry::new(sensor, &shifts, &[Rotation::None; 5])?,
//!     &[1.0; 5],
//!     Variance::Unknown,
//!     Mask::None,
//!     &workers,
//!     &control,
//! )?;
//! let stop = Stop { tolerance: 1e-9, max_sweeps: None };
//! let solution = calibrate(&model, Method::Multiscale, stop, &workers, &control)?;
//!
//! assert_eq!(solution.history.ended, Ended::Converged);
//! let mean = pixels().map(|(r, c)| sensitivity(r, c)).sum::<f64>() / sensor.len() as f64;
//! for (found, (r, c)) in solution.sensitivity.iter().zip(pixels()) {
//!     assert!((found * mean / sensitivity(r, c) - 1.0).abs() < 1e-8);
//! }
//! # Ok::<(), equipix_core::Error>(())
//! ```
//!
//! # References
//!
//! - S. E. Stukachev, I. E. Kozhevatov, "Calibration method for spatial distribution of light
//!   sensitivity of matrix photo receivers", Radiophysics and Quantum Electronics (2011): the
//!   method.
//! - J. R. Kuhn, H. Lin, D. Loranz, "Gain calibrating nonuniform image-array data using only the
//!   image data", Publications of the Astronomical Society of the Pacific 103 (1991) 1097–1108: the
//!   same idea for telescopes.
//! - M. R. Hestenes, E. Stiefel, "Methods of conjugate gradients for solving linear systems", Journal
//!   of Research of the National Bureau of Standards 49 (1952) 409–436: the iteration; its Ritz values
//!   after G. H. Golub, C. F. Van Loan, "Matrix Computations", 4th ed. (2013).
//! - G. H. Golub, V. Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares
//!   problems whose variables separate", SIAM Journal on Numerical Analysis 10 (1973) 413–432, and
//!   L. Kaufman, "A variable projection method for solving separable nonlinear least squares
//!   problems", BIT 15 (1975) 49–57: steps with the pixels eliminated.
//! - C. de Boor, "A Practical Guide to Splines" (1978).
//! - T. F. Chan, G. H. Golub, R. J. LeVeque, "Algorithms for computing the sample variance", The
//!   American Statistician 37 (1983) 242–247: merging of partial sums.

pub mod beam;
pub mod centroid;
mod coarse;
pub mod connectivity;
pub mod control;
pub mod convergence;
pub mod error;
pub mod exposures;
pub mod fit;
pub mod frames;
mod gauge;
pub mod geometry;
#[cfg(feature = "io")]
pub mod io;
mod joint;
mod linalg;
mod median;
pub mod memory;
mod padded;
pub mod parallel;
#[doc(hidden)]
pub mod parts;
mod random;
mod reduced;
mod ritz;
pub mod solve;
pub mod statistics;
pub mod sweep;
pub mod uncertainty;

pub use beam::Beam;
pub use control::Control;
pub use convergence::{Ended, History, Look};
pub use error::{Error, Result};
pub use exposures::{Checked, Exposures, Flux, FluxKind, Mask, Measurements, Positions, Variance};
pub use fit::{Fit, Refinement, Solution};
pub use frames::{Real, Shape, Stack};
pub use geometry::Rotation;
pub use parallel::Workers;
pub use solve::{Method, Options, calibrate};
pub use uncertainty::{ErrorMap, Uncertainty};
