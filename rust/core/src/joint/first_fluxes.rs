//! Where a search for free fluxes begins: at those of equal pixels.
//!
//! Gauss-Newton steps do not find fluxes that are a few times what they begin at. With M = 1,
//!
//! ```text
//! ln y_k(u) = ln L(u) + ln c_k,   of weight ω = w y²
//! ```
//!
//! is linear in the logarithms, and the noise of pixels averages out over few cells. Beside the fluxes c₀ given,
//!
//! ```text
//! Σ_u (diag ω − ω ωᵀ/Σω) ln (c/c₀) = Σ_u ω (ln (y/c₀) − Σ ω ln (y/c₀)/Σω)
//! ```
//!
//! Logarithms that are affine in the shifts are found too, which the fit leaves to the gauge (`joint/flux.rs`).

use crate::control::Control;
use crate::error::Result;
use crate::exposures::{Exposures, Stretch};
use crate::frames::Real;
use crate::geometry::Placement;
use crate::linalg::Cholesky;

/// Cells that are looked at, evenly over the beam.
const CELLS: usize = 1 << 16;
/// Upper limit on the pairs of measurements of a cell that are summed.
const MOST_PAIRS: usize = 1 << 28;
/// Added to the diagonal, as a share of the largest: what no cell tells of fluxes stays as given.
const RIDGE: f64 = 1e-9;

/// What one exposure measured of a cell.
struct Seen {
    exposure: usize,
    /// ln (y/c₀), in units of the brightest value: values in another unit must give the same bits.
    log: f64,
    weight: f64,
}

/// The fluxes of equal pixels; where no cell determines one, the flux given.
///
/// # Errors
/// [`Error::Cancelled`](crate::Error::Cancelled).
pub(crate) fn first_fluxes<T: Real>(
    exposures: &Exposures<'_, T>,
    control: &Control,
) -> Result<Vec<f64>> {
    let count = exposures.count();
    // Its lower triangle: exposures of a cell come in their order.
    let mut matrix = vec![vec![0.0; count]; count];
    let mut logs = vec![0.0; count];
    for_each_cell(exposures, control, |cell| {
        let total: f64 = cell.iter().map(|seen| seen.weight).sum();
        let mean = cell.iter().map(|seen| seen.weight * seen.log).sum::<f64>() / total;
        for (index, one) in cell.iter().enumerate() {
            logs[one.exposure] += one.weight * (one.log - mean);
            let row = &mut matrix[one.exposure];
            row[one.exposure] += one.weight;
            for other in &cell[..=index] {
                row[other.exposure] -= one.weight * other.weight / total;
            }
        }
    })?;
    let largest = (0..count).map(|k| matrix[k][k]).fold(f64::MIN_POSITIVE, f64::max);
    let mut entries = Vec::with_capacity(count * (count + 3) / 2);
    for (row, values) in matrix.iter().enumerate() {
        entries.push((row as u32, row as u32, RIDGE * largest));
        let lower = values[..=row].iter().enumerate();
        entries.extend(lower.map(|(col, value)| (row as u32, col as u32, *value)));
    }
    match Cholesky::new(count, &entries) {
        Some(factor) => factor.substitute(&mut logs),
        None => logs.fill(0.0),
    }
    Ok(exposures.flux().iter().zip(&logs).map(|(c, log)| c * log.exp()).collect())
}

