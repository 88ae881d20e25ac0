//! Laws of draws: b has the covariance S, and the change of M is the transpose of the pull of a functional.

use super::*;
use crate::exposures::{Flux, FluxKind, Mask, Measurements, Positions, Variance};
use crate::frames::Stack;
use crate::geometry::Rotation;
use crate::parallel::dot;
use crate::testing::{SENSOR, SHIFTS, assert_unit_and_independent, random_number, random_vector};
use crate::uncertainty::sampling::LACK_OF_DRAW;

const ROTATIONS: [Rotation; 5] =
    [Rotation::None, Rotation::None, Rotation::Half, Rotation::Quarter, Rotation::None];
const FLUX: [f64; 5] = [1.0, 0.5, 0.9, 1.2, 0.7];
/// So that no weight, and no root of one, is 1.
const VARIANCES: [f64; 5] = [4e-6, 9e-5, 2e-6, 5e-4, 3e-5];
/// The variance of a value of weight 1, by which priors are weighted.
const UNIT: f64 = 0.3;
const DRAWS: u64 = 1000;
/// What the solution of a system may lack, as a share of x · b.
const LACK: f64 = 1e-12;

/// What is sought besides M and the beam.
#[derive(Clone)]
struct Case {
    kind: FluxKind,
    turned: bool,
    offset: bool,
    shift_std: Option<f64>,
    refined: bool,
    /// Whether some pixels have a prior.
    held: bool,
}

impl Case {
    const fn of(kind: FluxKind) -> Self {
        Self { kind, turned: false, offset: false, shift_std: None, refined: false, held: false }
    }

    fn all() -> [Self; 7] {
        let known = Self::of(FluxKind::Known);
        let prior = FluxKind::Prior(vec![1e-3, 2e-4, 5e-4, 1e-3, 3e-4]);
        [
            Self { turned: true, ..Self::of(FluxKind::Free) },
            Self { turned: true, ..Self::of(prior) },
            Self::of(FluxKind::Linear(vec![0.0, 3.0, 1.0, 4.0, 2.0])),
            Self { offset: true, ..known.clone() },
            Self { shift_std: Some(2e-3), refined: true, ..known.clone() },
            Self { shift_std: Some(2e-3), ..known.clone() },
            Self { held: true, ..known },
        ]
    }

    /// Calls `visit` with the covariance at a fit.
    fn visit(&self, visit: impl FnOnce(&mut JointCovariance<'_, '_, f64>, &Control)) {
        let (workers, control) = (Workers::new(None).unwrap(), Control::new());
        let (count, frames) = (SHIFTS.len(), self.frames());
        let measurements = Measurements {
            frames: Stack::new("frames", &frames, count, SENSOR).unwrap(),
            variance: Variance::Exposures(&VARIANCES),
            mask: Mask::None,
        };
        let rotations = if self.turned { ROTATIONS } else { [Rotation::None; 5] };
        let std = self.shift_std.map(|std| vec![[std, 2.0 * std]; count]);
        let positions = Positions { shifts: SHIFTS.to_vec(), rotations: rotations.to_vec(), std };
        let flux = Flux { values: FLUX.to_vec(), kind: self.kind.clone() };
        let exposures =
            Exposures::new(measurements, positions, flux, self.offset, &workers, &control).unwrap();
        let options = crate::Options::default();
        let fit = crate::calibrate(&exposures, &options, None, &workers, &control).unwrap();
        let refinement = if self.refined { Refinement::Done } else { Refinement::Undetermined };
        // Of the size of D, some 5e5.
        let weight =
            |i: usize| if i.is_multiple_of(3) { 3e5 * (1.5 + random_number(i)) } else { 0.0 };
        let prior = self.held.then(|| (0..SENSOR.len()).map(weight).collect());
        let solution = Solution { refinement, unit: UNIT, prior, ..fit.solution() };
        let covariance = JointCovariance::new(&exposures, &solution, &workers, &control);
        visit(&mut covariance.unwrap(), &control);
    }

    /// c L M + O of a wavy beam at the positions.
    fn frames(&self) -> Vec<f64> {
        let value = |index: usize| {
            let (k, pixel) = (index / SENSOR.len(), index % SENSOR.len());
            let p = [(pixel / SENSOR.cols) as f64, (pixel % SENSOR.cols) as f64];
            let rotation = if self.turned { ROTATIONS[k] } else { Rotation::None };
            let u = rotation.to_beam(p, SENSOR);
            let [row, col] = [0, 1].map(|axis| u[axis] + SHIFTS[k][axis]);
            let light = 1.0 + 0.2 * (0.5 * row + 0.2 * col).sin() * (0.4 * col - 0.1 * row).cos();
            let offset = if self.offset { 0.1 * random_number(pixel + 7000) } else { 0.0 };
            FLUX[k] * light * (1.0 + 0.1 * random_number(pixel)) + offset
        };
        (0..SHIFTS.len() * SENSOR.len()).map(value).collect()
    }
}

