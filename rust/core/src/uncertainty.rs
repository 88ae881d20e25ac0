//! How far noise may have moved M: the error map, and the error of any linear functional.
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
//! After a joint fit the same is asked of its own linear problem (`joint/covariance.rs`).

use crate::conjugate::{self, Search};
use crate::control::Control;
use crate::error::Result;
use crate::estimate::{FEWEST_ITERATIONS, Smallest};
use crate::frames::Real;
use crate::geometry::{Geometry, View};
use crate::joint::{self, Covariance, Functional, Solved};
use crate::memory;
use crate::model::Model;
use crate::parallel::Workers;
use crate::reduced::{BAND, Padding};

/// The relative standard error of the map, root mean square over its pixels, that draws go on to.
const EXACTNESS: f64 = 0.02;
/// Draws that tell how many it takes.
const FIRST_DRAWS: u64 = 8;
/// Draws that nobody waits for.
const MOST_DRAWS: u64 = 400;
/// The share of x · b that the solution of a draw may lack. Slow errors are a small part of that and
/// a large one of the variance: with crosses (5, 7), (11, 19), (23, 41) and (97, 160) the mean
/// variance was 2, 3, 5 and 14 in 10 000 too small with this, 2, 36, 242 and 934 with 1e-3.
const LACK_OF_DRAW: f64 = 1e-5;
/// That of a functional, which is the share of its variance itself.
const LACK_OF_FUNCTIONAL: f64 = 1e-4;
/// A search that finds no more than this share of what it may lack in ten iterations is at its end.
const NOTHING: f64 = 1e-2;

/// The standard deviation of M, by pixel.
#[derive(Clone, Debug)]
pub struct ErrorMap {
    /// Row by row, in the gauge mean(M) = 1; NaN where M is undetermined.
    pub std: Vec<f64>,
    /// Draws made.
    pub draws: u64,
    /// The relative standard error of `std`, root mean square over the pixels.
    pub exactness: f64,
}

/// The standard deviation of M in each pixel, at the solution M (NaN where undetermined) and L (on
/// the beam grid) of `model`, whose variances are those of the noise.
///
/// # Errors
/// [`Error::Memory`](crate::Error::Memory) if the memory for it cannot be had,
/// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
pub fn error_map<T: Real>(
    model: &Model<'_, T>,
    sensitivity: &[f64],
    beam: &[f64],
    workers: &Workers,
    control: &Control,
) -> Result<ErrorMap> {
    memory::check(bytes_needed(&model.geometry), || {
        format!("the error map of {} exposures of {}", model.count(), model.sensor())
    })?;
    let mut system = System::new(model, sensitivity, beam, workers, control)?;
    let sampled = Sampled::of(&mut system, control)?;
    Ok(sampled.map(system.deviations(&sampled)))
}

/// The standard deviation of M in each pixel after a joint fit of `model`, whose fluxes are those
/// found and whose variances are those of the noise.
///
/// # Errors
/// As [`error_map`].
pub fn error_map_jointly<T: Real>(
    model: &Model<'_, T>,
    solved: &Solved<'_>,
    workers: &Workers,
    control: &Control,
) -> Result<ErrorMap> {
    let mut covariance = prepared(model, solved, workers, control)?;
    let sampled = Sampled::of(&mut covariance, control)?;
    let scale = covariance.scale();
    let std = (0..model.sensor().len()).map(|pixel| match solved.sensitivity[pixel].is_finite() {
        true => (scale * sampled.variance(pixel)).sqrt(),
        false => f64::NAN,
    });
    Ok(sampled.map(std.collect()))
}

/// The variance of each linear functional Σ g(p) M(p), its g being an image of `functionals`.
///
/// It is that in the gauge mean(M) = 1. A g must be 0 where M is undetermined, and in pixels that
/// their measurements leave almost no weight.
///
/// # Errors
/// As [`error_map`].
pub fn variances_of<T: Real>(
    model: &Model<'_, T>,
    sensitivity: &[f64],
    beam: &[f64],
    functionals: &[f64],
    workers: &Workers,
    control: &Control,
) -> Result<Vec<f64>> {
    memory::check(bytes_needed(&model.geometry), || {
        format!("the variance of a functional of {} exposures of {}", model.count(), model.sensor())
    })?;
    let mut system = System::new(model, sensitivity, beam, workers, control)?;
    let stack = functionals.chunks_exact(model.sensor().len()).enumerate();
    let total = (functionals.len() / model.sensor().len()) as u64;
    stack
        .map(|(index, functional)| {
            control.report("uncertainty", index as u64, total);
            system.variance_of(functional, control)
        })
        .collect()
}

