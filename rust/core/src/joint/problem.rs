//! The problem of one step at a state: what `joint/system.rs` and `joint/pass.rs` work on.

use super::bands::Bands;
use super::flux::Fluxes;
use super::grid::{Grid, Window};
use super::penalty::Penalty;
use crate::model::Model;
use crate::parallel::Workers;

/// What is sought.
#[derive(Clone)]
pub(super) struct State {
    /// The coefficients of the beam, cell by cell.
    pub(super) beam: Vec<f64>,
    /// θ of the fluxes.
    pub(super) theta: Vec<f64>,
    pub(super) shifts: Vec<[f64; 2]>,
}

/// Where shifts were measured, and the weights of their squared deviations where noise is known.
pub(super) struct ShiftPrior {
    pub(super) measured: Vec<[f64; 2]>,
    pub(super) precisions: Vec<[f64; 2]>,
}

/// The problem at a state.
pub(super) struct System<'m, 'a, T> {
    pub(super) model: &'m Model<'a, T>,
    pub(super) workers: &'m Workers,
    pub(super) grid: Grid,
    pub(super) fluxes: Fluxes,
    pub(super) shift_prior: Option<ShiftPrior>,
    pub(super) with_offset: bool,
    /// F of the measurements alone, at the state last linearised.
    pub(super) misfit: f64,
    /// The variance of a measurement of weight 1.
    pub(super) unit: f64,
    pub(super) state: State,
    /// c of each exposure.
    pub(super) flux: Vec<f64>,
    /// What the measurements pull at the unknowns there.
    pub(super) pull: Vec<f64>,
    /// The mean M of the pixels with measurements.
    pub(super) mean: f64,
    pub(super) windows: Vec<Window>,
    pub(super) bands: Bands,
    /// [`Row`](super::kernel::Row) by row.
    pub(super) rows: Vec<f64>,
    /// What cells get of the pixels' pulls, by band.
    pub(super) sums: Vec<f64>,
    /// Passes over the measurements.
    pub(super) passes: u64,
    /// Σ w c² M² of the pixels that see a cell, by their factors.
    pub(super) weights: Vec<f64>,
    /// D a/(aᵀD a) with these weights D and the coefficients a.
    pub(super) scale: Vec<f64>,
    pub(super) penalty: Option<Penalty>,
}
