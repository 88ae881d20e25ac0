//! The noise of a dark that was subtracted from all exposures; what it does see `dark_noise.rs`.

/// The noise of the dark, in the units of the linear problem.
pub(crate) struct Dark {
    /// The standard deviation of e.
    pub(super) std: Vec<f32>,
    /// a; 0 in pixels without measurement.
    pub(super) propagation: Vec<f32>,
    /// 1/c of each exposure.
    pub(super) factors: Vec<f32>,
}