/// The variance after a joint fit of each functional Σ g(p) M(p), as [`variances_of`].
///
/// # Errors
/// As [`error_map`].
pub fn variances_of_jointly<T: Real>(
    model: &Model<'_, T>,
    solved: &Solved<'_>,
    functionals: &[f64],
    workers: &Workers,
    control: &Control,
) -> Result<Vec<f64>> {
    let stack = functionals.chunks_exact(model.sensor().len());
    let functionals = stack.map(|gain| Functional::Gain(gain.to_vec()));
    variances(model, solved, functionals, workers, control)
}

/// The variances (row, column) of the shifts that a joint fit refined.
///
/// # Errors
/// As [`error_map`].
pub fn shift_variances<T: Real>(
    model: &Model<'_, T>,
    solved: &Solved<'_>,
    workers: &Workers,
    control: &Control,
) -> Result<Vec<[f64; 2]>> {
    let count = model.count();
    let functionals = (0..2 * count).map(|index| {
        let mut shifts = vec![[0.0; 2]; count];
        shifts.as_flattened_mut()[index] = 1.0;
        Functional::Shifts(shifts)
    });
    let found = variances(model, solved, functionals, workers, control)?;
    Ok(found.as_chunks().0.to_vec())
}

/// The variance of b, the least-squares part b M of the errors of offsets that a joint fit found, and
/// the mean variance of an offset by the noise of its pixel alone.
///
/// # Errors
/// As [`error_map`].
pub fn offset_variances<T: Real>(
    model: &Model<'_, T>,
    solved: &Solved<'_>,
    workers: &Workers,
    control: &Control,
) -> Result<[f64; 2]> {
    let mut covariance = prepared(model, solved, workers, control)?;
    let along = covariance.variance_of(Functional::Offset, LACK_OF_FUNCTIONAL, control)?;
    Ok([along, covariance.mean_variance_of_offset_alone()])
}

fn prepared<'m, 'a, T: Real>(
    model: &'m Model<'a, T>,
    solved: &Solved<'_>,
    workers: &'m Workers,
    control: &'m Control,
) -> Result<Covariance<'m, 'a, T>> {
    memory::check(joint::bytes_needed_by_covariance(model, solved.unknowns), || {
        format!("the uncertainty of {} exposures of {}", model.count(), model.sensor())
    })?;
    Covariance::new(model, solved, workers, control)
}

fn variances<T: Real>(
    model: &Model<'_, T>,
    solved: &Solved<'_>,
    functionals: impl ExactSizeIterator<Item = Functional>,
    workers: &Workers,
    control: &Control,
) -> Result<Vec<f64>> {
    let mut covariance = prepared(model, solved, workers, control)?;
    let total = functionals.len() as u64;
    let found = (0..).zip(functionals).map(|(index, functional)| {
        control.report("uncertainty", index, total);
        covariance.variance_of(functional, LACK_OF_FUNCTIONAL, control)
    });
    found.collect()
}

/// A linear problem that draws can be made of. Images may be padded, all alike.
trait Drawn {
    /// 1 in the pixels that count, else 0.
    fn valid(&self) -> &[f32];
    /// The part of the variance of M that is known.
    fn known(&mut self, control: &Control) -> Result<Vec<f32>>;
    /// Adds the square of the rest of one draw.
    fn add_draw(&mut self, draw: u64, squares: &mut [f32], control: &Control) -> Result<()>;
}

impl<T: Real> Drawn for Covariance<'_, '_, T> {
    fn valid(&self) -> &[f32] {
        self.valid()
    }

    fn known(&mut self, _: &Control) -> Result<Vec<f32>> {
        Ok(Self::known(self))
    }

    fn add_draw(&mut self, draw: u64, squares: &mut [f32], control: &Control) -> Result<()> {
        self.add_draw(draw, LACK_OF_DRAW, squares, control)
    }
}

/// A variance that is known in part, and in part the mean square of draws.
struct Sampled {
    known: Vec<f32>,
    squares: Vec<f32>,
    draws: u64,
    exactness: f64,
}

