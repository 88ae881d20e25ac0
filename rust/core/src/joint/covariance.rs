//! How far noise, and what priors leave open, may have moved what a joint fit found.
//!
//! With x the error of the unknowns other than M and O, and C x the change of M that follows it,
//!
//! ```text
//! δM = D⁻¹ eᵀw ε + C x,   Cov M = D⁻¹ + C S⁻¹ Cᵀ
//! ```
//!
//! since the noise that moves a pixel alone and that which is left for x are independent (see
//! `system.rs`; with an offset, D is the pixel's matrix of 2 by 2). The first term is known; the
//! second is the mean square of C x over draws S x = b of b with the covariance S. Priors and the
//! penalty count as measurements of their own there: S⁻¹ is what they leave open too.
//!
//! Three things stand beside S. A prior on fluxes leaves a tilt of M open that S does not see
//! (`flux.rs`): its covariance is added. Shifts that have a prior but were not refined are wrong by
//! its full width: what that does to M is drawn too. And of all this the gauge of the result takes
//! out the mean of M, and the tilt where free fluxes leave it undetermined.

use super::flux::{Flux, Fluxes};
use super::grid::Grid;
use super::kernel::{Follow, Row};
use super::pass::Room;
use super::precondition::Preconditioner;
use super::system::{ShiftPrior, State, System};
use super::{SMOOTHING, Search, Unknowns, gauge, shift_prior};
use crate::control::Control;
use crate::error::Result;
use crate::estimate::FEWEST_ITERATIONS;
use crate::frames::Real;
use crate::geometry::Rotation;
use crate::model::Model;
use crate::parallel::Workers;
use crate::random;

/// Iterations for one right-hand side that nobody waits for.
const MOST_ITERATIONS: u64 = 500;

/// What is drawn besides the noise of exposures.
enum Other {
    Penalty,
    Priors,
    Shifts,
}
/// How many of them there are.
const OTHERS: usize = 3;
/// A search that finds no more than this share of what it may lack in ten iterations is at its end.
const NOTHING: f64 = 1e-2;

/// A joint fit that has been made, of a model with the fluxes that it found.
#[derive(Clone, Debug)]
pub struct Solved<'s> {
    /// What was unknown: shifts as they were measured.
    pub unknowns: &'s Unknowns,
    /// The rotation of each exposure.
    pub rotations: &'s [Rotation],
    /// M in the gauge mean(M) = 1, row by row; NaN where undetermined.
    pub sensitivity: &'s [f64],
    /// The coefficients of the beam.
    pub coefficients: &'s [f64],
    /// The shifts as found.
    pub shifts: &'s [[f64; 2]],
    /// Whether they were refined.
    pub refined: bool,
    /// The variance of a measurement of weight 1.
    pub unit: f64,
}

/// A linear functional of what was found.
#[derive(Clone, Debug)]
pub(crate) enum Functional {
    /// Σ g M.
    Gain(Vec<f64>),
    /// Σ q d, of the shifts (row, column) of all exposures less their mean by the weights of the prior,
    /// for which no measurement speaks.
    Shifts(Vec<[f64; 2]>),
    /// b of the least-squares part b M of the offsets' errors: what they have in common.
    Offset,
}

/// Tilts of M that S does not see, and the covariance of their heights.
struct Hidden {
    tilts: [Vec<f64>; 2],
    covariance: [[f64; 2]; 2],
}

/// What the gauge takes out of a change of M: P = 1 − Σ U Wᵀ.
struct Gauge {
    /// U and W.
    parts: Vec<[Vec<f64>; 2]>,
}

/// The covariance at a joint fit, in units of the variance of a measurement of weight 1.
pub(crate) struct Covariance<'m, 'a, T> {
    system: System<'m, 'a, T>,
    preconditioner: Preconditioner,
    search: Search,
    gauge: Gauge,
    hidden: Option<Hidden>,
    /// The pattern of M that a drift linear in time brings, of the first θ.
    drift: Option<Vec<f64>>,
    /// The shifts that are uncertain though they were not refined.
    considered: Option<ShiftPrior>,
    /// 1 in the pixels whose mean M is 1, else 0.
    valid: Vec<f32>,
    /// The mean of D⁻¹: in these units squares have no extreme values.
    scale: f64,
}

