//! The linear problem of one step, with the pixels eliminated.
//!
//! The unknowns are the beam's coefficients a, the fluxes and the shifts; M, and the offset O where
//! one is sought, follow at their closed forms. With the light e = c L that an exposure shows at
//! a pixel, its change u = c M (B·a′ + L·ln c′ + ∇L·d′) and Q = 1 − e(eᵀwe)⁻¹eᵀw, which takes out
//! what M can follow (and O likewise),
//!
//! ```text
//! S x = Jᵀ w Q J x + priors,   J x = u
//! ```
//!
//! (Golub and Pereyra 1973, with the simplification of Kaufman 1975.) A product is one pass over the pixels
//! (`joint/pass.rs`).

use std::ops::Range;

use super::few::Few;
use super::flux::Fluxes;
use super::fused::Fused;
use super::kernel::{Eliminate, Propagate};
use super::layout::Grid;
use super::pass::Pass;
use super::penalty::{Penalty, SMOOTHING};
use super::unknowns::{Prior, ShiftPrior, State};
use super::workspace::Sums;
use crate::control::Control;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::geometry::TAPS;
use crate::parallel::{Value, Workers};

/// A determinant that is rounding alone, of two columns that are degenerate in a pixel.
const SINGULAR: f64 = 1e-12;

/// The share that D and the rim keep of a measurement which M follows whatever it is, since it is the pixel's only
/// one: it pulls at nothing, but cells that it sees are seen.
const FOLLOWED: f64 = 1e-6;

/// Numbers that a search for a step is made in.
pub(crate) trait Precision: Value {
    const IS_SINGLE: bool;

    /// What 1 stands for in a step and in a slope of cells, for an ordinary light and an ordinary weight: single
    /// precision holds no numbers of any size. In a step of fluxes and shifts it stands for 1, and so in their slope for
    /// the product of both.
    fn units(light: f64, weight: f64) -> [f64; 2];

    /// What a step of cells, of θ and of shifts pulls at the cells, the penalty with them, and what else a pass gathers.
    fn pull<T: Real>(
        system: &mut System<'_, '_, T>,
        step: Step<'_, Self>,
        share: f64,
        pull: &mut [Self],
        control: &Control,
    ) -> Result<Sums>;
}

/// A step of cells, of θ and of shifts as they count.
#[derive(Clone, Copy)]
pub(crate) struct Step<'s, N> {
    cells: &'s [N],
    theta: &'s [f64],
    moves: &'s [[f64; 2]],
}

impl Precision for f64 {
    const IS_SINGLE: bool = false;

    fn units(_: f64, _: f64) -> [f64; 2] {
        [1.0; 2]
    }

    fn pull<T: Real>(
        system: &mut System<'_, '_, T>,
        step: Step<'_, Self>,
        share: f64,
        pull: &mut [Self],
        control: &Control,
    ) -> Result<Sums> {
        let sums = system.propagate(step, pull, share, control)?;
        if let Some(penalty) = &system.penalty {
            penalty.add_product(step.cells, &system.scale, pull, system.pass.workers);
        }
        Ok(sums)
    }
}

impl Precision for f32 {
    const IS_SINGLE: bool = true;

    fn units(light: f64, weight: f64) -> [f64; 2] {
        [light, weight * light]
    }

    fn pull<T: Real>(
        system: &mut System<'_, '_, T>,
        step: Step<'_, Self>,
        share: f64,
        pull: &mut [Self],
        control: &Control,
    ) -> Result<Sums> {
        let Some(penalty) = &system.penalty else {
            return Ok(Sums { largest: f64::INFINITY, ..system.pass.no_sums() });
        };
        let fused = system.fused.get_or_insert_with(|| {
            Fused::new(&system.pass, &system.state.beam, system.ordinary, control)
        });
        control.check()?;
        let logs = system.fluxes.spread(step.theta);
        let (penalty, step) = ((penalty, &system.scale[..]), (step.cells, &logs[..], step.moves));
        fused.pull(&mut system.pass, penalty, step, share, pull, control)
    }
}

