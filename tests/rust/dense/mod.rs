//! The fit in dense algebra, for tiny sensors: every formula in its plainest form, with nothing of the
//! crate but the weight of the penalty.
//!
//! ```text
//! F = Σ w·(y − c·L(u)·M − O)² + τ‖G P a‖² + unit·(Σ (ln c − ln c₀)²/s_c² + Σ (d − d₀)²/s_d²)
//! ```
//!
//! with u = A p + t + d and L(u) = Σ_j a_j·B(u − j), B the cubic B-spline along rows and columns (de Boor,
//! A Practical Guide to Splines, 1978), or a_u itself where all shifts are whole and known. G are the
//! fourth differences of five seen cells, and P x = x − a (aᵀD x)/(aᵀD a) takes out the beam's multiples,
//! D being Σ w c² M² B. The unknowns are M, O, a, θ of ln c = ln c₀ + T θ and ζ of d = d₀ + Z ζ.

pub(crate) mod covariance;
pub(crate) mod gauge;
pub(crate) mod lamp;
pub(crate) mod linear;
pub(crate) mod minimum;
pub(crate) mod normal;

use crate::common::{Answer, Experiment, Noise};
use crate::simulation::place;
use lamp::Columns;

/// A shift that is known is one with this standard deviation, in pixels.
const EXACT_SHIFT: f64 = 1e-6;

/// A measurement that is used.
struct Measurement {
    exposure: usize,
    pixel: usize,
    value: f64,
    weight: f64,
}

/// Where each kind of unknown begins among all of them, M being the first, and their number.
#[derive(Clone, Copy)]
pub(crate) struct Layout {
    pub(crate) offsets: usize,
    pub(crate) cells: usize,
    pub(crate) fluxes: usize,
    pub(crate) shifts: usize,
    pub(crate) end: usize,
}

/// The problem of one experiment.
pub(crate) struct Dense<'e> {
    pub(crate) experiment: &'e Experiment,
    pub(crate) layout: Layout,
    /// The variance of a measurement of weight 1.
    pub(crate) unit: f64,
    /// The weights λ of the prior of M, where L and M alone are sought; empty without one.
    pub(crate) prior: Vec<f64>,
    measurements: Vec<Measurement>,
    columns: Columns,
    /// Standard deviations of the shifts that are sought.
    shift_std: Vec<[f64; 2]>,
    is_spline: bool,
    /// The first cell, and the cells along each axis.
    low: [f64; 2],
    sizes: [usize; 2],
}

impl<'e> Dense<'e> {
    /// The problem of `experiment`; `refines` says whether its shifts are sought.
    pub(crate) fn new(experiment: &'e Experiment, columns: Columns, refines: bool) -> Self {
        let Experiment { shape, shifts, shift_std, .. } = experiment;
        let (low, sizes) = grid(experiment);
        let sought = shift_std.iter().flatten().filter(|_| refines);
        let shift_std: Vec<_> = sought.map(|std| std.map(|std| std.max(EXACT_SHIFT))).collect();
        let whole = shifts.iter().flatten().all(|d| d.fract() == 0.0);
        let pixels = shape[0] * shape[1];
        let cells = if experiment.offset { 2 * pixels } else { pixels };
        let fluxes = cells + sizes[0] * sizes[1];
        let first_shift = fluxes + columns.count();
        let end = first_shift + 2 * shift_std.len();
        Self {
            experiment,
            layout: Layout { offsets: pixels, cells, fluxes, shifts: first_shift, end },
            unit: 1.0,
            prior: Vec::new(),
            measurements: measurements(experiment),
            columns,
            shift_std,
            is_spline: !whole || experiment.shift_std.is_some(),
            low,
            sizes,
        }
    }

    pub(crate) fn pixels(&self) -> usize {
        self.layout.offsets
    }

    /// The unknowns that an answer with these coefficients of the beam stands for.
    pub(crate) fn unknowns(&self, answer: &Answer, coefficients: &[f64]) -> Vec<f64> {
        let Layout { offsets, cells, fluxes, shifts, end } = self.layout;
        let mut x = vec![0.0; end];
        let known = |value: &f64| if value.is_finite() { *value } else { 0.0 };
        x.iter_mut().zip(&answer.sensitivity).for_each(|(x, m)| *x = known(m));
        let offset = answer.offset.iter().flatten();
        x[offsets..cells].iter_mut().zip(offset).for_each(|(x, o)| *x = known(o));
        for (cell, value) in coefficients.iter().enumerate() {
            let at = [cell / answer.beam_shape[1], cell % answer.beam_shape[1]];
            let [row, col] =
                [0, 1].map(|axis| at[axis] as f64 - answer.origin[axis] - self.low[axis]);
            let inside = |at: f64, axis: usize| at >= 0.0 && at < self.sizes[axis] as f64;
            if inside(row, 0) && inside(col, 1) {
                x[self.cell(row, col)] = known(value);
            }
        }
        let logs = answer.flux.iter().zip(&self.experiment.flux).map(|(c, given)| (c / given).ln());
        let theta = self.columns.heights(&logs.collect::<Vec<_>>());
        x[fluxes..shifts].copy_from_slice(&theta);
        let moves = answer.shifts.iter().zip(&self.experiment.shifts).zip(&self.shift_std);
        for (zeta, ((found, given), std)) in x[shifts..].chunks_exact_mut(2).zip(moves) {
            (0..2).for_each(|axis| zeta[axis] = (found[axis] - given[axis]) / std[axis]);
        }
        x
    }

