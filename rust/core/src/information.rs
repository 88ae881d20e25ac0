//! The information D = Σ w c² L² of each pixel on M: the inverse variance of M with a known beam.

use crate::control::Control;
use crate::error::Result;
use crate::exposures::{Exposures, Stretch};
use crate::frames::Real;
use crate::memory;
use crate::parallel::Workers;

/// D of all pixels, row by row, with the light L that `light(k)` gives of each exposure; light that is
/// not known counts for nothing.
///
/// # Errors
/// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub(crate) fn of_sensor<T: Real>(
    exposures: &Exposures<'_, T>,
    flux: &[f64],
    light: impl Fn(usize) -> Vec<f64>,
    workers: &Workers,
    control: &Control,
) -> Result<Vec<f64>> {
    let mut information = workers.filled(exposures.sensor().len(), 0.0, control);
    gather(exposures, flux, light, &mut information, workers, control, |sum, weight, light| {
        *sum += weight * light * light;
    })?;
    Ok(information)
}

/// The part of F by errors of such variances that all exposures share, M eliminated, with λ of `prior`:
///
/// ```text
/// Σ_p v (Σ_k w − (Σ_k w c L)²/(D + λ))
/// ```
///
/// # Errors
/// [`Error::Memory`](crate::Error::Memory) if the memory for it cannot be had; else as [`of_sensor`].
pub(crate) fn left_of_common<T: Real>(
    exposures: &Exposures<'_, T>,
    [flux, prior, variance]: [&[f64]; 3],
    light: impl Fn(usize) -> Vec<f64>,
    workers: &Workers,
    control: &Control,
) -> Result<f64> {
    let (sensor, cols) = (exposures.sensor(), exposures.sensor().cols);
    // Three sums and the light of each pixel.
    memory::check(32 * sensor.len() as u64, || format!("the misfit of the dark of {sensor}"))?;
    let mut moments = workers.filled(sensor.len(), [0.0; 3], control);
    gather(exposures, flux, light, &mut moments, workers, control, |sums, weight, light| {
        let [all, along, square] = sums;
        *all += weight;
        *along += weight * light;
        *square += weight * light * light;
    })?;
    let of_rows = workers.map_blocks(&mut moments, cols, |row, moments| {
        let first = row * cols;
        let of_pixel = |(i, [all, along, square]): (usize, &[f64; 3])| {
            let prior = prior.get(first + i).copied().unwrap_or_default();
            let left = if *square > 0.0 { all - along * (along / (square + prior)) } else { 0.0 };
            // Below 0 only by rounding, where all exposures see the same light.
            variance[first + i] * left.max(0.0)
        };
        moments.iter().enumerate().map(of_pixel).sum::<f64>()
    });
    control.check()?;
    Ok(of_rows.into_iter().sum())
}

/// D of one pixel, likewise, with the fluxes as given.
pub(crate) fn of_pixel<T: Real>(
    exposures: &Exposures<'_, T>,
    pixel: [usize; 2],
    light: impl Fn(usize) -> f64,
) -> f64 {
    let mut sum = [0.0];
    for (k, &flux) in exposures.flux().iter().enumerate() {
        add(exposures, k, pixel, flux, &[light(k)], &mut sum);
    }
    sum[0]
}

/// Adds w c² L² of the measurements of exposure `k` from a pixel on along its row.
pub(crate) fn add<T: Real>(
    exposures: &Exposures<'_, T>,
    k: usize,
    pixel: [usize; 2],
    flux: f64,
    light: &[f64],
    sums: &mut [f64],
) {
    each(exposures, k, pixel, flux, light, |i, weight, light| sums[i] += weight * light * light);
}

/// Calls `take` with what is summed of a pixel, w and c L of each of its measurements, exposure by exposure.
fn gather<T: Real, S: Send>(
    exposures: &Exposures<'_, T>,
    flux: &[f64],
    light: impl Fn(usize) -> Vec<f64>,
    sums: &mut [S],
    workers: &Workers,
    control: &Control,
    take: impl Fn(&mut S, f64, f64) + Sync + Send,
) -> Result<()> {
    let cols = exposures.sensor().cols;
    for (k, &flux) in flux.iter().enumerate() {
        control.check()?;
        let light = light(k);
        workers.map_blocks(sums, cols, |row, sums| {
            if control.is_cancelled() {
                return;
            }
            each(exposures, k, [row, 0], flux, &light[row * cols..][..cols], |i, weight, light| {
                take(&mut sums[i], weight, light);
            });
        });
    }
    control.check()
}

/// Calls `take` with the place along the light, w and c L of the measurements of exposure `k` from a
/// pixel on along its row.
fn each<T: Real>(
    exposures: &Exposures<'_, T>,
    k: usize,
    [row, col]: [usize; 2],
    flux: f64,
    light: &[f64],
    mut take: impl FnMut(usize, f64, f64),
) {
    let mut scratch = vec![0.0; light.len()];
    let weight = match exposures.stretch(k, row, col..col + light.len(), &mut scratch) {
        Stretch::Uniform(_, weight) => Some(weight),
        Stretch::Weighted(..) => None,
    };
    for (i, light) in light.iter().enumerate() {
        let (weight, light) = (weight.unwrap_or(scratch[i]), flux * light);
        // Light that is not known has no number, and a measurement that is not used no weight.
        if weight > 0.0 && light.is_finite() {
            take(i, weight, light);
        }
    }
}