impl<'m, 'a, T: Real> Covariance<'m, 'a, T> {
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled), here and below.
    pub(crate) fn new(
        model: &'m Model<'a, T>,
        solved: &Solved<'_>,
        workers: &'m Workers,
        control: &'m Control,
    ) -> Result<Self> {
        let Solved { unknowns, rotations, sensitivity, .. } = *solved;
        let sensor = model.sensor();
        let fitted = unknowns.shift_std.is_some();
        let grid = Grid::new(sensor, &unknowns.shifts, rotations, fitted)?;
        let fluxes = Fluxes::new(&unknowns.flux, solved.shifts, rotations);
        let state = State {
            beam: solved.coefficients.to_vec(),
            theta: vec![0.0; fluxes.columns.len()],
            shifts: solved.shifts.to_vec(),
        };
        let mut system = System::new(model, grid, fluxes, unknowns.offset, state, workers, control);
        system.unit = solved.unit;
        let (refined, considered) =
            shift_prior(unknowns).map_or((None, None), |prior| match solved.refined {
                true => (Some(prior), None),
                false => (None, Some(prior)),
            });
        system.shift_prior = refined;
        system.linearise(SMOOTHING, control)?;
        let preconditioner = Preconditioner::new(&mut system, control)?;

        let mut valid = vec![0.0; sensor.len()];
        let (mut first, mut sum, mut count) = (0, 0.0, 0.0);
        system.for_rows(|[_, inverse, ..]| {
            for (pixel, inverse) in (first..).zip(inverse) {
                if *inverse > 0.0 && sensitivity[pixel].is_finite() {
                    valid[pixel] = 1.0;
                    sum += inverse;
                    count += 1.0;
                }
            }
            first += inverse.len();
        });
        let [m, _] = system.pixels();
        let mean = |image: &[f64]| {
            let pixels = image.iter().zip(&valid).map(|(x, valid)| f64::from(*valid) * x);
            pixels.sum::<f64>() / count
        };
        let tilts = [0, 1].map(|axis| {
            let place = |pixel: usize| [pixel / sensor.cols, pixel % sensor.cols][axis] as f64;
            let tilt: Vec<f64> = m.iter().enumerate().map(|(pixel, m)| m * place(pixel)).collect();
            let mean = mean(&tilt);
            tilt.iter().zip(&m).map(|(tilt, m)| tilt - mean * m).collect::<Vec<_>>()
        });
        let drift = system.fluxes.slope.map(|slope| -slope);
        let [row, col] = gauge::in_sensor(drift, rotations[0]);
        let drift = (row != 0.0 || col != 0.0)
            .then(|| tilts[0].iter().zip(&tilts[1]).map(|(r, c)| row * r + col * c).collect());
        let of_mean = valid.iter().map(|valid| f64::from(*valid) / count).collect();
        let mut parts = vec![[m.clone(), of_mean]];
        let mut hidden = None;
        if matches!(unknowns.flux, Flux::Prior(_)) {
            let turned = in_sensor(system.fluxes.hidden_slope, rotations[0]);
            let covariance = turned.map(|row| row.map(|x| x / solved.unit));
            hidden = Some(Hidden { tilts, covariance });
        } else if !system.fluxes.open.is_empty() {
            let labels: Vec<i32> = valid.iter().map(|valid| *valid as i32 - 1).collect();
            let slopes = gauge::slopes(&m, &labels, sensor);
            for direction in &system.fluxes.open {
                let [row, col] = gauge::in_sensor(*direction, rotations[0]);
                let along = |[rows, cols]: &[Vec<f64>; 2]| -> Vec<f64> {
                    rows.iter().zip(cols).map(|(r, c)| row * r + col * c).collect()
                };
                let mut slope = along(&slopes);
                let pixels = slope.iter_mut().zip(&m).filter(|(weight, _)| **weight != 0.0);
                pixels.for_each(|(weight, m)| *weight /= m);
                parts.push([along(&tilts), slope]);
            }
        }
        Ok(Self {
            system,
            preconditioner,
            search: Search::default(),
            gauge: Gauge { parts },
            hidden,
            drift,
            considered,
            valid,
            scale: sum / count,
        })
    }

    /// 1 in the pixels whose mean M is 1, else 0.
    pub(crate) fn valid(&self) -> &[f32] {
        &self.valid
    }

    /// What the values of [`known`](Self::known) and [`add_draw`](Self::add_draw) are multiples of.
    pub(crate) const fn scale(&self) -> f64 {
        self.scale
    }

    /// The part of the variance that is known: the diagonal of P D⁻¹ Pᵀ, and what S does not see.
    pub(crate) fn known(&self) -> Vec<f32> {
        let own = self.own();
        let parts = &self.gauge.parts;
        let dot = |a: &[f64], b: &[f64]| -> f64 {
            a.iter().zip(b).zip(&own).map(|((a, b), own)| a * b * own).sum()
        };
        // (1 − U Wᵀ) V (1 − W Uᵀ) = V − U Wᵀ V − V W Uᵀ + U (Wᵀ V W) Uᵀ.
        let mixed: Vec<Vec<f64>> =
            parts.iter().map(|[_, w]| parts.iter().map(|[_, v]| dot(w, v)).collect()).collect();
        let variance = |pixel: usize| {
            let mut variance = own[pixel];
            for ([u, w], mixed) in parts.iter().zip(&mixed) {
                variance -= 2.0 * u[pixel] * own[pixel] * w[pixel];
                for ([v, _], mixed) in parts.iter().zip(mixed) {
                    variance += u[pixel] * mixed * v[pixel];
                }
            }
            if let Some(Hidden { tilts, covariance }) = &self.hidden {
                variance += form(covariance, [tilts[0][pixel], tilts[1][pixel]]);
            }
            (variance / self.scale) as f32
        };
        (0..own.len()).map(variance).collect()
    }

    /// Adds the square of the change of M in one draw, solved until it lacks at most this share of
    /// x · b.
    pub(crate) fn add_draw(
        &mut self,
        draw: u64,
        lack: f64,
        squares: &mut [f32],
        control: &Control,
    ) -> Result<()> {
        let mut slope = self.draw(draw, control)?;
        let mut change = vec![0.0; self.valid.len()];
        if self.considered.is_some() {
            // S x = b − S_d δ for shifts that are wrong by δ.
            let mut sign = self.other_signs(draw, Other::Shifts);
            let wrong = self.considered_variances().into_iter().map(|v| sign() * v.sqrt());
            let mut moved = vec![0.0; slope.len()];
            moved.extend(wrong);
            let pulled = self.considering(|system| {
                let pulled = product(system, &moved, control);
                add_change(system, &mut change);
                pulled
            })?;
            slope.iter_mut().zip(pulled).for_each(|(slope, pulled)| *slope -= pulled);
        }
        self.solve(slope, lack, control)?;
        let x = std::mem::take(&mut self.search.x);
        product(&mut self.system, &x, control)?;
        add_change(&self.system, &mut change);
        let workers = self.system.workers;
        if let Some(drift) = &self.drift {
            workers.add_multiple(&mut change, x[self.system.state.beam.len()], drift);
        }
        self.gauge.apply(&mut change, workers);
        for (square, change) in squares.iter_mut().zip(&change) {
            *square += (change * change / self.scale) as f32;
        }
        Ok(())
    }

    /// The variance of a functional, in the gauge of the result, solved until it lacks at most this
    /// share of what S has in it. A g must be 0 where M is undetermined.
    pub(crate) fn variance_of(
        &mut self,
        functional: Functional,
        lack: f64,
        control: &Control,
    ) -> Result<f64> {
        match functional {
            Functional::Gain(gain) => self.variance_of_gain(gain, lack, control),
            Functional::Shifts(shifts) => {
                let mut pull = vec![0.0; self.system.size()];
                let own = self.system.centred_pulls(shifts);
                let others = pull.len() - own.as_flattened().len();
                pull[others..].copy_from_slice(own.as_flattened());
                self.solve(pull, lack, control)?;
                Ok(self.search.energy)
            }
            Functional::Offset => self.variance_of_offset(lack, control),
        }
    }

    fn variance_of_gain(
        &mut self,
        mut gain: Vec<f64>,
        lack: f64,
        control: &Control,
    ) -> Result<f64> {
        let cells = self.system.state.beam.len();
        let others = cells + self.system.fluxes.columns.len();
        let workers = self.system.workers;
        self.gauge.transpose(&mut gain, workers);
        let none = vec![0.0; gain.len()];
        let mut variance = self.own_of(&gain, &none);
        if let Some(Hidden { tilts, covariance }) = &self.hidden {
            let heights = [0, 1].map(|axis| workers.dot(&tilts[axis], &gain));
            variance += form(covariance, heights);
        }
        let mut pull = if self.considered.is_some() {
            self.considering(|system| pull_of(system, &gain, &none, control))?
        } else {
            pull_of(&mut self.system, &gain, &none, control)?
        };
        if let Some(drift) = &self.drift {
            pull[cells] += workers.dot(drift, &gain);
        }
        let seen = if self.considered.is_some() { pull.split_off(others) } else { Vec::new() };
        self.solve(pull, lack, control)?;
        variance += self.search.energy;
        if self.considered.is_some() {
            let mut x = std::mem::take(&mut self.search.x);
            x.resize(others + seen.len(), 0.0);
            let pulled = self.considering(|system| product(system, &x, control))?;
            let left = seen.iter().zip(&pulled[others..]).map(|(seen, pulled)| seen - pulled);
            variance += left.zip(self.considered_variances()).map(|(h, v)| h * h * v).sum::<f64>();
        }
        Ok(variance)
    }

    /// With h = M/Σ M² the variance of Σ h O.
    ///
    /// Where L is hardly different at the positions of a pixel, and fluxes c are fitted, O → O + b M
    /// is met by L → L − b/c with other c, and no iteration finds that direction. So the search
    /// starts from the best multiple of it: x = (rᵀv/vᵀSv) v for v of
    ///
    /// ```text
    /// δL = −mean(1/c),   δ ln c = (−1/c − δL)/L
    /// ```
    fn variance_of_offset(&mut self, lack: f64, control: &Control) -> Result<f64> {
        let [mut offset, _] = self.system.pixels();
        offset.iter_mut().zip(&self.valid).for_each(|(m, valid)| *m *= f64::from(*valid));
        let square: f64 = offset.iter().map(|m| m * m).sum();
        offset.iter_mut().for_each(|m| *m /= square);
        let none = vec![0.0; offset.len()];
        let variance = self.own_of(&none, &offset);
        let mut pull = pull_of(&mut self.system, &none, &offset, control)?;
        let system = &mut self.system;
        let (flux, workers) = (&system.flux, system.workers);
        let light =
            workers.dot(&system.weights, &system.state.beam) / system.weights.iter().sum::<f64>();
        let of_beam = -flux.iter().map(|c| 1.0 / c).sum::<f64>() / flux.len() as f64;
        let logs: Vec<f64> = flux.iter().map(|c| (-1.0 / c - of_beam) / light).collect();
        let mut along: Vec<f64> =
            system.weights.iter().map(|w| if *w > 0.0 { of_beam } else { 0.0 }).collect();
        along.extend(system.fluxes.sought(&logs));
        along.resize(pull.len(), 0.0);
        let pulled = product(system, &along, control)?;
        let (size, height) = (workers.dot(&along, &pulled), workers.dot(&along, &pull));
        let mut found = 0.0;
        if size > 0.0 {
            found = height * height / size;
            workers.add_multiple(&mut pull, -height / size, &pulled);
        }
        self.solve(pull, lack, control)?;
        Ok(variance + found + self.search.energy)
    }

    fn considered_variances(&self) -> Vec<f64> {
        let prior = self.considered.iter().flat_map(|prior| prior.precisions.as_flattened());
        prior.map(|precision| 1.0 / (self.system.unit * precision)).collect()
    }

    /// Does something with the system as if the considered shifts were sought too.
    fn considering<R>(&mut self, work: impl FnOnce(&mut System<'m, 'a, T>) -> R) -> R {
        std::mem::swap(&mut self.system.shift_prior, &mut self.considered);
        let result = work(&mut self.system);
        std::mem::swap(&mut self.system.shift_prior, &mut self.considered);
        result
    }

    /// Solves S x = b.
    fn solve(&mut self, b: Vec<f64>, lack: f64, control: &Control) -> Result<()> {
        let Self { system, preconditioner, search, .. } = self;
        search.begin(system, preconditioner, b, control)?;
        let mut earlier = 0.0;
        for iteration in 1..=MOST_ITERATIONS {
            search.product(system, control)?;
            if !search.step(system, preconditioner)
                || iteration >= FEWEST_ITERATIONS
                    && search.square / search.smallest <= lack * search.energy
            {
                break;
            }
            if iteration % FEWEST_ITERATIONS == 0 {
                if search.energy - earlier <= NOTHING * lack * search.energy {
                    break;
                }
                earlier = search.energy;
            }
        }
        Ok(())
    }

    /// A b of covariance S: Jᵀ w Q ε + √τ Pᵀ Gᵀ s + √π s for noise ε of variance 1/w and signs s.
    fn draw(&mut self, draw: u64, control: &Control) -> Result<Vec<f64>> {
        let streams: Vec<u64> =
            (0..self.system.model.count()).map(|k| self.stream(draw, k, 0)).collect();
        let mut of_penalty = self.other_signs(draw, Other::Penalty);
        let mut of_priors = self.other_signs(draw, Other::Priors);
        let system = &mut self.system;
        let mut slope = pull_by(system, control, |system, row_index, row, room| {
            let cols = system.model.sensor().cols;
            let (weights, values, sums) = room.parts();
            for (k, (weights, flux)) in weights.chunks_exact(cols).zip(&system.flux).enumerate() {
                let mut sign = random::signs(streams[k] + row_index as u64);
                let pixels = weights.iter().zip(&*row.sensitivity);
                for (value, (weight, m)) in values.of_mut(k).iter_mut().zip(pixels) {
                    // As a change of the light, which a pixel without response does not show.
                    let shown = weight.sqrt() * flux * m;
                    *value = if shown == 0.0 { 0.0 } else { sign() / shown };
                }
            }
            let fluxes = &system.flux[..];
            pulp::Arch::new().dispatch(Follow { row, fluxes, weights, values, sums, share: 0.0 });
        })?;
        let cells = system.state.beam.len();
        if let Some(penalty) = &system.penalty {
            let beam = &system.state.beam;
            penalty.add_draw(beam, &mut of_penalty, &mut slope[..cells], system.workers);
        }
        let params = system.fluxes.columns.len();
        let mut pulls = system.precisions();
        pulls.iter_mut().for_each(|precision| *precision = precision.sqrt() * of_priors());
        let of_shifts = system.centred_pulls(pulls.split_off(params).as_chunks().0.to_vec());
        let priors = pulls.iter().chain(of_shifts.as_flattened());
        slope[cells..].iter_mut().zip(priors).for_each(|(slope, pull)| *slope += pull);
        Ok(slope)
    }

    /// The number of a stream of signs: of a row of an exposure, or behind those of what else is drawn.
    fn stream(&self, draw: u64, exposure: usize, row: usize) -> u64 {
        let (rows, count) = (self.system.model.sensor().rows, self.system.model.count());
        (draw * (count + OTHERS) as u64 + exposure as u64) * rows as u64 + row as u64
    }

    /// The stream of signs for what else is drawn.
    fn other_signs(&self, draw: u64, which: Other) -> impl FnMut() -> f64 + use<T> {
        random::signs(self.stream(draw, self.system.model.count() + which as usize, 0))
    }

    /// D⁻¹ of each pixel's M.
    fn own(&self) -> Vec<f64> {
        let mut own = Vec::with_capacity(self.valid.len());
        self.system.for_rows(|[_, inverse, ..]| own.extend_from_slice(inverse));
        own
    }

    /// The mean variance of an offset, by what noise does to its pixel alone.
    pub(crate) fn mean_variance_of_offset_alone(&self) -> f64 {
        let mut variances = Vec::with_capacity(self.valid.len());
        self.system.for_rows(|[.., inverse]| variances.extend_from_slice(inverse));
        let count: f64 = self.valid.iter().map(|valid| f64::from(*valid)).sum();
        variances.iter().zip(&self.valid).map(|(v, valid)| v * f64::from(*valid)).sum::<f64>()
            / count
    }

    /// The variance of Σ g M + Σ h O of what noise does to each pixel alone.
    fn own_of(&self, gain: &[f64], offset: &[f64]) -> f64 {
        let (mut variance, mut first) = (0.0, 0);
        self.system.for_rows(|[_, gains, _, _, mixed, offsets]| {
            for (a, g) in gains.iter().zip(&gain[first..]) {
                variance += a * g * g;
            }
            for (col, (b, c)) in mixed.iter().zip(offsets).enumerate() {
                let (g, h) = (gain[first + col], offset[first + col]);
                variance += 2.0 * b * g * h + c * h * h;
            }
            first += gains.len();
        });
        variance
    }
}

