//! The linear problem of one Gauss-Newton step, with the beam eliminated.
//!
//! With L at its closed form for M, a step M → M + x that lowers F solves S x = b, where
//!
//! ```text
//! b(p)   = Σ_k w c L (y − c L M)                       half the slope of −F
//! S x(p) = Σ_k w c² L(u)² ( x(p) − M(p) h(u) )
//! h(u)   = Σ_k w c² M x / Σ_k w c² M²                  over the measurements that see cell u
//! ```
//!
//! that is S = D − B D_L⁻¹ Bᵀ with D(p) = Σ w c² L². In relative steps g = x/M it is a weighted
//! graph Laplacian, gᵀSg = Σ_u Σ_k ω (g_k − ḡ)² with ω = w c² L² M² and ḡ their weighted mean: 0
//! where g is the same in a whole connected component, which is the gauge. The steps are taken as
//! x, not g, so that a dead pixel (M = 0) is a pixel like any other.
//!
//! A product reads no measurement where the weights of an exposure are all the same. It works in
//! single precision: M, L and b are kept in double precision outside, and each Gauss-Newton step
//! makes good what the one before left by rounding (iterative refinement).

mod aggregated;
mod blocks;
mod conjugate_gradients;
mod dark;
mod dark_noise;
mod kernel;
mod noise;
mod operator;
mod two_level;
mod two_level_kernel;
mod weak_light;

pub(crate) use conjugate_gradients::{ConjugateGradients, Smallest, bytes_needed};
pub(crate) use operator::{Draw, Reduced, Scale};
pub(crate) use two_level::TwoLevel;
pub(crate) use weak_light::Whole;
