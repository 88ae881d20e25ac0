//! From exposures to a fit: the choice of the solver, and its three loops.
//!
//! ```text
//! calibrate    what runs, the fit of M and L alone at whole shifts, and the result in its gauge
//! refuse       what does not go together
//! descent      the method of the paper, sweep by sweep
//! multiscale   Gauss-Newton steps on all scales at once, with the beam eliminated
//! joint        Gauss-Newton steps in beam, fluxes and shifts, with the pixels eliminated
//! dead_pixels  pixels that do not respond to light
//! ```

mod calibrate;
mod course;
mod dead_pixels;
mod descent;
mod found;
mod joint;
mod multiscale;
mod options;
mod refuse;
mod start;

pub use calibrate::calibrate;
pub(crate) use multiscale::minimise as multiscale;
pub use options::{Method, Options};
