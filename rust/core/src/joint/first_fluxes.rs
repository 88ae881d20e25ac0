//! Where a search for free fluxes begins: at those of equal pixels.
//!
//! Gauss-Newton steps do not find fluxes that are a few times what they begin at. With M = 1 two exposures show the
//! same light in the cells u that both see, but for their fluxes:
//!
//! ```text
//! ln c_k − ln c_l = ln (S_kl/S_lk),   S_kl = Σ_u ω y_k,   ω = w_k w_l/(w_k + w_l)
//! ```
//!
//! with y in units of the flux given, and w that goes with it. The sums are linear in y: noise and unequal pixels
//! average out, and values below 0 count as they are. The logarithm of such a ratio has the variance Σω/(S_kl S_lk) if
//! the fluxes given are nearly right; by these ln c is the least-squares solution of all pairs with light.
//!
//! What is affine in the shifts is found too, which the fit leaves to the gauge (`joint/flux.rs`).

use crate::control::Control;
use crate::error::Result;
use crate::exposures::{Exposures, Stretch};
use crate::frames::Real;
use crate::geometry::Placement;
use crate::linalg::Cholesky;

/// Upper limit on the cells that are looked at, evenly over the beam.
const MOST_CELLS: usize = 1 << 18;
/// Upper limit on the pairs of measurements of a cell that are summed.
const MOST_PAIRS: usize = 1 << 28;
/// Added to the diagonal, as a share of itself: a factor common to exposures that no others are tied to stays as given.
const RIDGE: f64 = 1e-12;

/// What one exposure measured of a cell.
struct Seen {
    exposure: usize,
    /// y/c₀.
    light: f64,
    weight: f64,
}

/// What two exposures measured of the cells that both see.
#[derive(Clone, Copy, Default)]
struct Pair {
    /// S of the one and of the other.
    light: [f64; 2],
    /// Σω.
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
    let mut pairs: Vec<_> = (0..count).map(|others| vec![Pair::default(); others]).collect();
    for_each_cell(exposures, control, |cell| {
        for (index, one) in cell.iter().enumerate() {
            for other in &cell[..index] {
                let weight = one.weight * (other.weight / (one.weight + other.weight));
                let pair = &mut pairs[one.exposure][other.exposure];
                pair.light[0] += weight * one.light;
                pair.light[1] += weight * other.light;
                pair.weight += weight;
            }
        }
    })?;
    let (mut matrix, mut logs) = (Vec::new(), vec![0.0; count]);
    let mut diagonal = vec![0.0; count];
    for (k, of_exposure) in pairs.iter().enumerate() {
        for (l, Pair { light: [one, other], weight }) in of_exposure.iter().enumerate() {
            // Noise alone tells nothing.
            if *one > 0.0 && *other > 0.0 {
                let precision = one / weight * other;
                let pull = precision * (one / other).ln();
                matrix.push((k as u32, l as u32, -precision));
                for (exposure, pull) in [(k, pull), (l, -pull)] {
                    diagonal[exposure] += precision;
                    logs[exposure] += pull;
                }
            }
        }
    }
    matrix.extend(diagonal.iter().enumerate().map(|(k, &own)| {
        let own = if own > 0.0 { own * (1.0 + RIDGE) } else { 1.0 };
        (k as u32, k as u32, own)
    }));
    match Cholesky::new(count, &matrix) {
        Some(factor) => factor.substitute(&mut logs),
        // Only numbers near the ends of what a double holds: the fluxes given are as good.
        None => logs.fill(0.0),
    }
    Ok(exposures.flux().iter().zip(&logs).map(|(c, log)| c * log.exp()).collect())
}

