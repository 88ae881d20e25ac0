//! What noise does to M where the beam was eliminated.
//!
//! At the minimum of F the solution for noise alone is a draw from the covariance of the estimate,
//! (JᵀWJ)⁻¹, large scales included. To count how far draws of M scatter would take thousands of
//! them. But given L the pixels are independent, and given M the cells of L are, so that with the
//! sweep T = D⁻¹ B D_L⁻¹ Bᵀ, of which D⁻¹S = 1 − T (see `reduced.rs`),
//!
//! ```text
//! Cov M = D⁻¹ + D⁻¹ B D_L⁻¹ Bᵀ D⁻¹ + T Cov(M) Tᵀ
//! ```
//!
//! by the law of total covariance, used twice. The first two terms have a diagonal that one pass over
//! the weights gives; only the third, a fifth of the whole with five exposures, is the mean square
//! of T x over draws x. All is projected onto the gauge: with δM the solution in any gauge, that in
//! the gauge mean(M) = 1 is δM − M mean(δM).
//!
//! A linear functional gᵀM has the variance gᵀ S⁻¹ g: one linear problem, no draws.
//!
//! The noise of a dark that was subtracted from all exposures adds a e + r (`reduced/dark_noise.rs`). The
//! variance of a e is known; r and its product with a e are sampled, in the same draws. To a functional
//! it adds Σ_p v (Σ_k h_k)², h_k = w c L (x − M h) being the influence of measurement k with S x = g.

use std::sync::Arc;

use super::sampling::{Drawn, ErrorMap, LACK_OF_DRAW, LACK_OF_FUNCTIONAL, LACK_WITH_DARK};
use super::sampling::{NOTHING, Sampled, mean_misfit};
use crate::connectivity::NONE;
use crate::control::Control;
use crate::convergence::FEWEST_ITERATIONS;
use crate::error::Result;
use crate::exposures::Exposures;
use crate::fit::Solution;
use crate::frames::{Real, flag};
use crate::geometry::View;
use crate::memory;
use crate::padded::{BAND, Padding};
use crate::parallel::Workers;
use crate::reduced::{self, ConjugateGradients, Draw, Smallest};
use crate::weak_light::Prior;

/// The covariance at a fit of M and L alone, of its linear problem at the solution.
pub(super) struct ReducedCovariance<'m, 'a, T> {
    exposures: &'m Exposures<'a, T>,
    workers: &'m Workers,
    search: ConjugateGradients<'m, 'a, T>,
    smallest: Smallest,
    /// 1 in the pixels whose mean M is 1, else 0.
    valid: Vec<f32>,
    count: f64,
    /// b.
    slope: Vec<f32>,
    /// The variance of what M follows of the dark at once, in the gauge; empty without a dark.
    propagated: Vec<f32>,
    undetermined: Vec<bool>,
    incomplete: u64,
}

/// Upper limit on iterations for one right-hand side.
const MOST_ITERATIONS: u64 = 1000;