impl Sampled {
    /// As many draws as it takes.
    fn of(problem: &mut impl Drawn, control: &Control) -> Result<Self> {
        let known = problem.known(control)?;
        let squares = vec![0.0; known.len()];
        let mut sampled = Self { known, squares, draws: 0, exactness: f64::INFINITY };
        let mut wanted = FIRST_DRAWS;
        while sampled.draws < wanted {
            control.report("uncertainty", sampled.draws, wanted);
            problem.add_draw(sampled.draws, &mut sampled.squares, control)?;
            sampled.draws += 1;
            if sampled.draws == wanted {
                let share = sampled.share(problem.valid());
                let needed = (exactness(share, 1) / EXACTNESS).powi(2).ceil() as u64;
                wanted = needed.min(MOST_DRAWS);
                sampled.exactness = exactness(share, sampled.draws);
            }
        }
        control.report("uncertainty", sampled.draws, sampled.draws);
        Ok(sampled)
    }

    fn variance(&self, pixel: usize) -> f64 {
        f64::from(self.known[pixel]) + f64::from(self.squares[pixel]) / self.draws as f64
    }

    /// The root mean square, over the valid pixels, of the share of the variance that is sampled,
    /// without what the scatter of so many draws adds to it.
    fn share(&self, valid: &[f32]) -> f64 {
        let draws = self.draws as f64;
        let mut count = 0.0;
        let mut sum = 0.0;
        for (pixel, &valid) in valid.iter().enumerate() {
            let sampled = f64::from(self.squares[pixel]) / draws;
            let share = sampled / self.variance(pixel).max(f64::MIN_POSITIVE);
            sum += f64::from(valid) * share.powi(2);
            count += f64::from(valid);
        }
        (sum / count * draws / (draws + 2.0)).sqrt()
    }

    const fn map(&self, std: Vec<f64>) -> ErrorMap {
        ErrorMap { std, draws: self.draws, exactness: self.exactness }
    }
}

/// The relative standard error of a deviation of whose square this share is the mean of the squares
/// of so many draws: a square of a normal value scatters by √2 of its mean, and a root halves that.
fn exactness(share: f64, draws: u64) -> f64 {
    0.5 * share * (2.0 / draws as f64).sqrt()
}

/// What both take beside the measurements, in bytes: a search and three images more, a copy of L in
/// each view, and the map.
fn bytes_needed(geometry: &Geometry) -> u64 {
    let padding = Padding::of(geometry);
    let places = |rows| padding.size(rows) as u64;
    let (pixels, cells) = (geometry.sensor.len() as u64, geometry.beam.len() as u64);
    let views = geometry.views.len() as u64;
    let of_views: u64 = geometry.views.iter().map(|view| 8 * places(view.shape.rows)).sum();
    let turned = if views > 1 { of_views } else { 0 };
    let more = 12 * places(geometry.sensor.rows) + turned;
    16 * pixels + more + 8 * views * cells + conjugate::bytes_needed(geometry)
}

/// The linear problem at the solution.
struct System<'m, 'a, T> {
    model: &'m Model<'a, T>,
    workers: &'m Workers,
    search: Search<'m, 'a, T>,
    smallest: Smallest,
    /// 1 in the pixels whose mean M is 1, else 0.
    valid: Vec<f32>,
    count: f64,
    /// b.
    slope: Vec<f32>,
    undetermined: Vec<bool>,
}

impl<'m, 'a, T: Real> System<'m, 'a, T> {
    fn new(
        model: &'m Model<'a, T>,
        sensitivity: &[f64],
        beam: &[f64],
        workers: &'m Workers,
        control: &Control,
    ) -> Result<Self> {
        let mut search = Search::new(model, workers, control);
        let finite = |values: &[f64]| -> Vec<f64> {
            values.iter().map(|value| if value.is_finite() { *value } else { 0.0 }).collect()
        };
        let turned = |view: &View| -> Vec<f64> {
            let places = (0..view.shape.rows)
                .flat_map(|row| (0..view.shape.cols).map(move |col| view.cells.at(row, col)));
            finite(&places.map(|place| beam[place]).collect::<Vec<_>>())
        };
        let beams: Vec<Vec<f64>> = model.geometry.views.iter().map(turned).collect();
        search.linearise(&finite(sensitivity), &beams, control)?;
        let padding = search.reduced.padding;
        let undetermined: Vec<bool> = sensitivity.iter().map(|m| !m.is_finite()).collect();
        let mut valid = padding.zeros(model.sensor().rows, workers, control);
        let cols = model.sensor().cols;
        let diagonal = padding.body(&search.reduced.inverse_diagonal);
        let rows = padding.body_mut(&mut valid).chunks_exact_mut(padding.width);
        let mut count = 0.0;
        for ((row, diagonal), undetermined) in
            rows.zip(diagonal.chunks_exact(padding.width)).zip(undetermined.chunks_exact(cols))
        {
            for ((valid, &d), &undetermined) in row.iter_mut().zip(diagonal).zip(undetermined) {
                if d > 0.0 && !undetermined {
                    *valid = 1.0;
                    count += 1.0;
                }
            }
        }
        let slope = padding.zeros(model.sensor().rows, workers, control);
        let smallest = Smallest::default();
        Ok(Self { model, workers, search, smallest, valid, count, slope, undetermined })
    }

