//! What one exposure contributes, counted in the one check of its values.

use std::ops::Range;

use super::measurements::{Measurements, Variance};
use super::stretch::weigh;
use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::{Real, Shape};
use crate::parallel::Workers;

/// Values whose squares and weights stay far from the ends of what a double holds.
pub(super) const VALUES: Range<f64> = 1e-50..1e50;
/// Variances likewise.
const VARIANCES: Range<f64> = 1e-100..1e100;

/// What one exposure contributes.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Tally {
    pub(super) used: usize,
    positive: usize,
    /// Σ w.
    pub(super) weight: f64,
    pub(super) largest: f64,
}

/// Counts one exposure's measurements and checks their variances.
pub(super) fn tally<T: Real>(
    measurements: &Measurements<'_, T>,
    exposure: usize,
    workers: &Workers,
    control: &Control,
) -> Result<Tally> {
    let shape = measurements.frames.shape();
    let Shape { rows, cols } = shape;
    let by_row = workers.map(rows, |row| {
        control.check()?;
        let mut scratch = vec![0.0; cols];
        let mask = measurements.mask.row(exposure, row, shape);
        let mut tally = Tally::default();
        let (values, weights) = weigh(measurements, exposure, row, 0..cols, &mut scratch);
        for (col, (&value, &weight)) in values.iter().zip(weights).enumerate() {
            // A weight of 0 also comes from an infinite variance, which is an error.
            let masked = || mask.is_some_and(|mask| mask[col]);
            if weight == 0.0 && (masked() || !value.to_f64().is_finite()) {
                continue;
            }
            if !VARIANCES.contains(&(1.0 / weight)) {
                let each = matches!(measurements.variance, Variance::Measurements(_));
                let place =
                    if each { format!(" at row {row}, column {col}") } else { String::new() };
                return Err(bad_variance(exposure, &place, 1.0 / weight));
            }
            tally.used += 1;
            tally.positive += usize::from(value.to_f64() > 0.0);
            tally.weight += weight;
            tally.largest = tally.largest.max(value.to_f64().abs());
        }
        Ok(tally)
    });
    by_row.into_iter().try_fold(Tally::default(), |sum, row| {
        let row = row?;
        Ok(Tally {
            used: sum.used + row.used,
            positive: sum.positive + row.positive,
            weight: sum.weight + row.weight,
            largest: sum.largest.max(row.largest),
        })
    })
}

fn bad_variance(exposure: usize, place: &str, variance: f64) -> Error {
    let problem = format!(
        "of exposure {exposure}{place} is {variance}: expected a positive number from 1e-100 to 1e100"
    );
    Error::value("variance", problem)
}

/// Checks that every exposure has light in it.
pub(super) fn check_light(tallies: &[Tally]) -> Result<()> {
    if tallies.iter().all(|tally| tally.used == 0) {
        let problem = "leaves no measurement: every pixel is masked or not a number";
        return Err(Error::value("mask", problem));
    }
    for (exposure, tally) in tallies.iter().enumerate() {
        if tally.used == 0 {
            let problem = format!("leaves nothing of exposure {exposure}: leave it out");
            return Err(Error::value("mask", problem));
        }
        if tally.largest >= VALUES.end || (tally.largest < VALUES.start && tally.positive > 0) {
            let problem = format!(
                "of exposure {exposure} have a largest value of {:e}: expected 1e-50 to 1e50, \
                 choose another unit",
                tally.largest
            );
            return Err(Error::value("frames", problem));
        }
        if 2 * tally.positive <= tally.used {
            let problem = format!(
                "of exposure {exposure} have a median that is not above 0 ({} of {} values \
                 are positive): is there light, and is the right dark subtracted?",
                tally.positive, tally.used
            );
            return Err(Error::value("frames", problem));
        }
    }
    Ok(())
}