/// Cᵀ of a functional: what changes of the other unknowns do to it through M and O, which follow a
/// change u = c M v of the light by −α = −(i₁₁ eᵀw u + i₁₂ 1ᵀw u) and −β = −(i₁₂ eᵀw u + i₂₂ 1ᵀw u).
fn pull_of<T: Real>(
    system: &mut System<'_, '_, T>,
    gain: &[f64],
    offset: &[f64],
    control: &Control,
) -> Result<Vec<f64>> {
    pull_by(system, control, |system, row_index, row, room| {
        let cols = system.model.sensor().cols;
        let (gain, offset) = (&gain[row_index * cols..], &offset[row_index * cols..]);
        let [_, i12, i22] = row.offset;
        let (weights, values, _) = room.parts();
        for (k, (weights, flux)) in weights.chunks_exact(cols).zip(&system.flux).enumerate() {
            let light = &row.light[k * cols..];
            for (col, value) in values.of_mut(k).iter_mut().enumerate() {
                let (mut along_light, mut alone) = (row.inverse[col] * gain[col], 0.0);
                if !i22.is_empty() {
                    along_light += i12[col] * offset[col];
                    alone = i12[col] * gain[col] + i22[col] * offset[col];
                }
                let change = along_light * light[col] + alone;
                *value = -flux * row.sensitivity[col] * weights[col] * change;
            }
        }
    })
}