/// Calls `visit` with the measurements of cells, at the nearest whole shifts.
fn for_each_cell<T: Real>(
    exposures: &Exposures<'_, T>,
    control: &Control,
    mut visit: impl FnMut(&[Seen]),
) -> Result<()> {
    let (geometry, sensor, flux) = (exposures.geometry(), exposures.sensor(), exposures.flux());
    let beam = geometry.beam;
    let most = (MOST_PAIRS / flux.len().pow(2)).clamp(1, MOST_CELLS);
    // An odd one meets all colours of a filter array.
    let step = (beam.len() as f64 / most as f64).sqrt().ceil() as usize | 1;
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
                let c = flux[exposure];
                let seen = Seen { exposure, light: value / c, weight: weight * c * c };
                (weight > 0.0).then_some(seen)
            };
            let placed = geometry.placements.iter().enumerate();
            cell.clear();
            cell.extend(placed.filter_map(of_exposure));
            visit(&cell);
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
    const UNTURNED: [Rotation; 5] = [Rotation::None; 5];
    const TURNED: [Rotation; 5] = [
        Rotation::None,
        Rotation::Quarter,
        Rotation::Half,
        Rotation::ThreeQuarters,
        Rotation::None,
    ];
    const LAMP: [f64; 5] = [1.0, 0.1, 2.0, 0.3, 7.0];
    const STD: f64 = 1e-3;

    /// Those of exposures that a lamp made of a beam with a slope, with noise of these standard deviations. Every third
    /// value of the first is masked, and some of the others are none.
    fn found(shifts: &[[f64; 2]], rotations: &[Rotation], given: &[f64], std: &[f64]) -> Vec<f64> {
        let mut frames = Vec::new();
        for (k, shift) in shifts.iter().enumerate() {
            for pixel in 0..SENSOR.len() {
                let place = [pixel / SENSOR.cols, pixel % SENSOR.cols].map(|at| at as f64);
                let [row, col] = rotations[k].to_beam(place, SENSOR);
                let [row, col] = [row + shift[0], col + shift[1]];
                let m = 1.0 + 0.05 * random_number(pixel);
                // Above 1 all over the beam.
                let light = LAMP[k] * m * (1.4 + 0.01 * row + 0.1 * (col / 9.0).sin());
                // Of variance 1: uniform numbers have 1/3.
                let noise = 3.0_f64.sqrt() * random_number(frames.len() + 7000);
                frames.push(light + std[k] * noise);
            }
        }
        let masked: Vec<bool> =
            (0..frames.len()).map(|at| at < SENSOR.len() && at % 3 == 0).collect();
        frames.iter_mut().skip(SENSOR.len()).step_by(97).for_each(|value| *value = f64::NAN);
        of_frames(&frames, SENSOR, shifts, rotations, given, std, Mask::Measurements(&masked))
    }

    fn of_frames(
        frames: &[f64],
        sensor: Shape,
        shifts: &[[f64; 2]],
        rotations: &[Rotation],
        given: &[f64],
        std: &[f64],
        mask: Mask<'_>,
    ) -> Vec<f64> {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        let variances: Vec<f64> = std.iter().map(|std| std * std).collect();
        let frames = Stack::new("frames", frames, shifts.len(), sensor).unwrap();
        let measurements = Measurements { frames, variance: Variance::Exposures(&variances), mask };
        let positions =
            Positions { shifts: shifts.to_vec(), rotations: rotations.to_vec(), std: None };
        let lamp = Flux { values: given.to_vec(), kind: FluxKind::Free };
        let exposures =
            Exposures::new(measurements, positions, lamp, false, &workers, &control).unwrap();
        first_fluxes(&exposures, &control).unwrap()
    }

    /// Whether all fluxes but `except` are those of the lamp: M scatters by 3 % over some 500 pixels of each of two
    /// exposures, and the beam changes by 1 % over 0.3 cells.
    fn are_those_of_the_lamp(found: &[f64], except: Option<usize>) -> bool {
        let off = |k: usize| (found[k] / found[0] / LAMP[k]).ln().abs();
        (0..found.len()).filter(|k| Some(*k) != except).all(|k| off(k) < 0.01)
    }

    #[test]
    fn they_are_those_of_the_lamp_whatever_was_given() {
        for rotations in [UNTURNED, TURNED] {
            for given in [[1.0; 5], [4.0, 1.0, 0.2, 1.0, 30.0]] {
                let found = found(&SHIFTS, &rotations, &given, &[STD; 5]);
                assert!(are_those_of_the_lamp(&found, None), "{found:?}");
            }
        }
    }

    #[test]
    fn noise_above_the_light_moves_one_flux_as_far_as_it_must() {
        for (noisy, times) in [(1, 3.0), (4, 3.0), (4, 10.0)] {
            let mut std = [STD; 5];
            std[noisy] = times * LAMP[noisy];
            let found = found(&SHIFTS, &UNTURNED, &[1.0; 5], &std);
            assert!(are_those_of_the_lamp(&found, Some(noisy)), "{found:?}");
            // Its light is above the lamp's, and others see at least 28 times 24 of its pixels: three standard deviations.
            let off = (found[noisy] / found[0] / LAMP[noisy]).ln().abs();
            assert!(off < 3.0 * times / (28.0_f64 * 24.0).sqrt(), "{off}");
        }
    }

    #[test]
    fn exposures_without_light_in_common_stay_as_given() {
        // Most values are above 0, and those below outweigh them.
        let dark = |pixel: usize| if pixel % 5 < 3 { 0.01 } else { -0.1 };
        let frames: Vec<f64> =
            (0..2 * 1600).map(|at| if at < 1600 { 1.0 } else { dark(at) }).collect();
        let shifts = [[0.0, 0.0], [3.0, 5.0]];
        let of = |frames: &[f64]| {
            of_frames(frames, SENSOR, &shifts, &UNTURNED[..2], &[1.0, 0.3], &[1.0; 2], Mask::None)
        };
        assert_eq!(of(&frames), [1.0, 0.3]);
    }

    #[test]
    fn all_colours_of_a_filter_array_count_on_a_large_sensor() {
        let sensor = Shape::new(600, 602);
        assert!(sensor.len() > MOST_CELLS);
        let colour = |pixel: usize| {
            if (pixel / sensor.cols + pixel % sensor.cols).is_multiple_of(2) { 1.0 } else { 0.2 }
        };
        let frames: Vec<f64> =
            (0..2).flat_map(|k| (0..sensor.len()).map(move |at| LAMP[k] * colour(at))).collect();
        let shifts = [[0.0, 0.0], [1.0, 0.0]];
        let found =
            of_frames(&frames, sensor, &shifts, &UNTURNED[..2], &[1.0; 2], &[1.0; 2], Mask::None);
        // One row more of one colour than of the other, of the 200 that are looked at.
        assert!((found[1] / found[0] / LAMP[1]).ln().abs() < 1.0 / 200.0, "{found:?}");
    }

    #[test]
    fn what_no_common_cell_determines_stays_as_given() {
        // Two pairs that see no cell of each other.
        let shifts = [[-20.0, 0.0], [-18.0, 3.0], [22.0, 3.0], [25.0, 1.0]];
        let given = [1.0, 1.0, 4.0, 4.0];
        let found = found(&shifts, &UNTURNED[..4], &given, &[STD; 4]);
        for [one, other] in [[0, 1], [2, 3]] {
            let ratio = found[other] / found[one] / (LAMP[other] / LAMP[one]);
            assert!((ratio - 1.0).abs() < 0.02, "{found:?}");
            // Of both the weights are alike.
            let both = found[one] * found[other] / (given[one] * given[other]);
            assert!((both - 1.0).abs() < 0.02, "{found:?}");
        }
    }
}