impl<'m, 'a, T: Real> ReducedCovariance<'m, 'a, T> {
    /// # Errors
    /// [`Error::Memory`](crate::Error::Memory) if the memory for it cannot be had,
    /// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
    pub(super) fn new(
        exposures: &'m Exposures<'a, T>,
        solution: &Solution<'_>,
        workers: &'m Workers,
        control: &Control,
    ) -> Result<Self> {
        memory::check(bytes_needed(exposures), || {
            format!("the uncertainty of {} exposures of {}", exposures.count(), exposures.sensor())
        })?;
        let (sensitivity, beam) = (solution.sensitivity, solution.beam.values);
        let mut search = ConjugateGradients::new(exposures, workers, control);
        let finite = |values: &[f64]| -> Vec<f64> {
            values.iter().map(|value| if value.is_finite() { *value } else { 0.0 }).collect()
        };
        let turned = |view: &View| -> Vec<f64> {
            let places = (0..view.shape.rows)
                .flat_map(|row| (0..view.shape.cols).map(move |col| view.cells.at(row, col)));
            finite(&places.map(|place| beam[place]).collect::<Vec<_>>())
        };
        let beams: Vec<Vec<f64>> = exposures.geometry().views.iter().map(turned).collect();
        let known = finite(sensitivity);
        let prior = solution.prior.as_ref().map(|weights| {
            let piece = |m: &f64| if m.is_finite() { 0 } else { NONE };
            let mut prior =
                Prior::new(Arc::clone(weights), sensitivity.iter().map(piece).collect());
            prior.at(&known);
            prior
        });
        search.linearise(&known, &beams, prior.as_ref(), control)?;
        let padding = search.reduced.padding;
        let undetermined: Vec<bool> = sensitivity.iter().map(|m| !m.is_finite()).collect();
        let mut valid = padding.zeros(exposures.sensor().rows, workers, control);
        let cols = exposures.sensor().cols;
        let diagonal = padding.body(&search.reduced.inverse_diagonal);
        let rows = padding.body_mut(&mut valid).chunks_exact_mut(padding.width);
        let mut count = 0.0;
        let skipped: Vec<bool> = undetermined
            .iter()
            .zip(solution.flags)
            .map(|(undetermined, flags)| *undetermined || flags & flag::UNRELIABLE_FLAT != 0)
            .collect();
        for ((row, diagonal), skipped) in
            rows.zip(diagonal.chunks_exact(padding.width)).zip(skipped.chunks_exact(cols))
        {
            for ((valid, &d), &skipped) in row.iter_mut().zip(diagonal).zip(skipped) {
                if d > 0.0 && !skipped {
                    *valid = 1.0;
                    count += 1.0;
                }
            }
        }
        let slope = padding.zeros(exposures.sensor().rows, workers, control);
        let smallest = Smallest::with(exposures.least_eigenvalue(exposures.flux()));
        let propagated = Vec::new();
        Ok(Self {
            exposures,
            workers,
            search,
            smallest,
            valid,
            count,
            slope,
            propagated,
            undetermined,
            incomplete: 0,
        })
    }

    /// Takes the noise of the dark into account, of these variances.
    pub(super) fn set_dark(&mut self, variance: &[f64], control: &Control) -> Result<()> {
        self.search.reduced.set_dark(variance, control)?;
        self.propagated = self.in_gauge(self.search.reduced.propagated());
        Ok(())
    }

    /// The diagonal of P V Pᵀ for a diagonal V.
    fn in_gauge(&self, mut variance: Vec<f32>) -> Vec<f32> {
        let mean = dot(&variance, &self.valid, self.workers) / (self.count * self.count);
        for (v, &m) in variance.iter_mut().zip(&self.search.reduced.sensitivity) {
            let m = f64::from(m);
            *v = (f64::from(*v) * (1.0 - 2.0 * m / self.count) + m * m * mean) as f32;
        }
        variance
    }

    /// What the noise of the dark adds to F, on average.
    pub(super) fn misfit_by_dark(&mut self, control: &Control) -> Result<f64> {
        mean_misfit(self.count, |draw| {
            let search = &mut self.search;
            let left = search.reduced.draw(Draw::Dark(draw), &mut search.residual, control)?;
            self.apply_inverse(LACK_OF_FUNCTIONAL, control)?;
            Ok(left - self.search.energy)
        })
    }

    fn image(&self, control: &Control) -> Vec<f32> {
        self.search.reduced.padding.zeros(self.exposures.sensor().rows, self.workers, control)
    }

    /// S⁻¹ b, left in the search, b being the residual, until x · b lacks at most this share.
    fn apply_inverse(&mut self, lack: f64, control: &Control) -> Result<()> {
        let Self { search, smallest, .. } = self;
        search.begin(control)?;
        let (mut iterations, mut earlier) = (0, 0.0);
        // What single precision holds.
        let held = lack.max(LACK_OF_DRAW);
        while smallest.iterate(search, control)? {
            iterations += 1;
            if iterations >= FEWEST_ITERATIONS && smallest.lack(search) <= lack {
                return Ok(());
            }
            if iterations == MOST_ITERATIONS {
                self.incomplete += 1;
                return Ok(());
            }
            // Rounding may leave a Ritz value next to 0, that of the gauge: then what the last
            // iterations brought tells.
            if iterations % FEWEST_ITERATIONS == 0 {
                let is_at_end = search.energy - earlier <= NOTHING * held * search.energy;
                if is_at_end && smallest.lowest.is_complete(search.square(), lack * search.energy) {
                    return Ok(());
                }
                earlier = search.energy;
            }
        }
        // Rounding may hide what a weak exposure alone determines; a b that is rounding has no solution at all.
        let is_complete = smallest.lowest.is_complete(search.square(), held * search.energy);
        self.incomplete += u64::from(iterations > 0 && !is_complete);
        Ok(())
    }

    /// Searches that ended before their answer was as exact as it should be.
    pub(super) const fn incomplete(&self) -> u64 {
        self.incomplete
    }

