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
        let (values, weights) = weigh(measurements, exposure, row, 0..cols, &mut scratch);
        let (tally, is_plain) = pulp::Arch::new().dispatch(Count { values, weights });
        if is_plain {
            return Ok(tally);
        }
        for (col, (&value, &weight)) in values.iter().zip(weights).enumerate() {
            // A weight of 0 also comes from an infinite variance, which is an error.
            let masked = || mask.is_some_and(|mask| mask[col]);
            let is_used = weight != 0.0 || (!masked() && value.to_f64().is_finite());
            if is_used && !VARIANCES.contains(&(1.0 / weight)) {
                let each = matches!(measurements.variance, Variance::Measurements(_));
                let place =
                    if each { format!(" at row {row}, column {col}") } else { String::new() };
                return Err(bad_variance(exposure, &place, 1.0 / weight));
            }
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

/// Counts measurements, those of a weight above 0; says whether no weight can be an error.
struct Count<'s, T> {
    values: &'s [T],
    weights: &'s [f64],
}

impl<T: Real> pulp::NullaryFnOnce for Count<'_, T> {
    type Output = (Tally, bool);

    #[inline(always)]
    fn call(self) -> (Tally, bool) {
        const LANES: usize = 8;
        let [mut used, mut positive, mut weights, mut largest] = [[0.0_f64; LANES]; 4];
        let mut is_plain = true;
        let mut add = |i: usize, value: f64, weight: f64| {
            let (is_used, size) = (weight > 0.0, value.abs());
            used[i] += f64::from(u8::from(is_used));
            positive[i] += f64::from(u8::from(is_used && value > 0.0));
            weights[i] += weight;
            largest[i] = if is_used && size > largest[i] { size } else { largest[i] };
            is_plain &= weight > 1.0 / VARIANCES.end && weight < 1.0 / VARIANCES.start;
        };
        let (values, last_values) = self.values.as_chunks::<LANES>();
        let (chunks, last_weights) = self.weights.as_chunks::<LANES>();
        for (values, weights) in values.iter().zip(chunks) {
            (0..LANES).for_each(|i| add(i, values[i].to_f64(), weights[i]));
        }
        let last = last_values.iter().zip(last_weights);
        last.for_each(|(value, &weight)| add(0, value.to_f64(), weight));
        let [used, positive] = [used, positive].map(|counts| counts.iter().sum::<f64>() as usize);
        let largest = largest.into_iter().fold(0.0, f64::max);
        (Tally { used, positive, weight: weights.iter().sum(), largest }, is_plain)
    }
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
            let problem = format!(
                "leaves nothing of exposure {exposure}: every pixel of it is masked or not a \
                 number, leave it out"
            );
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exposures::Mask;
    use crate::frames::Stack;

    #[test]
    fn counts_are_those_of_a_plain_loop_and_a_bad_variance_is_named() {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        for width in 1..=20 {
            let shape = Shape::new(2, width);
            let sizes = [3.0, -8.0, f64::NAN, 0.5, 0.0, -0.25, f64::INFINITY];
            let values: Vec<f64> =
                (0..2 * width).map(|i| sizes[i % 7] * (1.0 + i as f64)).collect();
            let mask: Vec<bool> = (0..2 * width).map(|i| i % 5 == 3).collect();
            let mut variances = vec![0.5; 2 * width];
            let tally = |variances: &[f64]| {
                let frames = Stack::new("frames", &values, 1, shape)?;
                let variance = Variance::Measurements(Stack::new("variance", variances, 1, shape)?);
                let measurements = Measurements { frames, variance, mask: Mask::Pixels(&mask) };
                super::tally(&measurements, 0, &workers, &control)
            };
            let used: Vec<f64> = (0..2 * width).filter(|&i| !mask[i]).map(|i| values[i]).collect();
            let used: Vec<f64> = used.into_iter().filter(|value| value.is_finite()).collect();
            let found = tally(&variances).unwrap();
            assert_eq!(found.used, used.len());
            assert_eq!(found.positive, used.iter().filter(|value| **value > 0.0).count());
            assert_eq!(found.weight.to_bits(), (2.0 * used.len() as f64).to_bits());
            assert_eq!(
                found.largest,
                used.iter().fold(0.0, |top: f64, value| top.max(value.abs()))
            );
            for bad in [0.9e-100, 1.1e100, 0.0, -1.0, f64::NAN, f64::INFINITY] {
                for at in 0..2 * width {
                    variances[at] = bad;
                    let is_used = !mask[at] && values[at].is_finite();
                    match tally(&variances) {
                        Ok(_) => assert!(!is_used, "{bad} at {at}"),
                        Err(error) => {
                            let place = format!("row {}, column {}", at / width, at % width);
                            assert!(is_used && error.to_string().contains(&place), "{error}");
                        }
                    }
                    variances[at] = 0.5;
                }
            }
            for good in [1e-100, 0.999e100] {
                variances[2 * width - 1] = good;
                assert!(tally(&variances).is_ok(), "{good}");
            }
        }
    }
}