    fn image(&self, control: &Control) -> Vec<f32> {
        self.search.reduced.padding.zeros(self.model.sensor().rows, self.workers, control)
    }

    /// Solves S x = b, b being the residual, until x · b lacks at most this share.
    fn solve(&mut self, lack: f64, control: &Control) -> Result<()> {
        let Self { search, smallest, .. } = self;
        search.begin(control)?;
        let (mut iterations, mut earlier) = (0, 0.0);
        while smallest.iterate(search, control)? {
            iterations += 1;
            if iterations >= FEWEST_ITERATIONS && smallest.lack(search) <= lack {
                break;
            }
            // Rounding may leave a Ritz value next to 0, that of the gauge: then what the last
            // iterations brought tells.
            if iterations % FEWEST_ITERATIONS == 0 {
                if search.energy - earlier <= NOTHING * lack * search.energy {
                    break;
                }
                earlier = search.energy;
            }
        }
        Ok(())
    }

    /// The variance of Σ g M.
    fn variance_of(&mut self, functional: &[f64], control: &Control) -> Result<f64> {
        let Self { search, slope, workers, valid, count, model, .. } = self;
        let padding = search.reduced.padding;
        // Pᵀ g = g − 1 (M · g)/N. Scaled, so that no g is beyond single precision.
        let largest = functional.iter().fold(0.0_f64, |largest, g| largest.max(g.abs()));
        if largest == 0.0 {
            return Ok(0.0);
        }
        let to_single = |g: f64| (g / largest) as f32;
        padding.copy(functional, model.sensor().cols, workers, slope, to_single);
        let mean = dot(slope, &search.reduced.sensitivity, workers) / *count;
        for (g, &valid) in slope.iter_mut().zip(valid.iter()) {
            *g -= mean as f32 * valid;
        }
        search.residual.copy_from_slice(slope);
        self.solve(LACK_OF_FUNCTIONAL, control)?;
        let Self { search, slope, workers, .. } = self;
        Ok(dot(slope, &search.x, workers) * (largest * search.reduced.scale.deviation()).powi(2))
    }

    /// The standard deviations in the units of M, row by row.
    fn deviations(&self, sampled: &Sampled) -> Vec<f64> {
        let reduced = &self.search.reduced;
        let (padding, cols) = (reduced.padding, self.model.sensor().cols);
        let scale = reduced.scale.deviation();
        let mut std = vec![f64::NAN; self.model.sensor().len()];
        self.workers.map_blocks(&mut std, BAND * cols, |band, rows| {
            for (index, row) in rows.chunks_exact_mut(cols).enumerate() {
                let row_of_sensor = band * BAND + index;
                let [known, squares, valid] = [&sampled.known, &sampled.squares, &self.valid]
                    .map(|image| padding.row(image, row_of_sensor));
                for (col, std) in row.iter_mut().enumerate() {
                    if valid[col] > 0.0 {
                        let drawn = f64::from(squares[col]) / sampled.draws as f64;
                        *std = scale * (f64::from(known[col]) + drawn).sqrt();
                    }
                }
            }
        });
        for (pixel, inverse) in reduced.left_out_variances() {
            if inverse > 0.0 && !self.undetermined[pixel] {
                std[pixel] = scale * inverse.sqrt();
            }
        }
        std
    }
}

impl<T: Real> Drawn for System<'_, '_, T> {
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
        Ok(variance)
    }

    /// Adds the square of T x, in the gauge, of one draw x.
    fn add_draw(&mut self, draw: u64, squares: &mut [f32], control: &Control) -> Result<()> {
        let Self { search, slope, .. } = self;
        search.reduced.draw(draw, &mut search.residual, control)?;
        slope.copy_from_slice(&search.residual);
        self.solve(LACK_OF_DRAW, control)?;
        let Self { search, slope, workers, valid, count, .. } = self;
        // T x = x − D⁻¹ S x, and S x = b − r.
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
            }
        });
        Ok(())
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