    /// The standard deviation of M by pixel, in units of that of a value of weight 1.
    pub(super) fn error_map(&mut self, control: &Control) -> Result<ErrorMap> {
        self.smallest.lowest.forget();
        let sampled = Sampled::of(self, control)?;
        Ok(sampled.map(self.deviations(&sampled)))
    }

    /// The variance of Σ g M of each image g of a stack, in units of that of a value of weight 1.
    pub(super) fn variances(&mut self, functionals: &[f64], control: &Control) -> Result<Vec<f64>> {
        self.smallest.lowest.forget();
        let pixels = self.exposures.sensor().len();
        let total = (functionals.len() / pixels) as u64;
        let stack = (0..).zip(functionals.chunks_exact(pixels));
        stack
            .map(|(index, functional)| {
                control.report("uncertainty", index, total);
                self.variance_of(functional, control)
            })
            .collect()
    }

    /// The variance of Σ g M.
    fn variance_of(&mut self, functional: &[f64], control: &Control) -> Result<f64> {
        let Self { search, slope, workers, valid, count, exposures, .. } = self;
        let padding = search.reduced.padding;
        // Pᵀ g = g − 1 (M · g)/N. Scaled, so that no g is beyond single precision.
        let largest = functional.iter().fold(0.0_f64, |largest, g| largest.max(g.abs()));
        if largest == 0.0 {
            return Ok(0.0);
        }
        let to_single = |g: f64| (g / largest) as f32;
        padding.copy(functional, exposures.sensor().cols, workers, slope, to_single);
        let mean = dot(slope, &search.reduced.sensitivity, workers) / *count;
        for (g, &valid) in slope.iter_mut().zip(valid.iter()) {
            *g -= mean as f32 * valid;
        }
        search.residual.copy_from_slice(slope);
        let with_dark = search.reduced.has_dark();
        let lack = if with_dark { LACK_WITH_DARK } else { LACK_OF_FUNCTIONAL };
        self.apply_inverse(lack, control)?;
        let Self { search, slope, workers, .. } = self;
        let by_dark = search.reduced.variance_by_dark(&search.x, control)?;
        let variance = dot(slope, &search.x, workers) + by_dark;
        Ok(variance * (largest * search.reduced.scale.deviation()).powi(2))
    }

    /// The standard deviations in the units of M, row by row.
    fn deviations(&self, sampled: &Sampled) -> Vec<f64> {
        let reduced = &self.search.reduced;
        let (padding, cols) = (reduced.padding, self.exposures.sensor().cols);
        let scale = reduced.scale.deviation();
        let mut std = vec![f64::NAN; self.exposures.sensor().len()];
        self.workers.map_blocks(&mut std, BAND * cols, |band, rows| {
            for (index, row) in rows.chunks_exact_mut(cols).enumerate() {
                let row_of_sensor = band * BAND + index;
                let inverse = &reduced.inverse_diagonal;
                let [known, squares, inverse] = [&sampled.known, &sampled.squares, inverse]
                    .map(|image| padding.row(image, row_of_sensor));
                for (col, std) in row.iter_mut().enumerate() {
                    if inverse[col] > 0.0 && !self.undetermined[row_of_sensor * cols + col] {
                        let drawn = f64::from(squares[col]) / sampled.draws as f64;
                        *std = scale * (f64::from(known[col]) + drawn).sqrt();
                    }
                }
            }
        });
        std
    }
}

impl<T: Real> Drawn for ReducedCovariance<'_, '_, T> {
    fn valid(&self) -> &[f32] {
        &self.valid
    }

    /// The part of the variance that is known: the diagonal of P V Pᵀ, with V the first two terms of
    /// Cov M and P = 1 − M 1ᵀ/N, so V − 2 M (V 1)/N + M² (1ᵀV 1)/N².
    fn known(&mut self, control: &Control) -> Result<Vec<f32>> {
        let mut variance = self.image(control);
        let Self { search, valid, workers, count, slope, .. } = self;
        search.reduced.two_terms(&mut variance, control)?;
        // V 1 = 2 u − D⁻¹ S u with u = D⁻¹ 1, since V = D⁻¹ + T D⁻¹.
        let mut alone = valid.clone();
        for (u, d) in alone.iter_mut().zip(&search.reduced.inverse_diagonal) {
            *u *= d;
        }
        search.reduced.multiply(&alone, slope, control)?;
        for (u, (d, q)) in alone.iter_mut().zip(search.reduced.inverse_diagonal.iter().zip(slope)) {
            *u = 2.0 * *u - d * *q;
        }
        let mean = dot(&alone, valid, workers) / (*count * *count);
        let m = &search.reduced.sensitivity;
        for ((variance, u), &m) in variance.iter_mut().zip(&alone).zip(m) {
            let m = f64::from(m);
            *variance += (m * (m * mean - 2.0 * f64::from(*u) / *count)) as f32;
        }
        variance.iter_mut().zip(&self.propagated).for_each(|(variance, dark)| *variance += dark);
        Ok(variance)
    }