/// What pixels pull at the unknowns if `work` leaves their pulls in the room's values, with their
/// weights beside.
fn pull_by<T: Real>(
    system: &mut System<'_, '_, T>,
    control: &Control,
    work: impl Fn(&System<'_, '_, T>, usize, Row<'_>, &mut Room) + Sync,
) -> Result<Vec<f64>> {
    let beam = std::mem::take(&mut system.state.beam);
    let views = system.views_of(&beam);
    let mut pull = vec![0.0; beam.len()];
    let found = system.pass(&mut pull, control, |system, row_index, row, room, _| {
        system.weigh_row(row_index, room);
        system.see_slopes(&views, row_index, room);
        work(system, row_index, row, room);
    });
    drop(views);
    system.state.beam = beam;
    system.append(&found?, &mut pull);
    Ok(pull)
}

/// S x.
fn product<T: Real>(
    system: &mut System<'_, '_, T>,
    x: &[f64],
    control: &Control,
) -> Result<Vec<f64>> {
    let mut product = Vec::new();
    system.multiply(x, &mut product, 0.0, control)?;
    Ok(product)
}

/// Adds the change of M that goes with the last product.
fn add_change<T: Real>(system: &System<'_, '_, T>, change: &mut [f64]) {
    let mut sums = change.iter_mut();
    system.for_rows(|[_, _, change, ..]| {
        sums.by_ref().zip(change).for_each(|(sum, change)| *sum += change);
    });
}

/// hᵀ C h.
fn form(covariance: &[[f64; 2]; 2], h: [f64; 2]) -> f64 {
    let [[a, b], [_, c]] = covariance;
    a * h[0] * h[0] + 2.0 * b * h[0] * h[1] + c * h[1] * h[1]
}

/// The covariance of a slope in the beam as that of one on a sensor that is turned.
fn in_sensor(covariance: [[f64; 2]; 2], rotation: Rotation) -> [[f64; 2]; 2] {
    let [first, second] = covariance.map(|row| gauge::in_sensor(row, rotation));
    let column = |axis: usize| gauge::in_sensor([first[axis], second[axis]], rotation);
    [column(0), column(1)]
}

impl Gauge {
    /// P x.
    fn apply(&self, change: &mut [f64], workers: &Workers) {
        let heights: Vec<f64> = self.parts.iter().map(|[_, w]| workers.dot(w, change)).collect();
        for ([u, _], height) in self.parts.iter().zip(heights) {
            workers.add_multiple(change, -height, u);
        }
    }

    /// Pᵀ g.
    fn transpose(&self, functional: &mut [f64], workers: &Workers) {
        let heights: Vec<f64> =
            self.parts.iter().map(|[u, _]| workers.dot(u, functional)).collect();
        for ([_, w], height) in self.parts.iter().zip(heights) {
            workers.add_multiple(functional, -height, w);
        }
    }
}