/// Calls `visit` with the measurements of each cell that more than one exposure has seen, at the nearest whole shifts.
fn for_each_cell<T: Real>(
    exposures: &Exposures<'_, T>,
    control: &Control,
    mut visit: impl FnMut(&[Seen]),
) -> Result<()> {
    let (geometry, sensor, flux) = (exposures.geometry(), exposures.sensor(), exposures.flux());
    let beam = geometry.beam;
    let brightest = exposures.brightest();
    let most = (MOST_PAIRS / flux.len().pow(2)).clamp(1, CELLS);
    let step = (beam.len() / most).isqrt().max(1);
    let mut cell = Vec::new();
    for row in (0..beam.rows).step_by(step) {
        control.check()?;
        for col in (0..beam.cols).step_by(step) {
            let of_exposure = |(exposure, place): (usize, &Placement)| {
                let view = &geometry.views[place.view];
                let at = view.places.at(row, col);
                let row = (at / view.shape.cols).checked_sub(place.row)?;
                let col = (at % view.shape.cols).checked_sub(place.col)?;
                if row >= sensor.rows || col >= sensor.cols {
                    return None;
                }
                let mut scratch = [0.0];
                let (value, weight) =
                    match exposures.stretch(exposure, row, col..col + 1, &mut scratch) {
                        Stretch::Uniform(values, weight) => (values[0].to_f64(), weight),
                        Stretch::Weighted(values, weights) => (values[0].to_f64(), weights[0]),
                    };
                let light = value / brightest / flux[exposure];
                let seen = Seen { exposure, log: light.ln(), weight: weight * value * value };
                (weight > 0.0 && light > 0.0).then_some(seen)
            };
            let placed = geometry.placements.iter().enumerate();
            cell.clear();
            cell.extend(placed.filter_map(of_exposure));
            if cell.len() > 1 {
                visit(&cell);
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exposures::{Flux, FluxKind, Mask, Measurements, Positions, Variance};
    use crate::frames::{Shape, Stack};
    use crate::geometry::Rotation;
    use crate::parallel::Workers;
    use crate::testing::random_number;

    const SENSOR: Shape = Shape::new(40, 40);
    const SHIFTS: [[f64; 2]; 5] =
        [[0.0, 0.0], [7.0, -12.0], [-9.0, 5.0], [3.0, 16.0], [-4.2, -1.7]];
    const TURNED: [Rotation; 5] = [
        Rotation::None,
        Rotation::Quarter,
        Rotation::Half,
        Rotation::ThreeQuarters,
        Rotation::None,
    ];

    /// Those of exposures that a lamp of these fluxes made of a beam with a slope; every third value of the first is
    /// masked.
    fn found(flux: &[f64], rotations: [Rotation; 5]) -> Vec<f64> {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        let positions =
            Positions { shifts: SHIFTS.to_vec(), rotations: rotations.to_vec(), std: None };
        let mut frames = Vec::new();
        for (k, c) in flux.iter().enumerate() {
            for pixel in 0..SENSOR.len() {
                let place = [pixel / SENSOR.cols, pixel % SENSOR.cols].map(|at| at as f64);
                let [row, col] = rotations[k].to_beam(place, SENSOR);
                let [row, col] = [row + SHIFTS[k][0], col + SHIFTS[k][1]];
                let m = 1.0 + 0.05 * random_number(pixel);
                frames.push(c * m * (1.0 + 0.01 * row + 0.1 * (col / 9.0).sin()));
            }
        }
        let masked: Vec<bool> =
            (0..frames.len()).map(|at| at < SENSOR.len() && at % 3 == 0).collect();
        let stack = Stack::new("frames", &frames[..], flux.len(), SENSOR).unwrap();
        let measurements = Measurements {
            frames: stack,
            variance: Variance::Unknown,
            mask: Mask::Measurements(&masked),
        };
        let lamp = Flux { values: vec![1.0; flux.len()], kind: FluxKind::Free };
        let exposures =
            Exposures::new(measurements, positions, lamp, false, &workers, &control).unwrap();
        first_fluxes(&exposures, &control).unwrap()
    }

    #[test]
    fn they_are_those_of_the_lamp() {
        let flux = [1.0, 0.1, 2.0, 0.3, 7.0];
        for rotations in [[Rotation::None; 5], TURNED] {
            let found = found(&flux, rotations);
            for (c, wanted) in found.iter().map(|c| c / found[0]).zip(&flux) {
                // A scatter of M of 3 % over some 500 pixels, of two exposures each, and 0.3 cells of the beam.
                assert!((c / wanted - 1.0).abs() < 0.01, "{c} {wanted}");
            }
        }
    }
}
