//! How far M still is from the minimum of F, large scales included.
//!
//! One sweep of coordinate descent takes the relative error e of M to e − s with the step
//! s = (λ/n)·e, where λ is the graph Laplacian that is left of F when L has been eliminated. Far
//! from the borders λ is diagonal in plane waves, with the symbol
//!
//! ```text
//! λ(q)/n = 1 − |Σ_k W_k e^{iq·d_k}|² / (Σ_k W_k)²
//! ```
//!
//! (W the weight of an exposure). It is about q²·var(d) for waves much longer than the shifts: the
//! step shows nearly nothing of an error of the sensor's own size, and no rule on the step or on
//! the change of F can tell that it is there. Dividing the step by the symbol, mode by mode of a
//! cosine transform, brings it back: the estimate is max |DCT⁻¹(DCT(s)·n/λ)|.
//!
//! The symbol takes all measurements as equal. Where the light is faint or masks leave little, the
//! parts on either side are coupled more weakly and their difference fades more slowly: by no more
//! than the contrast of the weights w·m², taken over blocks of pixels, in which a few bad pixels do
//! not count. The figure is multiplied by that contrast, the mean over the least.
//!
//! The rate at which the steps really shrink gives another figure, that of a geometric series,
//! max |s| / (1 − rate), and the larger of the two is the estimate.
//!
//! Exposures that are turned against each other do not share plane waves. The phases between them
//! are then taken as the worst possible, which makes the estimate too large rather than too small.

use std::f64::consts::PI;

use crate::control::Control;
use crate::error::Result;
use crate::frames::{Real, Shape};
use crate::model::Model;
use crate::parallel::Workers;
use crate::transform::CosineTransform;

/// Values that a thread takes at a time.
const PART: usize = 1 << 16;
/// Pixels along a side of the blocks whose weights are compared.
const BLOCK: usize = 16;
/// A symbol or a rate this small cannot be told from 0.
const NOTHING: f64 = 1e-8;
/// What a step may be by rounding alone, M being close to 1.
pub(crate) const ROUNDING: f64 = 16.0 * f64::EPSILON;

/// What one look at the error of M found.
#[derive(Clone, Copy, Debug)]
pub struct Estimate {
    /// The sweep after which it was taken.
    pub sweep: u64,
    /// The largest relative error of M.
    pub error: f64,
    /// The largest step that this sweep took.
    pub step: f64,
}

/// Estimates the error of M from the steps that sweeps take.
pub struct Estimator<'m> {
    workers: &'m Workers,
    transform: CosineTransform,
    waves: Vec<Waves>,
    /// The symbol of the longest wave along either side of the sensor.
    longest: f64,
    /// How much more slowly than by the symbol errors may fade, since measurements are not equal.
    contrast: f64,
    /// No symbol counts as less than this.
    least: f64,
    last: Option<LastStep>,
}

/// The exposures of one view: weight and phases e^{iq·d} of each for every mode of the transform.
struct Waves {
    exposures: Vec<Wave>,
}

struct Wave {
    weight: f64,
    row_phases: Vec<Complex>,
    col_phases: Vec<Complex>,
}

#[derive(Clone, Copy)]
struct LastStep {
    sweep: u64,
    rms: f64,
}

#[derive(Clone, Copy)]
struct Complex {
    re: f64,
    im: f64,
}

impl<'m> Estimator<'m> {
    /// Prepares the symbol of an experiment whose measurements form so many `components`.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
    pub fn new<T: Real>(
        model: &Model<'_, T>,
        components: usize,
        workers: &'m Workers,
        control: &Control,
    ) -> Result<Self> {
        let shape = model.sensor();
        let mut estimator = Self {
            workers,
            transform: CosineTransform::new(shape),
            waves: waves(model),
            longest: 1.0,
            contrast: contrast(model, workers, control)?,
            least: NOTHING,
            last: None,
        };
        let lowest =
            [(1, 0), (0, 1)].into_iter().filter(|&(i, j)| i < shape.rows && j < shape.cols);
        estimator.longest = lowest
            .map(|(i, j)| estimator.symbol(i, j, 1.0))
            // An axis along which nothing was shifted couples nothing, at whatever scale.
            .filter(|&symbol| symbol > NOTHING)
            .fold(1.0, f64::min);
        if components > 1 {
            // Each component has a null mode, which need not lie on the transform's grid: close to
            // one the symbol says nothing. Within a component errors fade as on the open sensor.
            estimator.least = estimator.longest;
        }
        Ok(estimator)
    }

    /// The share of the longest wave that one sweep removes, as the symbol has it.
    #[must_use]
    pub const fn longest(&self) -> f64 {
        self.longest
    }

    /// The largest relative error of M, from the `step` that sweep number `sweep` took.
    ///
    /// `step` is in units of the mean sensitivity, and 0 at pixels without measurements.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
    pub fn largest_error(
        &mut self,
        mut step: Vec<f64>,
        sweep: u64,
        control: &Control,
    ) -> Result<Estimate> {
        let (largest_step, rms) = self.sizes(&step);
        control.check()?;
        // Steps that are nothing but rounding do not shrink, and are no series.
        let by_rate = (largest_step - ROUNDING).max(0.0) / self.lost_per_sweep(sweep, rms);
        self.last = Some(LastStep { sweep, rms });
        let amplification = |i, j| self.amplification(i, j);
        self.transform.filter(&mut step, amplification, self.workers, control)?;
        Ok(Estimate {
            sweep,
            error: by_rate.max(self.contrast * self.sizes(&step).0),
            step: largest_step,
        })
    }

