//! Preconditioned conjugate gradients for the linear problem S x = b.
//!
//! After Hestenes and Stiefel (1952). Their coefficients also make up the tridiagonal matrix of
//! Lanczos, whose eigenvalues, the Ritz values, approach those of P⁻¹S from within; the smallest is
//! what turns a residual into an estimate of the error ([`Smallest`], and [`convergence`](crate::convergence)).

use super::blocks;
use super::operator::Reduced;
use super::two_level::TwoLevel;
use crate::coarse::DAMPING;
use crate::control::Control;
use crate::convergence::{FEWEST_ITERATIONS, ROUNDING};
use crate::error::Result;
use crate::exposures::Exposures;
use crate::frames::Real;
use crate::padded::Padding;
use crate::parallel::Workers;
use crate::ritz::{Lowest, Ritz};
use crate::weak_light::Prior;

/// Values that a thread takes at a time.
const BLOCK: usize = 1 << 16;
/// No eigenvalue that matters is smaller than 1/this: single precision cannot distinguish it from 0.
const LONGEST_STEP: f64 = 1e6;

/// The share of r · P⁻¹ r at the start that single precision does not resolve: Ritz values from there on are
/// those of rounding.
const UNRESOLVED: f64 = 4e-12;

/// What a search holds, in bytes, where a *place* is a pixel of an image padded to the width of the beam:
///
/// | array | in bytes |
/// |---|---|
/// | x, residual, direction, product; M and 1/D in single precision | 6 · 4 for each place of the sensor |
/// | L², h | 2 · 4 for each place of each view |
/// | aggregates and their matrices, where they take the place of waves | for each place of the sensor 12, and 4 for each place of exposures times all pairs over those of much weight |
/// | the coarse matrices and their factors | some 2700 for each hat, 8000 for one of a wave, or of a full matrix |
pub(crate) fn bytes_needed<T: Real>(exposures: &Exposures<'_, T>) -> u64 {
    let geometry = exposures.geometry();
    let padding = Padding::of(geometry);
    let places = |rows| padding.size(rows) as u64;
    let of_views: u64 = geometry.views.iter().map(|view| 8 * places(view.shape.rows)).sum();
    24 * places(geometry.sensor.rows)
        + of_views
        + blocks::bytes_needed(exposures, places(geometry.sensor.rows))
}

/// A solution in the making: all that it needs stays in one place from one problem to the next.
pub(crate) struct ConjugateGradients<'m, 'a, T> {
    workers: &'m Workers,
    pub(crate) reduced: Reduced<'m, 'a, T>,
    two_level: TwoLevel<'m>,
    /// b − S x.
    pub(crate) residual: Vec<f32>,
    pub(crate) x: Vec<f32>,
    direction: Vec<f32>,
    product: Vec<f32>,
    /// r · P⁻¹ r, and that at the start.
    square: f64,
    first_square: f64,
    /// The largest size of P⁻¹ r, in the units of M.
    largest: f64,
    /// x · b, which rises to b · S⁻¹ b: the sum of a r · P⁻¹ r over the steps.
    pub(crate) energy: f64,
    pub(crate) ritz: Ritz,
}

impl<'m, 'a, T: Real> ConjugateGradients<'m, 'a, T> {
    /// Buffers for a search.
    pub(crate) fn new(
        exposures: &'m Exposures<'a, T>,
        workers: &'m Workers,
        control: &Control,
    ) -> Self {
        let reduced = Reduced::new(exposures, workers, control);
        let [residual, x, direction, product] =
            [(); 4].map(|()| reduced.padding.zeros(exposures.sensor().rows, workers, control));
        Self {
            workers,
            two_level: TwoLevel::new(exposures, reduced.padding, workers),
            reduced,
            residual,
            x,
            direction,
            product,
            square: 0.0,
            first_square: 0.0,
            largest: 0.0,
            energy: 0.0,
            ritz: Ritz::default(),
        }
    }

