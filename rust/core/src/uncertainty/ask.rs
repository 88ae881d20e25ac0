//! The questions that can be asked of a fit.

use super::joint::JointCovariance;
use super::reduced::ReducedCovariance;
use super::sampling::{ErrorMap, NEGLIGIBLE};
use crate::control::Control;
use crate::error::{Error, Result};
use crate::exposures::Exposures;
use crate::fit::{Fit, Solution};
use crate::frames::Real;
use crate::parallel::Workers;

/// The uncertainty of a fit, ready for questions.
///
/// All answers are in units of the variance of a value of weight 1, which is [`Fit::unit`].
pub struct Uncertainty<'m, 'a, T> {
    problem: Problem<'m, 'a, T>,
    pixels: usize,
    control: &'m Control,
}

/// The linear problem at the solution.
enum Problem<'m, 'a, T> {
    Reduced(Box<ReducedCovariance<'m, 'a, T>>),
    Joint(Box<JointCovariance<'m, 'a, T>>),
}

impl<'m, 'a, T: Real> Uncertainty<'m, 'a, T> {
    /// That of the solution of a fit of `exposures`, whose variances are those of the noise.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) if it belongs to other exposures,
    /// [`Error::Memory`](crate::Error::Memory) if the memory for it cannot be had,
    /// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop, here and below.
    pub fn new(
        exposures: &'m Exposures<'a, T>,
        solution: &Solution<'m>,
        workers: &'m Workers,
        control: &'m Control,
    ) -> Result<Self> {
        solution.check(exposures)?;
        let problem = if solution.joint {
            let joint = JointCovariance::new(exposures, solution, workers, control)?;
            Problem::Joint(Box::new(joint))
        } else {
            let reduced = ReducedCovariance::new(exposures, solution, workers, control)?;
            Problem::Reduced(Box::new(reduced))
        };
        Ok(Self { problem, pixels: exposures.sensor().len(), control })
    }

    /// The same with the noise of a dark that was subtracted from all exposures, of these variances by
    /// pixel, in units of the variance of a value of weight 1. The weights must be those without it.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) if they are not one for each pixel,
    /// [`Error::Value`](crate::Error::Value) if one is no number or below 0.
    pub fn with_dark(mut self, variance: &[f64]) -> Result<Self> {
        check_dark(variance, self.pixels)?;
        match &mut self.problem {
            Problem::Reduced(problem) => problem.set_dark(variance, self.control)?,
            Problem::Joint(problem) => problem.set_dark(variance, self.control)?,
        }
        Ok(self)
    }

    /// How many searches of the answers so far ended before they were as exact as they should be: the
    /// measurements barely constrain some pattern, and variances that it is part of are too small.
    #[must_use]
    pub fn incomplete(&self) -> u64 {
        match &self.problem {
            Problem::Reduced(problem) => problem.incomplete(),
            Problem::Joint(problem) => problem.incomplete(),
        }
    }

    /// The standard deviation of M in each pixel.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn error_map(&mut self) -> Result<ErrorMap> {
        match &mut self.problem {
            Problem::Reduced(problem) => problem.error_map(self.control),
            Problem::Joint(problem) => problem.error_map(self.control),
        }
    }

    /// The variance of each linear functional Σ g(p) M(p), its g being an image of `functionals`.
    ///
    /// It is that in the gauge mean(M) = 1. A g must be 0 where M is undetermined, and in pixels that
    /// their measurements leave almost no weight.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn variances(&mut self, functionals: &[f64]) -> Result<Vec<f64>> {
        match &mut self.problem {
            Problem::Reduced(problem) => problem.variances(functionals, self.control),
            Problem::Joint(problem) => problem.variances(functionals, self.control),
        }
    }

    /// The variances (row, column) of the shifts that were refined; `None` if none were.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn shift_variances(&mut self) -> Result<Option<Vec<[f64; 2]>>> {
        match &mut self.problem {
            Problem::Reduced(_) => Ok(None),
            Problem::Joint(problem) => problem.shift_variances(self.control),
        }
    }

    /// The variance of b, the least-squares part b M of the errors of all offsets, and the mean
    /// variance of an offset by the noise of its pixel alone; `None` if no offset was sought.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn offset_variances(&mut self) -> Result<Option<[f64; 2]>> {
        match &mut self.problem {
            Problem::Reduced(_) => Ok(None),
            Problem::Joint(problem) => problem.offset_variances(self.control),
        }
    }
}

/// What the noise of a dark that was subtracted from all exposures, of these variances by pixel, adds on average to F,
/// the sum of squared residuals of the solution; nothing where offsets were sought. The weights must be those without it.
///
/// The linear problem, which takes as much memory as the fit, is set up only where this is not negligible.
///
/// # Errors
/// As [`Uncertainty::new`] and [`Uncertainty::with_dark`].
pub fn misfit_by_dark<'m, T: Real>(
    exposures: &'m Exposures<'_, T>,
    solution: &Solution<'m>,
    variance: &[f64],
    workers: &'m Workers,
    control: &'m Control,
) -> Result<f64> {
    check_dark(variance, exposures.sensor().len())?;
    if exposures.offset() {
        return Ok(0.0);
    }
    let left = solution.left_of_common(exposures, variance, workers, control)?;
    let pixels = solution.sensitivity.iter().filter(|m| m.is_finite()).count();
    if left <= NEGLIGIBLE * pixels as f64 {
        return Ok(left);
    }
    let bars = Uncertainty::new(exposures, solution, workers, control)?.with_dark(variance)?;
    match bars.problem {
        Problem::Reduced(mut problem) => problem.misfit_by_dark(control),
        Problem::Joint(mut problem) => problem.misfit_by_dark(control),
    }
}

fn check_dark(variance: &[f64], pixels: usize) -> Result<()> {
    if variance.len() != pixels {
        return Err(Error::Shape {
            argument: "dark_variance",
            got: format!("{} values", variance.len()),
            wanted: format!("{pixels}, one for each pixel"),
        });
    }
    match variance.iter().find(|v| !(v.is_finite() && **v >= 0.0)) {
        None => Ok(()),
        Some(wrong) => Err(Error::Value {
            argument: "dark_variance",
            problem: format!("holds {wrong}, expected finite numbers not below 0"),
        }),
    }
}

impl Fit {
    /// Its uncertainty, set up once and asked often, from the `exposures` that it was made from.
    ///
    /// # Errors
    /// As [`Uncertainty::new`].
    pub fn uncertainty<'m, 'a, T: Real>(
        &'m self,
        exposures: &'m Exposures<'a, T>,
        workers: &'m Workers,
        control: &'m Control,
    ) -> Result<Uncertainty<'m, 'a, T>> {
        Uncertainty::new(exposures, &self.solution(), workers, control)
    }
}
