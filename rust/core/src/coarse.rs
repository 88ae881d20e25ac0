//! The coarse space: hats on a coarse grid, and the factorised matrix of a problem in it.
//!
//! Both linear problems have a part on large scales alone, Φ A⁻¹ Φᵀ with A = Φᵀ S Φ. The columns of
//! Φ are bilinear hats on a coarse grid, times M or times the beam. A is summed over blocks: in each
//! the weights Ω_k of an exposure are summed exactly, and the hats φ_i are evaluated at its centre:
//!
//! ```text
//! yᵀAy = Σ_blocks [ Σ_k Ω_k g_k² − (Σ_k Ω_k g_k)² / Σ_k Ω_k ],   g_k = Σ_i y_i φ_i(centre − d_k)
//! ```
//!
//! Each block adds a positive semidefinite part in which constants weigh nothing, so A is one too.
//! A slight ridge makes it definite: what it is not definite in, by constants in pieces that are not
//! connected or by shifts along one line only, is no error that S can see.

mod cycle;
mod graph;
mod hats;
mod matrix;
mod modulated;
mod modulated_kernel;
mod modulated_matrix;
mod short_waves;
mod spacing;
mod spectrum;

pub(crate) use cycle::Cycle;
pub(crate) use graph::{Edges, Graph, NONE, Partition};
pub(crate) use hats::Hats;
pub(crate) use matrix::{Coarse, Entry};
pub(crate) use modulated::Modulated;
pub(crate) use modulated_matrix::{SeenWave, Spot};
pub(crate) use short_waves::{Places, ShortWaves, pairs};
pub(crate) use spacing::{DAMPING, bytes_needed, spacing, spacing_of_waves};
pub(crate) use spectrum::{Complex, MOST_WAVES, Symbol, barely_constrained, times};