    /// Starts from x = 0, where the residual is b, with S at M and L. The preconditioner is that of
    /// the first start: it need not be exact.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn start(
        &mut self,
        sensitivity: &[f64],
        beams: &[Vec<f64>],
        prior: Option<&Prior>,
        control: &Control,
    ) -> Result<()> {
        self.linearise(sensitivity, beams, prior, control)?;
        self.begin(control)
    }

    /// Takes S at M and L, and the preconditioner unless there is one.
    ///
    /// # Errors
    /// As [`start`](Self::start).
    pub(crate) fn linearise(
        &mut self,
        sensitivity: &[f64],
        beams: &[Vec<f64>],
        prior: Option<&Prior>,
        control: &Control,
    ) -> Result<()> {
        self.reduced.linearise(sensitivity, beams, prior, control)?;
        self.two_level.prepare(&mut self.reduced, control)
    }

    pub(crate) const fn workers(&self) -> &'m Workers {
        self.workers
    }

    /// Forgets the preconditioner, since the prior is another.
    pub(crate) fn renew(&mut self) {
        self.two_level.forget();
    }

    /// x ← D⁻¹ b, what a sweep of coordinate descent adds to M.
    pub(crate) fn sweep_step(&mut self) {
        let inverse = &self.reduced.inverse_diagonal;
        let terms = self.x.iter_mut().zip(&self.residual).zip(inverse);
        terms.for_each(|((x, b), inverse)| *x = b * inverse);
    }

    /// Takes out of the right-hand side what lies along the gauge direction M, in which S is 0, for the whole sensor:
    /// b is orthogonal to M but for differences that do not add up. Where the sensor is in pieces that is
    /// approximate.
    pub(crate) fn take_gauge_out(&mut self) {
        let Reduced { sensitivity, inverse_diagonal, .. } = &self.reduced;
        let places = self.residual.iter().zip(sensitivity).zip(inverse_diagonal);
        let [mut along, mut weight] = [0.0; 2];
        for ((&b, &m), &inverse) in places.filter(|(_, inverse)| **inverse > 0.0) {
            along += f64::from(b) * f64::from(m);
            weight += f64::from(m).powi(2) / f64::from(inverse);
        }
        let share = (along / weight) as f32;
        let places = self.residual.iter_mut().zip(sensitivity).zip(inverse_diagonal);
        for ((b, m), inverse) in places.filter(|(_, inverse)| **inverse > 0.0) {
            *b -= share * m / inverse;
        }
    }

    /// Starts from x = 0, where the residual is b, with the S that there is.
    ///
    /// # Errors
    /// As [`start`](Self::start).
    pub(crate) fn begin(&mut self, control: &Control) -> Result<()> {
        self.workers.fill(&mut self.x, 0.0, control);
        self.workers.fill(&mut self.direction, 0.0, control);
        self.ritz = Ritz::default();
        self.energy = 0.0;
        self.square = self.descend(0.0);
        self.first_square = self.square;
        control.check()?;
        self.largest = self.turn(0.0, 0.0);
        Ok(())
    }

    /// Forgets the step that was found.
    pub(crate) fn forget(&mut self, control: &Control) {
        self.workers.fill(&mut self.x, 0.0, control);
    }

    /// One iteration: a step along the direction, and a new direction. `false` if there was none to
    /// go: the residual is 0, or nothing but rounding along which S does not change.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled).
    pub(crate) fn iterate(&mut self, control: &Control) -> Result<bool> {
        let curvature = self.reduced.multiply(&self.direction, &mut self.product, control)?;
        let step = self.square / curvature;
        // r · P⁻¹ r and the curvature are both above 0, or one of them is rounding.
        let is_positive = self.square > 0.0 && step > 0.0;
        if !(is_positive && step < LONGEST_STEP) || self.is_settled() {
            return Ok(false);
        }
        let square = self.descend(step);
        control.check()?;
        self.energy += step * self.square;
        let keep = square / self.square;
        self.square = square;
        self.largest = self.turn(step, keep);
        self.ritz.push(step, keep);
        Ok(square > 0.0)
    }

    /// A size of M in units of its mean.
    fn relative(&self, size: f64) -> f64 {
        let known = self.reduced.mean > 0.0
            && self.square.is_finite()
            && size.is_finite()
            && self.two_level.sees_large_scales();
        if known { size / self.reduced.mean } else { f64::INFINITY }
    }

    /// Whether an iteration more would resolve nothing.
    pub(crate) fn is_exhausted(&self) -> bool {
        self.square <= UNRESOLVED * self.first_square
    }

    /// Whether what is left is rounding alone.
    pub(crate) fn is_settled(&self) -> bool {
        self.largest() < ROUNDING
    }

    /// The largest relative size of P⁻¹ r.
    pub(crate) fn largest(&self) -> f64 {
        self.relative(self.largest)
    }

    /// The error of x, squared in the norm of S, is at most this over the smallest eigenvalue of
    /// P⁻¹S: r · P⁻¹ r.
    pub(crate) fn square(&self) -> f64 {
        self.square.max(0.0)
    }

    /// The largest relative size of the step found so far.
    pub(crate) fn found(&self) -> f64 {
        let blocks: Vec<&[f32]> = self.x.chunks(BLOCK).collect();
        let size = |largest: f32, value: &f32| largest.max(value.abs());
        let tops = self.workers.map(blocks.len(), |index| blocks[index].iter().fold(0.0, size));
        self.relative(f64::from(tops.into_iter().fold(0.0, f32::max)))
    }

    /// The root mean square of the relative size of P⁻¹ r, weighted by D.
    pub(crate) fn size(&self) -> f64 {
        self.relative((self.square.max(0.0) / self.reduced.trace).sqrt())
    }

    fn descend(&mut self, step: f64) -> f64 {
        self.two_level.descend(&self.reduced, &mut self.residual, step, &self.product)
    }

    fn turn(&mut self, step: f64, keep: f64) -> f64 {
        let vectors = [&mut self.x[..], &mut self.direction[..]];
        self.two_level.turn(&self.reduced, &self.residual, vectors, [step, keep])
    }
}