/// The problem at a state.
pub(crate) struct System<'m, 'a, T> {
    pub(crate) pass: Pass<'m, 'a, T>,
    pub(crate) fluxes: Fluxes,
    shift_prior: Option<ShiftPrior>,
    /// N of `shift_noise.rs`, if products are S − N; else empty.
    pub(super) shift_noise: Vec<f64>,
    /// F of the measurements alone, at the state last linearised.
    pub(crate) misfit: f64,
    /// The variance of a measurement of weight 1.
    pub(crate) unit: f64,
    pub(crate) state: State,
    /// What the measurements pull at the unknowns there, while it may be asked for again.
    pull: Vec<f64>,
    /// The mean M of the pixels with measurements.
    pub(crate) mean: f64,
    /// D/w₀ with D = Σ w c² M² of the pixels that see a cell, by their factors, and an ordinary weight w₀.
    pub(crate) weights: Vec<f32>,
    /// s l₀ = D a l₀/(aᵀD a) with the coefficients a and an ordinary light l₀.
    pub(crate) scale: Vec<f32>,
    pub(crate) penalty: Option<Penalty>,
    /// A faster product at the state last linearised, where it serves.
    fused: Option<Fused>,
    /// An ordinary light and an ordinary weight.
    pub(crate) ordinary: [f64; 2],
    /// Whether the weights and τ are of the state last linearised.
    is_weighed_anew: bool,
    /// Whether the penalty counts more cells than at the state linearised before.
    pub(crate) sees_more: bool,
    /// The prior of M in weak light, and R there.
    pub(crate) prior: Option<Prior>,
    of_prior: f64,
}

impl<'m, 'a, T: Real> System<'m, 'a, T> {
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub(crate) fn new(
        exposures: &'m Exposures<'a, T>,
        grid: Grid,
        fluxes: Fluxes,
        state: State,
        workers: &'m Workers,
        control: &Control,
    ) -> Result<Self> {
        let few = Few::of(exposures, &grid, control)?;
        let with_flux = !fluxes.columns.is_empty();
        Ok(Self {
            pass: Pass::new(exposures, grid, few, with_flux, workers, control),
            fluxes,
            shift_prior: None,
            shift_noise: Vec::new(),
            misfit: 0.0,
            unit: 1.0,
            pull: Vec::new(),
            mean: 1.0,
            weights: Vec::new(),
            scale: Vec::new(),
            penalty: None,
            fused: None,
            ordinary: [exposures.typical_light(), exposures.typical_weight()],
            is_weighed_anew: false,
            sees_more: false,
            prior: None,
            of_prior: 0.0,
            state,
        })
    }

    /// How many measurements the search uses.
    pub(crate) fn used(&self) -> usize {
        self.pass.exposures.used() - self.pass.few.measurements
    }

    /// Seeks the shifts too, by what is known of them, or no longer; returns what was known before.
    pub(crate) fn seek_shifts(&mut self, prior: Option<ShiftPrior>) -> Option<ShiftPrior> {
        self.pass.with_shifts = prior.is_some();
        std::mem::replace(&mut self.shift_prior, prior)
    }

    /// Whether shifts are sought.
    pub(crate) const fn seeks_shifts(&self) -> bool {
        self.shift_prior.is_some()
    }

    /// Values of a vector of unknowns: cells, θ, shifts.
    pub(crate) fn size(&self) -> usize {
        let shifts = if self.seeks_shifts() { 2 * self.pass.exposures.count() } else { 0 };
        self.state.beam.len() + self.fluxes.columns.len() + shifts
    }

