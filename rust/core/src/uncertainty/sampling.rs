//! A variance of each pixel that is known in part, and in part the mean square of draws.

use crate::control::Control;
use crate::error::Result;

/// The relative standard error of the map, root mean square over its pixels, that draws go on to.
pub(super) const EXACTNESS: f64 = 0.02;
/// Draws that determine how many are needed.
const FIRST_DRAWS: u64 = 8;
/// Upper limit on draws.
pub(super) const MOST_DRAWS: u64 = 400;
/// The share of x · b that the solution of a draw may lack. Slow errors are a small part of that and
/// a large one of the variance: with crosses (5, 7), (11, 19), (23, 41) and (97, 160) the mean
/// variance was 2, 3, 5 and 14 in 10 000 too small with this, 2, 36, 242 and 934 with 1e-3.
pub(super) const LACK_OF_DRAW: f64 = 1e-5;
/// That of a functional, which is the share of its variance itself.
pub(super) const LACK_OF_FUNCTIONAL: f64 = 1e-4;
/// That of a functional to which a dark adds a square of the solution, whose error is the root of it.
pub(super) const LACK_WITH_DARK: f64 = 1e-8;
/// A search that finds no more than this share of what it may lack in ten iterations is at its end.
pub(super) const NOTHING: f64 = 1e-2;

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

/// The share of the degrees of freedom below which what the dark adds to F need not be exact.
pub(super) const NEGLIGIBLE: f64 = 1e-3;
/// Pixels, counted in each draw, over which what the dark adds to F is averaged.
const PIXELS: f64 = 2e4;
/// Upper limit on draws of it.
const MOST_MISFITS: u64 = 64;

/// A linear problem that draws can be made of. Images may be padded, all alike.
pub(super) trait Drawn {
    /// 1 in the pixels that count, else 0.
    fn valid(&self) -> &[f32];
    /// The part of the variance of M that is known.
    fn known(&mut self, control: &Control) -> Result<Vec<f32>>;
    /// The part of the known variance whose draws multiply the rest; empty without a dark.
    fn propagated(&self) -> &[f32];
    /// Adds the square of the rest of one draw, and twice its product with what M follows at once.
    fn add_draw(&mut self, draw: u64, squares: &mut [f32], control: &Control) -> Result<()>;
}

/// A variance that is known in part, and in part the mean square of draws.
pub(super) struct Sampled {
    pub(super) known: Vec<f32>,
    pub(super) squares: Vec<f32>,
    pub(super) draws: u64,
    pub(super) exactness: f64,
}

impl Sampled {
    /// As many draws as it takes.
    pub(super) fn of(problem: &mut impl Drawn, control: &Control) -> Result<Self> {
        let known = problem.known(control)?;
        let squares = vec![0.0; known.len()];
        let mut sampled = Self { known, squares, draws: 0, exactness: f64::INFINITY };
        let mut wanted = FIRST_DRAWS;
        while sampled.draws < wanted {
            control.report("uncertainty", sampled.draws, wanted);
            problem.add_draw(sampled.draws, &mut sampled.squares, control)?;
            sampled.draws += 1;
            if sampled.draws == wanted {
                let share = sampled.share(problem.valid(), problem.propagated());
                let needed = (exactness(share, 1) / EXACTNESS).powi(2).ceil() as u64;
                wanted = needed.min(MOST_DRAWS);
                sampled.exactness = exactness(share, sampled.draws);
            }
        }
        control.report("uncertainty", sampled.draws, sampled.draws);
        Ok(sampled)
    }

    pub(super) fn variance(&self, pixel: usize) -> f64 {
        f64::from(self.known[pixel]) + f64::from(self.squares[pixel]) / self.draws as f64
    }

    /// The root mean square, over the valid pixels, of the share of the variance that is sampled,
    /// without what the scatter of so many draws adds to it.
    ///
    /// With x sampled and f `propagated`, x² + 2 x f scatters by 2 s² + 4 f² s, s being the variance of x:
    /// as the square of a share with s² + 2 f² s would.
    fn share(&self, valid: &[f32], propagated: &[f32]) -> f64 {
        let draws = self.draws as f64;
        let [mut count, mut squares, mut products] = [0.0; 3];
        for (pixel, &valid) in valid.iter().enumerate() {
            let sampled = f64::from(self.squares[pixel]) / draws;
            let variance = self.variance(pixel).max(f64::MIN_POSITIVE);
            let share = sampled / variance;
            squares += f64::from(valid) * share.powi(2);
            let propagated = propagated.get(pixel).map_or(0.0, |propagated| f64::from(*propagated));
            products += f64::from(valid) * share * propagated / variance;
            count += f64::from(valid);
        }
        let own = (squares - 4.0 * products / draws) / count * draws / (draws + 2.0);
        (own + 2.0 * products / count).max(0.0).sqrt()
    }

    pub(super) const fn map(&self, std: Vec<f64>) -> ErrorMap {
        ErrorMap { std, draws: self.draws, exactness: self.exactness }
    }
}

/// The mean of what draws add to F, each an average over so many pixels.
pub(super) fn mean_misfit(pixels: f64, mut of_draw: impl FnMut(u64) -> Result<f64>) -> Result<f64> {
    let draws = ((PIXELS / pixels).ceil() as u64).clamp(1, MOST_MISFITS);
    let sum = (0..draws).map(&mut of_draw).sum::<Result<f64>>()?;
    Ok(sum / draws as f64)
}

/// The relative standard error of a deviation of whose square this share is the mean of the squares
/// of so many draws: a square of a normal value scatters by √2 of its mean, and a root halves that.
fn exactness(share: f64, draws: u64) -> f64 {
    0.5 * share * (2.0 / draws as f64).sqrt()
}