/// The smallest Ritz value found so far, and in how many iterations.
#[derive(Clone, Debug)]
pub(crate) struct Smallest {
    pub(crate) lowest: Lowest,
    pub(crate) iterations: u64,
    /// Whether the last search found no direction to go at once: nothing is left but rounding, or
    /// else rounding has spoilt the problem.
    pub(crate) settled: bool,
    pub(crate) stuck: bool,
}

impl Default for Smallest {
    fn default() -> Self {
        Self::with(1.0)
    }
}

impl Smallest {
    /// With the smallest eigenvalue that there may be, in units of that of smooth errors.
    pub(crate) fn with(least: f64) -> Self {
        let lowest = Lowest::new(DAMPING * least);
        Self { lowest, iterations: 0, settled: false, stuck: false }
    }

    /// One more iteration of `search`; `false` if there was none to make.
    pub(crate) fn iterate<T: Real>(
        &mut self,
        search: &mut ConjugateGradients<'_, '_, T>,
        control: &Control,
    ) -> Result<bool> {
        if search.is_exhausted() && !search.ritz.is_empty() {
            // All eigenvalues were found: tiny problems have few.
            self.iterations = self.iterations.max(FEWEST_ITERATIONS);
            return Ok(false);
        }
        let went = search.iterate(control)?;
        if went {
            self.iterations += 1;
            self.lowest.push(search.ritz.smallest());
        } else {
            self.settled = search.is_settled();
            self.stuck = search.ritz.is_empty() && !self.settled;
        }
        Ok(went)
    }

    /// The largest error, before the step that `search` has found is made.
    pub(crate) fn error<T: Real>(&self, search: &ConjugateGradients<'_, '_, T>) -> f64 {
        search.found() + self.left(search)
    }

    /// The share of b · S⁻¹ b that x · b lacks, at most: what is left is e · S e with e = S⁻¹ r, no more
    /// than r · P⁻¹ r over the smallest eigenvalue of P⁻¹S.
    pub(crate) fn lack<T: Real>(&self, search: &ConjugateGradients<'_, '_, T>) -> f64 {
        let left = self.lowest.over(search.square());
        if left.is_finite() { left / (search.energy + left) } else { 1.0 }
    }

    /// What is left of the error once the step that `search` has found is made.
    pub(crate) fn left<T: Real>(&self, search: &ConjugateGradients<'_, '_, T>) -> f64 {
        self.lowest.over(search.largest())
    }
}
