//! Where each exposure lies in the beam: shifts, rotations and the padded beam grid.
//!
//! In exposure `k` the sensor of R rows and C columns sees the window of the beam L whose smallest
//! corner is `d_k`, turned by `numpy.rot90(window, rotation/90)`:
//!
//! ```text
//! y_k(p) = c_k · L(u_k(p)) · M(p),   u_k(p) = A_k p + t_k + d_k
//! ```
//!
//! A [`View`] is the whole beam grid turned in the same way. In it an exposure is a plain window:
//! pixel `p` sees the view's cell `p` + ([`Placement::row`], [`Placement::col`]), so the kernels
//! walk along rows whatever the rotation.

mod placement;
mod rotation;
mod taps;
mod whole;

pub use placement::{Geometry, Placement, View, Walk};
pub use rotation::Rotation;
pub(crate) use taps::{TAPS, Taps};
pub(crate) use whole::{nearest_whole, whole_number};