/// Steps of the cells, of each flux and of each shift alone, and of each of these together with cells.
fn directions(system: &mut System<'_, '_, f64>, control: &Control) -> Vec<Vec<f64>> {
    let (cells, size) = (system.state.beam.len(), system.size());
    let of_cells = (1..4).map(|seed| {
        let mut step = random_vector(size, seed);
        step[cells..].fill(0.0);
        step
    });
    let alone = (cells..size).map(|unknown| {
        let mut step = vec![0.0; size];
        step[unknown] = 1.0;
        step
    });
    let mut steps: Vec<Vec<f64>> = alone.collect();
    let with_cells: Vec<_> = steps.iter().map(|step| coupled(system, step, control)).collect();
    steps.extend(with_cells);
    of_cells.chain(steps).collect()
}

/// A step of one parameter, and that of the cells that it pulls, of equal energies: S couples both, so a
/// draw whose parts have the covariances of their blocks alone has another variance along it.
fn coupled(system: &mut System<'_, '_, f64>, step: &[f64], control: &Control) -> Vec<f64> {
    let cells = system.state.beam.len();
    let mut pulled = product(system, step, control).unwrap();
    let own = dot(step, &pulled);
    pulled[cells..].fill(0.0);
    let of_cells = dot(&pulled, &product(system, &pulled, control).unwrap());
    let unit = |(own_part, pulled): (&f64, &f64)| own_part / own.sqrt() + pulled / of_cells.sqrt();
    step.iter().zip(&pulled).map(unit).collect()
}

#[test]
fn draws_have_the_covariance_of_the_problem_and_are_independent() {
    for case in Case::all() {
        case.visit(|covariance, control| {
            let directions = directions(&mut covariance.system, control);
            let draws: Vec<Vec<f64>> =
                (0..DRAWS).map(|draw| covariance.draw(draw, control).unwrap()).collect();
            for x in directions {
                let kept = dot(&x, &product(&mut covariance.system, &x, control).unwrap());
                let energy = kept + covariance.system.left_out(&x);
                let heights: Vec<f64> = draws.iter().map(|b| dot(&x, b) / energy.sqrt()).collect();
                assert_unit_and_independent(&heights);
            }
        });
    }
}

#[test]
fn the_change_of_a_draw_is_the_transpose_of_the_pull_of_a_functional() {
    for case in Case::all() {
        case.visit(|covariance, control| {
            let (pixels, size) = (covariance.valid.len(), covariance.system.size());
            let shifts = covariance.considered_variances().len();
            let (mut x, gain) = (random_vector(size, 11), random_vector(pixels, 12));
            // A prior holds the multiple of the beam, so that no solution contains it.
            let cells = covariance.system.state.beam.len();
            if case.held {
                covariance.system.take_scale_out(&mut x[..cells]);
            }
            let wrong: Vec<f64> = random_vector(shifts, 13).iter().map(|z| 0.1 * z).collect();
            // b = S x + S_d δ, which x solves.
            let whole = [&x[..], &wrong].concat();
            let b = if covariance.considered.is_some() {
                covariance.considering(|system| product(system, &whole, control)).unwrap()
            } else {
                product(&mut covariance.system, &whole, control).unwrap()
            };
            let mut in_gauge = gain.clone();
            covariance.tilts().gauge.transpose(&mut in_gauge, covariance.system.pass.workers);
            let (pull, seen) = covariance.pull_of_gain(&in_gauge, control).unwrap();
            let wanted = dot(&pull, &x) + dot(&seen, &wrong);
            let variance = covariance.variance_of_gain(gain.clone(), 1e-4, control).unwrap();
            let mut energies = Vec::new();
            // The second is for searches in single precision, where they serve.
            for lack in [LACK, LACK_OF_DRAW] {
                let change = covariance.change(b[..size].to_vec(), &wrong, lack, control).unwrap();
                // By Cauchy and Schwarz in the norm of S, where the solution is off by √lack of itself.
                let allowed = (lack * covariance.energy * variance).sqrt();
                let off = (dot(&gain, &change) - wanted).abs();
                assert!(off <= allowed, "{off:e} of {wanted:e}, above {allowed:e}");
                energies.push(covariance.energy);
            }
            assert!((energies[1] / energies[0] - 1.0).abs() <= LACK_OF_DRAW, "{energies:?}");
        });
    }
}