    /// The largest size of some values, and their root mean square.
    fn sizes(&self, values: &[f64]) -> (f64, f64) {
        let parts: Vec<&[f64]> = values.chunks(PART).collect();
        let of_parts = self.workers.map(parts.len(), |index| {
            (largest(parts[index]), parts[index].iter().map(|value| value * value).sum::<f64>())
        });
        let (tops, squares): (Vec<_>, Vec<_>) = of_parts.into_iter().unzip();
        (largest(&tops), (squares.iter().sum::<f64>() / values.len() as f64).sqrt())
    }

    /// 1 − the factor by which the steps have shrunk per sweep since the last look; at the first
    /// look, where the slowest errors may still hide, what the longest wave loses.
    fn lost_per_sweep(&self, sweep: u64, rms: f64) -> f64 {
        let lost = self.last.map_or(self.longest, |last| {
            1.0 - (rms / last.rms).powf(1.0 / (sweep - last.sweep) as f64)
        });
        lost.clamp(NOTHING, 1.0)
    }

    /// n/λ of a cosine mode: the mean over the two plane waves that it is made of. The constant
    /// belongs to the gauge.
    fn amplification(&self, i: usize, j: usize) -> f64 {
        if (i, j) == (0, 0) {
            return 0.0;
        }
        let inverse = |sign| 1.0 / self.symbol(i, j, sign).max(self.least);
        0.5 * (inverse(1.0) + inverse(-1.0))
    }

    /// λ/n of the plane wave (πi/R, ±πj/C).
    fn symbol(&self, i: usize, j: usize, sign: f64) -> f64 {
        let [mut amplitude, mut weight] = [0.0; 2];
        for view in &self.waves {
            let mut sum = Complex { re: 0.0, im: 0.0 };
            for wave in &view.exposures {
                let (a, b) = (wave.row_phases[i], wave.col_phases[j]);
                let b = Complex { re: b.re, im: sign * b.im };
                sum.re += wave.weight * (a.re * b.re - a.im * b.im);
                sum.im += wave.weight * (a.re * b.im + a.im * b.re);
                weight += wave.weight;
            }
            amplitude += sum.re.hypot(sum.im);
        }
        1.0 - (amplitude / weight).powi(2)
    }
}

/// The mean over the least weight Σ w y² of blocks of pixels, those apart that have none at all.
fn contrast<T: Real>(model: &Model<'_, T>, workers: &Workers, control: &Control) -> Result<f64> {
    let Shape { rows, cols } = model.sensor();
    let by_row = workers.map(rows.div_ceil(BLOCK), |block| {
        let mut sums = vec![0.0; cols.div_ceil(BLOCK)];
        let mut scratch = vec![0.0; cols];
        for row in block * BLOCK..rows.min((block + 1) * BLOCK) {
            for exposure in 0..model.count() {
                control.check()?;
                let squares = model.weighted_squares(exposure, row, &mut scratch);
                for (sum, squares) in sums.iter_mut().zip(squares.chunks(BLOCK)) {
                    *sum += squares.iter().sum::<f64>();
                }
            }
        }
        let height = (rows - block * BLOCK).min(BLOCK);
        for (index, sum) in sums.iter_mut().enumerate() {
            *sum /= (height * (cols - index * BLOCK).min(BLOCK)) as f64;
        }
        Ok(sums)
    });
    let blocks = by_row.into_iter().collect::<Result<Vec<_>>>()?.concat();
    let seen = blocks.iter().copied().filter(|&weight| weight > 0.0);
    let least = seen.clone().fold(f64::INFINITY, f64::min);
    Ok((seen.clone().sum::<f64>() / seen.count() as f64 / least).max(1.0))
}

fn waves<T: Real>(model: &Model<'_, T>) -> Vec<Waves> {
    let Shape { rows, cols } = model.sensor();
    let weights = model.exposure_weights();
    let places = &model.geometry.exposures;
    let of_view = |view| {
        let exposures = places.iter().zip(&weights).filter(|(place, _)| place.view == view);
        let waves = exposures.map(|(place, &weight)| Wave {
            weight,
            row_phases: phases(place.row, rows),
            col_phases: phases(place.col, cols),
        });
        Waves { exposures: waves.collect() }
    };
    (0..model.geometry.views.len()).map(of_view).collect()
}

/// e^{iπ·mode·shift/count} for every mode.
fn phases(shift: usize, count: usize) -> Vec<Complex> {
    let phase = |mode| PI * mode as f64 * shift as f64 / count as f64;
    (0..count).map(|mode| Complex { re: phase(mode).cos(), im: phase(mode).sin() }).collect()
}

/// The largest size of some values; NaN if any is.
fn largest(values: &[f64]) -> f64 {
    let larger = |largest: f64, value: f64| if value <= largest { largest } else { value };
    values.iter().fold(
        0.0,
        |largest, value| {
            if largest.is_nan() { largest } else { larger(largest, value.abs()) }
        },
    )
}
