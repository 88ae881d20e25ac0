//! The prior of pixels in weak light at one M; what it does see `weak_operator.rs`.

use std::sync::Arc;

/// The prior's part of S at one M.
pub(crate) struct Weak {
    /// λ/μ², in the units of S, padded.
    pub(super) weights: Vec<f32>,
    pub(super) pieces: Arc<[i32]>,
    /// Σ M of each piece.
    pub(super) totals: Vec<f64>,
}