    fn propagated(&self) -> &[f32] {
        &self.propagated
    }

    /// Adds the square of T x, in the gauge, of one draw x.
    fn add_draw(&mut self, draw: u64, squares: &mut [f32], control: &Control) -> Result<()> {
        let Self { search, slope, .. } = self;
        search.reduced.draw(Draw::Measurements(draw), slope, control)?;
        search.reduced.draw_prior(draw, slope);
        if search.reduced.has_dark() {
            search.reduced.draw(Draw::Dark(draw), &mut search.residual, control)?;
            search.residual.iter_mut().zip(&*slope).for_each(|(b, of_noise)| *b += of_noise);
        } else {
            search.residual.copy_from_slice(slope);
        }
        self.apply_inverse(LACK_OF_DRAW, control)?;
        let propagated = self.propagate_dark(draw, control)?;
        let Self { search, slope, workers, valid, count, .. } = self;
        // T x = x − D⁻¹ S x of the noise, and x of the dark: x − D⁻¹ (b − r), b being that of the noise.
        let inverse = &search.reduced.inverse_diagonal;
        workers.map_blocks(slope, PART, |part, slope| {
            let from = part * PART;
            for (index, rest) in slope.iter_mut().enumerate() {
                let place = from + index;
                let moved = *rest - search.residual[place];
                *rest = search.x[place] - inverse[place] * moved;
            }
        });
        let mean = (dot(slope, valid, workers) / *count) as f32;
        let m = &search.reduced.sensitivity;
        workers.map_blocks(squares, PART, |part, squares| {
            let from = part * PART;
            for (index, square) in squares.iter_mut().enumerate() {
                let rest = slope[from + index] - mean * m[from + index];
                *square += rest * rest;
                if let Some(propagated) = propagated.get(from + index) {
                    *square += 2.0 * rest * propagated;
                }
            }
        });
        Ok(())
    }
}

impl<T: Real> ReducedCovariance<'_, '_, T> {
    /// What M follows at once of the dark in one draw, in the gauge; empty without a dark.
    fn propagate_dark(&self, draw: u64, control: &Control) -> Result<Vec<f32>> {
        if !self.search.reduced.has_dark() {
            return Ok(Vec::new());
        }
        let mut propagated = self.image(control);
        self.search.reduced.propagate(draw, &mut propagated, control)?;
        let mean = (dot(&propagated, &self.valid, self.workers) / self.count) as f32;
        let m = &self.search.reduced.sensitivity;
        propagated.iter_mut().zip(m).for_each(|(value, m)| *value -= mean * m);
        Ok(propagated)
    }
}

/// Values that a thread takes at a time.
const PART: usize = 1 << 16;

/// Σ a b.
fn dot(a: &[f32], b: &[f32], workers: &Workers) -> f64 {
    let parts: Vec<_> = a.chunks(PART).zip(b.chunks(PART)).collect();
    let sum = |(a, b): &(&[f32], &[f32])| -> f64 {
        a.iter().zip(*b).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum()
    };
    workers.map(parts.len(), |index| sum(&parts[index])).into_iter().sum()
}

/// What both take beside the measurements, in bytes: a search and three images more, a copy of L in
/// each view, and the map.
fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>) -> u64 {
    let geometry = exposures.geometry();
    let padding = Padding::of(geometry);
    let places = |rows| padding.size(rows) as u64;
    let (pixels, cells) = (geometry.sensor.len() as u64, geometry.beam.len() as u64);
    let views = geometry.views.len() as u64;
    let of_views: u64 = geometry.views.iter().map(|view| 8 * places(view.shape.rows)).sum();
    let turned = if views > 1 { of_views } else { 0 };
    let more = 12 * places(geometry.sensor.rows) + turned;
    16 * pixels + more + 8 * views * cells + reduced::bytes_needed(exposures)
}