    /// Takes a share of a step, which is in the units of single precision.
    pub(crate) fn advance(&mut self, x: &[f32], share: f64) {
        let (cells, others) = x.split_at(self.state.beam.len());
        let [light, _] = self.units::<f32>();
        self.pass.workers.add_multiple(&mut self.state.beam, share * light, cells);
        let others: Vec<f64> = others.iter().map(|&x| x.into()).collect();
        let (theta, moves) = others.split_at(self.state.theta.len());
        for (theta, step) in self.state.theta.iter_mut().zip(theta) {
            *theta += share * step;
        }
        let moves = self.centred(moves);
        let shifts = self.state.shifts.as_flattened_mut().iter_mut();
        shifts.zip(moves.as_flattened()).for_each(|(shift, step)| *shift += share * step);
        if let Some(prior) = &self.shift_prior {
            prior.keep_near(&mut self.state.shifts);
        }
    }

    /// Changes of shifts as they count: less their mean, where they are sought.
    pub(crate) fn centred(&self, shifts: &[f64]) -> Vec<[f64; 2]> {
        let shifts = shifts.as_chunks().0;
        self.shift_prior.as_ref().map_or_else(|| shifts.to_vec(), |prior| prior.centred(shifts))
    }

    /// What pulls at shifts, as [`centred`](Self::centred) passes it on.
    pub(crate) fn centred_pulls(&self, pulls: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
        match &self.shift_prior {
            Some(prior) => prior.centred_pulls(&pulls),
            None => pulls,
        }
    }

