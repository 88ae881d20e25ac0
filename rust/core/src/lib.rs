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
//! # A calibration
//!
//! ```
//! use equipix_core::{
//!     Control, Ended, Exposures, Flux, Options, Positions, Shape, Stack, Workers, calibrate,
//! };
//!
//! // A sensor of 12 by 16 pixels sees a beam that falls off, from the positions of a cross.
//! let sensor = Shape::new(12, 16);
//! let shifts = [[0.0, 0.0], [0.0, 2.0], [0.0, 3.0], [2.0, 0.0], [3.0, 0.0]];
//! let sensitivity = |r: f64, c: f64| 1.0 + 0.05 * (3.0 * r + 5.0 * c).sin();
//! let beam = |r: f64, c: f64| (-(r * r + c * c) / 1e3).exp();
//! let pixels = || (0..192).map(|pixel| (f64::from(pixel / 16), f64::from(pixel % 16)));
//! let frames: Vec<f64> = shifts
//!     .iter()
//!     .flat_map(|&[dr, dc]| pixels().map(move |(r, c)| sensitivity(r, c) * beam(r + dr, c + dc)))
//!     .collect();
//!
//! let (workers, control) = (Workers::new(None)?, Control::new());
//! let frames = Stack::new("frames", &frames, shifts.len(), sensor)?;
//! let (positions, flux) = (Positions::of_shifts(&shifts), Flux::steady(shifts.len()));
//! let exposures = Exposures::new(frames.into(), positions, flux, false, &workers, &control)?;
//! let options = Options { tolerance: 1e-9, ..Options::default() };
//! let fit = calibrate(&exposures, &options, None, &workers, &control)?;
//!
//! assert_eq!(fit.history.ended, Ended::Converged);
//! let mean = pixels().map(|(r, c)| sensitivity(r, c)).sum::<f64>() / sensor.len() as f64;
//! for (found, (r, c)) in fit.sensitivity.iter().zip(pixels()) {
//!     assert!((found * mean / sensitivity(r, c) - 1.0).abs() < 1e-8);
//! }
//! # Ok::<(), equipix_core::Error>(())
//! ```
//!
//! # A joint fit, and its error bars
//!
//! Shifts that differ by parts of pixels, fluxes to be fitted, shifts to be refined or an offset of each
//! pixel make it a joint fit. With such shifts, and with refined ones, the beam is a spline. What is known
//! of the exposures decides, not the caller.
//!
//! ```
//! use equipix_core::{
//!     Control, Exposures, Flux, FluxKind, Mask, Measurements, Options, Positions, Rotation, Shape,
//!     Stack, Variance, Workers, calibrate,
//! };
//!
//! // A lamp that drifts by a per cent; the last exposure is turned, so that a tilt of M is no drift.
//! let sensor = Shape::new(16, 16);
//! let shifts = [[0.0, 0.0], [0.5, 3.25], [4.75, 0.0], [2.5, 2.25], [0.25, 0.5]];
//! let lamp = [1.0, 1.01, 0.99, 1.005, 0.995];
//! let beam = |r: f64, c: f64| (1.0 + 0.1 * (0.4 * r).sin()) * (-(r * r + c * c) / 2e3).exp();
//! let frames: Vec<f64> = (0..5 * 256)
//!     .map(|index| {
//!         let (k, r, c) = (index / 256, (index / 16 % 16) as f64, (index % 16) as f64);
//!         // u = A p + t + d: a half turn looks at the window from its other end.
//!         let [u, v] = if k == 4 { [15.0 - r, 15.0 - c] } else { [r, c] };
//!         let m = 1.0 + 0.05 * (3.0 * r + 5.0 * c).sin();
//!         lamp[k] * m * beam(u + shifts[k][0], v + shifts[k][1])
//!     })
//!     .collect();
//!
//! let (workers, control) = (Workers::new(None)?, Control::new());
//! let measurements = Measurements {
//!     frames: Stack::new("frames", &frames, 5, sensor)?,
//!     variance: Variance::Exposures(&[1e-6; 5]),
//!     mask: Mask::None,
//! };
//! let mut positions = Positions::of_shifts(&shifts);
//! positions.rotations[4] = Rotation::Half;
//! let flux = Flux { values: vec![1.0; 5], kind: FluxKind::Free };
//! let exposures = Exposures::new(measurements, positions, flux, false, &workers, &control)?;
//! let fit = calibrate(&exposures, &Options::default(), None, &workers, &control)?;
//! assert!(fit.is_joint() && !fit.leaves_tilt);
//! for (found, true_flux) in fit.flux.iter().zip(lamp) {
//!     assert!((found / true_flux - 1.0).abs() < 2e-3);
//! }
//!
//! // Set up once, asked often; in units of the variance of a value of weight 1.
//! let mut bars = fit.uncertainty(&exposures, &workers, &control)?;
//! let map = bars.error_map()?;
//! let difference: Vec<f64> = (0..256).map(|p| if p < 128 { 1.0 } else { -1.0 } / 128.0).collect();
//! let halves = (bars.variances(&difference)?[0] * fit.unit()).sqrt();
//! assert!(map.std.iter().all(|std| (4e-4..2e-2).contains(std)) && halves < 2e-2);
//!
//! // A later fit may start from it, and the light is that of the spline that was fitted.
//! let again = calibrate(&exposures, &Options::default(), Some(fit.start()?), &workers, &control)?;
//! assert!(again.history.last().sweep < fit.history.last().sweep);
//! let light = fit.beam.light([0.5, 3.25], Rotation::None, sensor, &workers);
//! assert!((light[0] / beam(0.5, 3.25) - light[17] / beam(1.5, 4.25)).abs() < 1e-2);
//! # Ok::<(), equipix_core::Error>(())
//! ```
//!
//! # The modules
//!
//! A module uses only those below it, as far as they are on its way down (a test checks this). All
//! that a calibration needs is re-exported here.
//!
//! ```text
//! solve           calibrate: which solver runs, what it refuses, its three loops
//! uncertainty     how far noise may have moved what was found
//! gauge           what no measurement fixes, and how it is fixed
//! fit             what was found
//! joint           the linear problem with the pixels eliminated: beam, fluxes and shifts
//! reduced         the linear problem with the beam eliminated
//! sweep           a sweep of coordinate descent, the method of the paper
//! convergence     how far M still is from the minimum, large scales included
//! ritz            the smallest Ritz value, from conjugate gradients
//! beam            the light that a sensor sees of the beam from any position
//! weak_light      the prior of M where light is weak: what decides it, and its part of a linear problem
//! coarse          hats on a coarse grid, aggregates of pixels, and the matrix of a problem in them
//! connectivity    what the measurements can compare; connected pixels
//! information     the information D = Σ w c² L² of each pixel on M: its inverse variance with a known beam
//! exposures       measurements, weights, positions, fluxes; the one check of their values
//! padded          images as rows of one width, with zeros around
//! geometry        shifts, rotations, the padded grid of the beam, the taps of its spline
//! linalg          sparse Cholesky factors
//! median          medians of samples
//! parallel        threads; the same bytes for any number of them
//! memory          what memory may still be had
//! random          random signs
//! control         cancellation and progress
//! frames          views of frame stacks, pixel types, flag bits; the checks of shapes
//! error           what can go wrong
//!
//! curves          response curves from levels of a uniform source  (uses parallel and below)
//! scene           gain and offset from a moving scene  (uses geometry and below)
//! statistics      streaming mean and variance of frames         (uses parallel and below)
//! io              frames from image files, feature `io`         (uses statistics)
//! apply           corrections applied to frames                 (uses parallel and below)
//! fixed_point     corrections and the adaptive loop in words    (uses parallel and below)
//! centroid        a spot's centroid with its standard error     (uses connectivity)
//! parts           the parts of a multiscale step, for a bench   (uses solve and below)
//! ```
//!
//! # Where to start
//!
//! - To **calibrate from Rust**: the examples above, then [`Exposures`], [`Options`] and [`Fit`].
//! - To **understand the method**: docs/method.md of the repository, then [`exposures`], [`sweep`],
//!   [`solve`] and [`convergence`].
//! - To **average or read frames**: [`statistics::Accumulator`], and `io` for files.
//! - To **work on this crate**: ARCHITECTURE.md and CONTRIBUTING.md of the repository; a new kernel
//!   starts from the NumPy reference in `tests/reference`.
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

pub mod apply;
pub mod beam;
pub mod centroid;
mod coarse;
pub mod connectivity;
pub mod control;
pub mod convergence;
pub mod curves;
pub mod error;
pub mod exposures;
pub mod fit;
pub mod fixed_point;
pub mod frames;
mod gauge;
pub mod geometry;
mod information;
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
pub mod scene;
pub mod solve;
pub mod statistics;
pub mod sweep;
#[cfg(test)]
mod testing;
pub mod uncertainty;
mod weak_light;

pub use beam::Beam;
pub use control::Control;
pub use convergence::{Ended, History, Look};
pub use error::{Error, Result};
pub use exposures::{Checked, Exposures, Flux, FluxKind, Mask, Measurements, Positions, Variance};
pub use fit::{Fit, Refinement, Solution, Start};
pub use frames::{Real, Shape, Stack};
pub use gauge::slope_pixels;
pub use geometry::Rotation;
pub use joint::SMOOTHING;
pub use parallel::Workers;
pub use solve::{Method, Options, calibrate};
pub use uncertainty::{ErrorMap, Uncertainty, misfit_by_dark};
