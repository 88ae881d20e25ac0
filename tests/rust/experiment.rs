//! Small experiments of every kind, for the tests of the solvers.

use equipix_core::{
    Control, Exposures, Flux, FluxKind, Mask, Measurements, Positions, Result, Rotation, Shape,
    Stack, Variance, Workers,
};
use proptest::prelude::*;

/// Everything that one small experiment consists of.
#[derive(Clone, Debug)]
pub(crate) struct Experiment {
    pub(crate) shape: Shape,
    pub(crate) shifts: Vec<[i64; 2]>,
    pub(crate) rotations: Vec<Rotation>,
    pub(crate) flux: Vec<f64>,
    pub(crate) frames: Vec<f64>,
    pub(crate) variance: Vec<f64>,
    pub(crate) mask: Vec<bool>,
}

impl Experiment {
    /// Calls `visit` with the exposures of this experiment.
    pub(crate) fn with_exposures<R>(
        &self,
        workers: &Workers,
        visit: impl FnOnce(&Exposures<'_, f64>) -> Result<R>,
    ) -> Result<R> {
        let (count, shape) = (self.shifts.len(), self.shape);
        let frames = Stack::new("frames", &self.frames, count, shape)?;
        let variance = Stack::new("variance", &self.variance, count, shape)?;
        let variance = Variance::Measurements(variance);
        let measurements = Measurements { frames, variance, mask: Mask::Measurements(&self.mask) };
        let positions = Positions {
            shifts: self.shifts.iter().map(|shift| shift.map(|d| d as f64)).collect(),
            rotations: self.rotations.clone(),
            std: None,
        };
        let flux = Flux { values: self.flux.clone(), kind: FluxKind::Known };
        let control = Control::new();
        visit(&Exposures::new(measurements, positions, flux, false, workers, &control)?)
    }
}

/// Small sensors and ones longer than a vector, with gaps, noise and any rotation.
pub(crate) fn experiments() -> impl Strategy<Value = Experiment> {
    let rotation = prop::sample::select(vec![
        Rotation::None,
        Rotation::Quarter,
        Rotation::Half,
        Rotation::ThreeQuarters,
    ]);
    let sizes = (1..12_usize, 1..40_usize, 2..6_usize, any::<bool>());
    sizes.prop_flat_map(move |(rows, cols, count, turned)| {
        let side = rows.min(cols) as i64 - 1;
        let reach = if turned { [side, side] } else { [rows as i64 - 1, cols as i64 - 1] };
        let shift = (-reach[0]..=reach[0], -reach[1]..=reach[1]).prop_map(|(r, c)| [r, c]);
        let rotation = if turned { rotation.clone().boxed() } else { Just(Rotation::None).boxed() };
        let size = rows * cols * count;
        let value = prop_oneof![12 => 0.5..1.5, 1 => Just(f64::NAN)];
        let each = (
            prop::collection::vec(shift, count),
            prop::collection::vec(rotation, count),
            prop::collection::vec(0.5..2.0, count),
            prop::collection::vec(value, size),
            prop::collection::vec(0.5..2.0, size),
            prop::collection::vec(prop::bool::weighted(0.1), size),
        );
        each.prop_map(move |(shifts, rotations, flux, frames, variance, mask)| {
            let shape = Shape::new(rows, cols);
            Experiment { shape, shifts, rotations, flux, frames, variance, mask }
        })
    })
}