    /// c of each exposure.
    fn flux(&self, x: &[f64]) -> Vec<f64> {
        let logs = self.columns.spread(&x[self.layout.fluxes..self.layout.shifts]);
        self.experiment.flux.iter().zip(logs).map(|(given, log)| given * log.exp()).collect()
    }

    /// Z of one exposure and axis: its shift less the mean of all, by the weights of the prior, for ζ in
    /// units of the prior's standard deviation. To move all exposures alike moves but the beam.
    fn moves(&self, exposure: usize, axis: usize) -> Vec<(usize, f64)> {
        let weights: Vec<f64> = self.shift_std.iter().map(|std| std[axis].powi(-2)).collect();
        let total: f64 = weights.iter().sum();
        let factor = |(k, std): (usize, &[f64; 2])| {
            let own = if k == exposure { 1.0 } else { 0.0 };
            (self.layout.shifts + 2 * k + axis, (own - weights[k] / total) * std[axis])
        };
        self.shift_std.iter().enumerate().map(factor).collect()
    }

    /// The shift of an exposure.
    fn shift(&self, exposure: usize, x: &[f64]) -> [f64; 2] {
        [0, 1].map(|axis| {
            let moved: f64 = self.moves(exposure, axis).iter().map(|&(at, z)| z * x[at]).sum();
            self.experiment.shifts[exposure][axis] + moved
        })
    }

    /// The unknown that a cell is.
    fn cell(&self, row: f64, col: f64) -> usize {
        self.layout.cells + row as usize * self.sizes[1] + col as usize
    }

    /// The cells that a point of the beam hangs on, with B and its slopes along rows and columns.
    fn taps(&self, u: [f64; 2]) -> Vec<(usize, [f64; 3])> {
        let [row, col] = [0, 1].map(|axis| u[axis] - self.low[axis]);
        if !self.is_spline {
            return vec![(self.cell(row, col), [1.0, 0.0, 0.0])];
        }
        let around = |x: f64| (0..4).map(move |i| x.floor() - 1.0 + f64::from(i));
        let pairs = around(row).flat_map(|i| around(col).map(move |j| (i, j)));
        let found = pairs.map(|(i, j)| {
            let ([b, slope], [c, incline]) = (cubic(row - i), cubic(col - j));
            (self.cell(i, j), [b * c, slope * c, b * incline])
        });
        found.filter(|(_, [b, ..])| *b != 0.0).collect()
    }
}

/// The first cell of a grid for all that the pixels see, with room around, and the cells along each axis.
fn grid(experiment: &Experiment) -> ([f64; 2], [usize; 2]) {
    let Experiment { shape, shifts, degrees, .. } = experiment;
    let corners = [0, shape[0] * shape[1] - 1];
    let seen: Vec<[f64; 2]> = corners
        .iter()
        .flat_map(|&pixel| degrees.iter().map(move |&degrees| place(*shape, degrees, pixel)))
        .zip(shifts.iter().cycle())
        .map(|(at, d)| [at[0] + d[0], at[1] + d[1]])
        .collect();
    let along = |axis: usize| seen.iter().map(move |u| u[axis]);
    let low = [0, 1].map(|axis| along(axis).fold(0.0, f64::min).floor() - 3.0);
    let high = [0, 1].map(|axis| along(axis).fold(0.0, f64::max).ceil() + 3.0);
    (low, [0, 1].map(|axis| (high[axis] - low[axis]) as usize + 1))
}

/// B(x) and dB/dx, the cubic B-spline with knots at whole numbers.
fn cubic(x: f64) -> [f64; 2] {
    let t = x.abs();
    let [value, slope] = if t < 1.0 {
        [2.0 / 3.0 - t * t + t * t * t / 2.0, 1.5 * t * t - 2.0 * t]
    } else if t < 2.0 {
        [(2.0 - t).powi(3) / 6.0, -(2.0 - t).powi(2) / 2.0]
    } else {
        [0.0, 0.0]
    };
    [value, if x < 0.0 { -slope } else { slope }]
}

fn measurements(experiment: &Experiment) -> Vec<Measurement> {
    let pixels = experiment.shape[0] * experiment.shape[1];
    let used = experiment.frames.iter().enumerate().filter(|(index, value)| {
        value.is_finite() && !experiment.mask.get(*index).copied().unwrap_or(false)
    });
    used.map(|(index, &value)| {
        let (exposure, pixel) = (index / pixels, index % pixels);
        let weight = match &experiment.noise {
            Noise::Unknown => 1.0,
            Noise::Exposures(variance) | Noise::Relative(variance) => 1.0 / variance[exposure],
            Noise::Measurements(variance) => 1.0 / variance[index],
        };
        Measurement { exposure, pixel, value, weight }
    })
    .collect()
}