    /// Finds M at the state, F there, and half the slope of −F along the unknowns.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub(crate) fn linearise(&mut self, control: &Control) -> Result<(f64, Vec<f64>)> {
        self.pass.place(&self.state.shifts);
        (self.fused, self.is_weighed_anew) = (None, false);
        self.pass.flux = self.fluxes.at(&self.state.theta);
        let mut pull = self.pass.workers.filled(self.state.beam.len(), 0.0, control);
        let found = self.eliminate_pixels(&mut pull, control)?;
        self.append(&found, &mut pull);
        (self.misfit, self.pull) = (found.objective, pull);
        self.of_prior = self.misfit_of_prior();
        self.mean = self.mean_sensitivity();
        // Cells come into sight where shifts move.
        if self.weights.is_empty() || self.shift_prior.is_some() {
            self.weigh(control)?;
        }
        if self.has_single() {
            self.pass.free_sums();
        }
        self.whole(control)
    }

    /// What [`linearise`](Self::linearise) gives, at weights D and a weight of the penalty of the state
    /// there.
    pub(crate) fn renew(&mut self, control: &Control) -> Result<(f64, Vec<f64>)> {
        if !self.is_weighed_anew {
            self.penalty = None;
            self.weigh(control)?;
            if self.has_single() {
                self.pass.free_sums();
            }
        }
        self.whole(control)
    }

    /// Frees what products take.
    pub(crate) fn free_products(&mut self) {
        self.fused = None;
        self.pass.free_sums();
    }

    /// Frees what [`renew`](Self::renew) takes.
    pub(crate) fn settle(&mut self) {
        self.pull = Vec::new();
    }

    /// M and O at their closed forms, and what they leave pulls at the cells.
    fn eliminate_pixels(&mut self, pull: &mut [f64], control: &Control) -> Result<Sums> {
        let cols = self.pass.exposures.sensor().cols;
        let of_row = |row: usize| {
            let weights = self.prior.as_ref().map(|prior| &prior.weights[row * cols..][..cols]);
            weights.unwrap_or_default()
        };
        let mean = self.prior.as_ref().map_or(1.0, |prior| prior.mean);
        self.pass.run(&self.state.beam, pull, control, |pass, row_index, row, workspace, found| {
            pass.measure(row_index, workspace);
            let (light, weights, values, sums) = workspace.parts();
            let (fluxes, singular) = (&pass.flux[..], SINGULAR);
            let (prior, few) = (of_row(row_index), pass.few.in_row(row_index));
            found.objective += pulp::Arch::new().dispatch(Eliminate {
                row,
                fluxes,
                light,
                weights,
                values,
                sums,
                singular,
                prior,
                mean,
                few,
            });
        })
    }

    /// F and half the slope of −F, with the penalty and the priors.
    fn whole(&mut self, control: &Control) -> Result<(f64, Vec<f64>)> {
        let mut scale = std::mem::take(&mut self.scale);
        scale.resize(self.weights.len(), 0.0);
        let (cols, workers) = (self.pass.grid.geometry.beam.cols, self.pass.workers);
        let cells = |row: usize| {
            let cells = row * cols..(row + 1) * cols;
            let cells = self.weights[cells.clone()].iter().zip(&self.state.beam[cells]);
            cells.map(|(d, a)| (f64::from(*d) * a, a))
        };
        let norms: Vec<f64> =
            workers.map(scale.len() / cols, |row| cells(row).map(|(da, a)| da * a).sum());
        let norm: f64 = norms.into_iter().sum();
        let unit = self.ordinary[0] / norm;
        workers.map_blocks(&mut scale, cols, |row, scale| {
            scale.iter_mut().zip(cells(row)).for_each(|(s, (da, _))| *s = (da * unit) as f32);
        });
        self.scale = scale;
        let mut slope = workers.filled(self.pull.len(), 0.0, control);
        slope.copy_from_slice(&self.pull);
        let mut objective = self.misfit + self.of_prior + self.pull_by_priors(&mut slope);
        if let Some(penalty) = &mut self.penalty {
            let (beam, weights) = (&self.state.beam, (&self.weights[..], norm));
            objective += penalty.turn_to(beam, weights, &mut slope[..beam.len()], workers);
        }
        self.balance(&mut slope[..self.state.beam.len()]);
        control.check()?;
        Ok((objective, slope))
    }

    /// x − a (aᵀD x)/(aᵀD a), without the multiple of the beam, which is not determined.
    pub(crate) fn take_scale_out<N: Value>(&self, x: &mut [N]) {
        let [light, _] = self.ordinary;
        let multiple = self.pass.workers.dot(&self.scale, x) / light;
        self.pass.workers.add_multiple(x, -multiple, &self.state.beam);
    }

    /// What was gathered of fluxes and shifts, behind what cells got.
    pub(crate) fn append(&self, sums: &Sums, vector: &mut Vec<f64>) {
        vector.extend(self.fluxes.gather(&sums.flux));
        vector.extend_from_slice(self.centred_pulls(sums.shifts.clone()).as_flattened());
    }

    /// The pull of the priors, added to a slope; returns their share of F.
    fn pull_by_priors(&self, slope: &mut [f64]) -> f64 {
        let cells = self.state.beam.len();
        let mut objective = 0.0;
        let params = self.fluxes.columns.len();
        let of_flux = slope[cells..].iter_mut().zip(&self.state.theta).zip(&self.fluxes.precisions);
        for ((slope, theta), precision) in of_flux {
            *slope -= self.unit * precision * theta;
            objective += self.unit * precision * theta * theta;
        }
        if let Some(prior) = &self.shift_prior {
            let found = self.state.shifts.iter().zip(&prior.measured);
            let deviations: Vec<[f64; 2]> =
                found.map(|(d, measured)| [d[0] - measured[0], d[1] - measured[1]]).collect();
            let known = deviations.as_flattened().iter().zip(prior.precisions.as_flattened());
            for (deviation, precision) in known {
                objective += self.unit * precision * deviation * deviation;
            }
            let pulls = prior.pull(&deviations);
            let of_shifts = slope[cells + params..].iter_mut().zip(pulls.as_flattened());
            of_shifts.for_each(|(slope, pull)| *slope -= self.unit * pull);
        }
        objective
    }

    /// The pixels whose measurements do not distinguish an offset from a gain, where one is sought.
    pub(crate) fn without_offset(&self) -> Vec<usize> {
        let (mut undetermined, mut first) = (Vec::new(), 0);
        if self.pass.with_offset {
            self.pass.for_rows(|[_, gain, _, _, beside, _]| {
                let pixels = gain.iter().zip(beside).enumerate();
                let alone = pixels.filter(|(_, (gain, offset))| **gain > 0.0 && **offset == 0.0);
                undetermined.extend(alone.map(|(col, _)| first + col));
                first += gain.len();
            });
        }
        undetermined
    }

    /// S x, and the change of M that goes with x in each [`Row`]; returns the largest size of that less
    /// `share` of the change before.
    pub(crate) fn multiply<N: Precision>(
        &mut self,
        x: &[N],
        product: &mut Vec<N>,
        share: f64,
        control: &Control,
    ) -> Result<f64> {
        let (cells, others) = x.split_at(self.state.beam.len());
        let others: Vec<f64> = others.iter().map(|&x| x.into()).collect();
        let (theta, shifts) = others.split_at(self.fluxes.columns.len());
        let moves = self.centred(shifts);
        product.resize(cells.len(), N::default());
        let step = Step { cells, theta, moves: &moves };
        let sums = N::pull(self, step, share, product, control)?;
        self.balance(product);
        let mut pulls = Vec::with_capacity(others.len());
        self.append(&sums, &mut pulls);
        let (of_flux, of_shifts) = pulls.split_at_mut(theta.len());
        for ((pull, x), precision) in of_flux.iter_mut().zip(theta).zip(&self.fluxes.precisions) {
            *pull += self.unit * precision * x;
        }
        if let Some(prior) = &self.shift_prior {
            let pulls = prior.pull(&moves);
            let of_shifts = of_shifts.iter_mut().zip(pulls.as_flattened());
            of_shifts.for_each(|(sum, pull)| *sum += self.unit * pull);
        }
        if !self.shift_noise.is_empty() {
            let feigned = self.centred_pulls(self.feigned_pulls(&moves));
            let of_shifts = of_shifts.iter_mut().zip(feigned.as_flattened());
            of_shifts.for_each(|(sum, feigned)| *sum -= feigned);
        }
        let unit = self.unit_of_other_slopes::<N>();
        product.extend(pulls.into_iter().map(|pull| N::of(pull / unit)));
        Ok(sums.largest)
    }

    /// What 1 stands for in a step and in a slope of cells.
    pub(crate) fn units<N: Precision>(&self) -> [f64; 2] {
        let [light, weight] = self.ordinary;
        N::units(light, weight)
    }

    /// What 1 stands for in a slope of fluxes and shifts.
    pub(crate) fn unit_of_other_slopes<N: Precision>(&self) -> f64 {
        self.units::<N>().into_iter().product()
    }

    /// A slope in numbers of this precision.
    pub(crate) fn slope_in<N: Precision>(&self, slope: Vec<f64>) -> Vec<N> {
        let [_, of_cell] = self.units::<N>();
        self.divided(slope, [of_cell, self.unit_of_other_slopes::<N>()])
    }

    /// A step in numbers of this precision.
    pub(crate) fn step_in<N: Precision>(&self, step: Vec<f64>) -> Vec<N> {
        let [of_cell, _] = self.units::<N>();
        self.divided(step, [of_cell, 1.0])
    }

    /// A step in the units of single precision, without units.
    pub(crate) fn step_of(&self, step: Vec<f32>) -> Vec<f64> {
        let [of_cell, _] = self.units::<f32>();
        let step = step.into_iter().map(Into::into).collect();
        self.divided(step, [1.0 / of_cell, 1.0])
    }

    /// Half the first-order decrease of F along a step in the units of single precision, divided by w₀ l₀².
    pub(crate) fn fall(&self, step: &[f32], slope: &[f64]) -> f64 {
        let (workers, cells, [_, of_cell]) =
            (self.pass.workers, self.state.beam.len(), self.units::<f32>());
        workers.dot(&step[..cells], &slope[..cells]) / of_cell
            + workers.dot(&step[cells..], &slope[cells..]) / self.unit_of_other_slopes::<f32>()
    }

    /// Values of cells and others, divided by their units.
    fn divided<N: Value>(&self, values: Vec<f64>, [of_cell, of_other]: [f64; 2]) -> Vec<N> {
        let cells = self.state.beam.len();
        let unit = |index| if index < cells { of_cell } else { of_other };
        let numbered = values.into_iter().enumerate();
        // In the place of the values, where numbers have their size.
        numbered.map(|(index, value)| N::of(value / unit(index))).collect()
    }

    /// Whether products can be made in single precision.
    pub(crate) fn has_single(&self) -> bool {
        Fused::serves(&self.pass)
    }

    /// What a step pulls at the cells once M and O have followed it.
    fn propagate(
        &mut self,
        Step { cells, theta, moves }: Step<'_, f64>,
        pull: &mut [f64],
        share: f64,
        control: &Control,
    ) -> Result<Sums> {
        let shares = self.shares(theta);
        let views = self.pass.views_of(cells);
        self.pass.run(&self.state.beam, pull, control, |pass, row_index, row, workspace, found| {
            pass.weigh_row(row_index, &mut workspace.weights);
            workspace.begin(&shares, moves);
            pass.see(&views, row_index, workspace);
            let (light, weights, values, sums) = workspace.parts();
            let fluxes = &pass.flux[..];
            let propagate = Propagate { row, fluxes, light, weights, values, sums, share };
            found.largest = found.largest.max(pulp::Arch::new().dispatch(propagate));
        })
    }

    /// Changes of ln c, divided by c, of changes of θ and what stands behind them.
    fn shares(&self, theta: &[f64]) -> Vec<f64> {
        let logs = self.fluxes.spread(theta);
        logs.iter().zip(&self.pass.flux).map(|(log, flux)| log / flux).collect()
    }

    /// 1ᵀ w Q J x of each pixel: what a change of all its measurements alike does to the slope along x.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn propagate_common(&mut self, x: &[f64], control: &Control) -> Result<Vec<f64>> {
        let cells = self.state.beam.len();
        let shares = self.shares(&x[cells..]);
        let moves = self.centred(&x[cells + self.fluxes.columns.len()..]);
        let views = self.pass.views_of(&x[..cells]);
        let (beam, mut pull) = (&self.state.beam, vec![0.0; cells]);
        self.pass.run(beam, &mut pull, control, |pass, row_index, mut row, workspace, _| {
            pass.weigh_row(row_index, &mut workspace.weights);
            workspace.begin(&shares, &moves);
            pass.see(&views, row_index, workspace);
            let (light, weights, values, sums) = workspace.parts();
            pulp::Arch::new().dispatch(Propagate {
                row: row.again(),
                fluxes: &pass.flux,
                light,
                weights,
                values,
                sums,
                share: 0.0,
            });
            row.change.fill(0.0);
            for (k, flux) in pass.flux.iter().enumerate() {
                let pulls = values.of(k).iter().zip(&*row.sensitivity);
                for (sum, (pull, m)) in row.change.iter_mut().zip(pulls) {
                    // A pixel without response pulls at nothing.
                    *sum += if *m == 0.0 { 0.0 } else { pull / (flux * m) };
                }
            }
            pass.few.clear(row_index, row.change);
        })?;
        let mut common = Vec::new();
        self.pass.for_rows(|[_, _, sums, ..]| common.extend_from_slice(sums));
        Ok(common)
    }

    /// The priors' weights of the parameters.
    pub(crate) fn precisions(&self) -> Vec<f64> {
        let shifts = self.shift_prior.iter().flat_map(|prior| prior.precisions.as_flattened());
        self.fluxes.precisions.iter().chain(shifts).map(|precision| self.unit * precision).collect()
    }

    /// D, Σ w c² M² over the pixels that see a cell, by their factors, and the penalty that goes with it.
    fn weigh(&mut self, control: &Control) -> Result<()> {
        let mut sums = self.pass.workers.filled(self.state.beam.len(), 0.0, control);
        self.pass.run(
            &self.state.beam,
            &mut sums,
            control,
            |pass, row_index, row, workspace, _| {
                let cols = pass.exposures.sensor().cols;
                pass.weigh_row(row_index, &mut workspace.weights);
                let (lights, weights, values, _) = workspace.parts();
                for (k, (weights, flux)) in weights.chunks_exact(cols).zip(&pass.flux).enumerate() {
                    let pixels = weights.iter().zip(&*row.sensitivity);
                    let lights = lights[k * cols..].iter().zip(&*row.inverse);
                    let values = values.of_mut(k).iter_mut().zip(lights);
                    for ((value, (light, inverse)), (weight, m)) in values.zip(pixels) {
                        let pulling = share_pulling(weight * light * light * inverse);
                        *value = pulling * weight * (flux * m) * (flux * m);
                    }
                }
            },
        )?;
        let [light, unit] = self.ordinary;
        // What is seen at all stays so.
        let relative = |d: f64| (d / unit).clamp(f64::from(f32::MIN_POSITIVE), f64::from(f32::MAX));
        self.weights.resize(sums.len(), 0.0);
        let cols = self.pass.grid.geometry.beam.cols;
        self.pass.workers.map_blocks(&mut self.weights, cols, |row, weights| {
            for (weight, &d) in weights.iter_mut().zip(&sums[row * cols..]) {
                *weight = if d > 0.0 { relative(d) as f32 } else { 0.0 };
            }
        });
        drop(sums);
        self.is_weighed_anew = self.penalty.is_none();
        if self.pass.grid.is_spline() {
            let square = self.pass.workers.dot(&self.weights, &self.weights);
            let typical = unit * square / self.total_weight();
            // τ stays until it is asked for anew, or F would not be one function.
            let tau = self.penalty.as_ref().map_or(SMOOTHING * typical, |penalty| penalty.tau);
            let shape = self.pass.grid.geometry.beam;
            let mut penalty =
                Penalty::new(shape, &self.weights, [tau, light], self.pass.workers, control);
            // Nor would it be one if cells left it that come out of sight.
            let last = self.penalty.take();
            self.sees_more = last.is_some_and(|last| penalty.count_where(&last));
            self.penalty = Some(penalty);
        }
        control.check()
    }

    /// Σ D/w₀ over all cells.
    pub(crate) fn total_weight(&self) -> f64 {
        self.weights.iter().map(|&d| f64::from(d)).sum()
    }

    /// w (c M)² of up to four pixels of a row of an exposure.
    pub(crate) fn pixel_weights(
        &self,
        exposure: usize,
        row: usize,
        cols: Range<usize>,
    ) -> [f64; TAPS] {
        let mut weights = [self.pass.exposures.uniform_weight(exposure).unwrap_or(0.0); TAPS];
        if self.pass.exposures.uniform_weight(exposure).is_none() {
            let _ = self.pass.exposures.stretch(exposure, row, cols.clone(), &mut weights);
        }
        let width = self.pass.exposures.sensor().cols;
        let part = |index: usize| &self.pass.row(row)[index * width..][cols.clone()];
        let pixels = cols.clone().zip(part(0)).zip(part(1));
        for (weight, ((col, m), inverse)) in weights.iter_mut().zip(pixels) {
            let light = self.pass.light_at(&self.state.beam, exposure, [row, col]);
            let pulling = share_pulling(*weight * light * light * inverse);
            *weight *= pulling * (self.pass.flux[exposure] * m).powi(2);
        }
        self.pass.few.clear_all(exposure, row, &cols, &mut weights);
        weights
    }
}

/// The share of its weight that a measurement pulls with, where w e² is this share of D = Σ w e² of its pixel.
fn share_pulling(share: f64) -> f64 {
    if (share - 1.0).abs() < FOLLOWED { FOLLOWED } else { 1.0 }
}
