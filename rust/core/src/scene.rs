//! Gain and offset of each pixel from the scene alone, frame by frame, without a source.
//!
//! Raw values v become y = (v − low) / span on the scale [0, 1]. The corrected frame is X = g y + o. Each
//! frame changes g and o by one of five rules:
//!
//! | method | target of a pixel |
//! |---|---|
//! | `LocalMean` | the mean of its neighbours in every frame |
//! | `Gated` | the mean of a square, where that mean has changed |
//! | `Registered` | the other frame of a pair, moved by the shift between them |
//! | `ConstantStatistics` | mean and deviation over time of its neighbourhood |
//! | `Kalman` | the mean of its neighbourhood, by recursive least squares, with variances |
//!
//! The first three descend along the gradient of the squared error: g ← g + η E y, o ← o + η E. After every
//! frame mean(g) = 1 and mean(o) = 0 are restored, since the errors do not determine them. Values are of
//! single precision; sums over the array are of double precision, in a fixed order.
//!
//! Places and motions are those of the scene on the sensor: a frame that shows at p what the one before
//! showed at p + d has the shift d.

mod bands;
mod coefficients;
mod constant_statistics;
mod gated;
mod kalman;
mod local_mean;
mod method;
mod motion;
mod moved;
mod neighbourhood;
mod options;
mod registered;
mod shift;
mod spectrum;
mod spline;
mod stability;
mod state;

pub use options::Options;
pub use state::Snapshot;

use bands::{BAND, bands, fold};
use coefficients::{Coefficients, sum};
use constant_statistics::ConstantStatistics;
use gated::Gated;
use kalman::Kalman;
use local_mean::LocalMean;
use method::{Frame, Method};
use registered::Registered;
use state::State;

use crate::error::{Error, Result};
use crate::frames::{Sample, Shape};
use crate::memory;
use crate::parallel::Workers;

/// Most bytes for each pixel: those of `Kalman`, ten values of the estimate and eight others, or of
/// `Registered`.
const BYTES: u64 = 96;

/// A correction that learns from the scene.
#[derive(Debug)]
pub struct SceneCorrection {
    low: f32,
    span: f32,
    coefficients: Coefficients,
    method: Box<dyn Method>,
    /// Frames that changed what is remembered.
    frames: u64,
    raw: Vec<f32>,
    corrected: Vec<f32>,
}

impl SceneCorrection {
    /// A correction with gain 1 and offset 0, for raw values from `low` to `high`.
    ///
    /// # Errors
    /// [`Error::Value`] or [`Error::Shape`] if a number is out of its range, as a step that is not below the
    /// stability bound; [`Error::Memory`].
    pub fn new(shape: Shape, [low, high]: [f64; 2], options: &Options) -> Result<Self> {
        options::check_shape(shape)?;
        if !(low.is_finite() && high.is_finite() && high > low) {
            let problem = format!("is ({low}, {high}), expected two numbers, the second larger");
            return Err(Error::value("range", problem));
        }
        memory::check(shape.len() as u64 * BYTES, || {
            format!("a correction from the scene of {shape}")
        })?;
        Ok(Self {
            low: low as f32,
            span: (high - low) as f32,
            method: method(shape, options)?,
            coefficients: Coefficients::new(shape),
            frames: 0,
            raw: vec![0.0; shape.len()],
            corrected: vec![0.0; shape.len()],
        })
    }

    /// Rows and columns.
    #[must_use]
    pub fn shape(&self) -> Shape {
        self.coefficients.shape
    }

    /// Gain of each pixel.
    #[must_use]
    pub fn gain(&self) -> &[f32] {
        &self.coefficients.gain
    }

    /// Offset of each pixel, on the scale [0, 1].
    #[must_use]
    pub fn offset(&self) -> &[f32] {
        &self.coefficients.offset
    }

    /// Variances of gain and of offset, of a method that has them.
    #[must_use]
    pub fn variances(&self) -> Option<[Vec<f32>; 2]> {
        self.method.variances()
    }

    /// Number of frames that counted.
    #[must_use]
    pub const fn frames(&self) -> u64 {
        self.frames
    }

    /// Corrects a frame by the coefficients before it, then learns from it; whether it counted.
    ///
    /// A frame that holds a value which is not finite, or one value alone, counts for nothing and changes no
    /// state. Nor do, of methods that need motion, frames in which the scene has not moved.
    ///
    /// # Errors
    /// [`Error::Shape`] if the frame or `corrected` is of another size; [`Error::Value`] if it holds a finite
    /// value more than one span outside of the range. Then no state is changed.
    pub fn update<T: Sample>(
        &mut self,
        frame: &[T],
        corrected: &mut [f32],
        workers: &Workers,
    ) -> Result<bool> {
        let shape = self.shape();
        if frame.len() != shape.len() || corrected.len() != shape.len() {
            return Err(Error::Shape {
                argument: "frame",
                got: format!("{} values", frame.len().min(corrected.len())),
                wanted: format!("those of a sensor {shape}"),
            });
        }
        let Some(mean) = self.correct(frame, corrected, workers)? else { return Ok(false) };
        let frame = Frame { shape, raw: &self.raw, corrected: &self.corrected, mean };
        let used = self.method.update(&frame, &mut self.coefficients, workers);
        self.frames += u64::from(used);
        Ok(used)
    }

    /// Writes y, X and the corrected frame in raw units; the mean of X, unless the frame is unusable.
    ///
    /// A value may exceed the range by noise and offset. One far outside would change its neighbours' gains
    /// by more than they can be.
    fn correct<T: Sample>(
        &mut self,
        frame: &[T],
        corrected: &mut [f32],
        workers: &Workers,
    ) -> Result<Option<f64>> {
        let (low, span, size) = (self.low, self.span, BAND * self.shape().cols);
        let (gain, offset) = (&self.coefficients.gain, &self.coefficients.offset);
        let first = frame[0].to_f64();
        let bands = bands!(size; &mut self.raw, &mut self.corrected, corrected);
        let found = workers.each(bands, |index, (raw, own, out)| {
            let start = index * size;
            let maps = gain[start..].iter().zip(&offset[start..]);
            let given = frame[start..].iter().zip(maps);
            let results = raw.iter_mut().zip(own.iter_mut()).zip(out);
            let (mut differs, mut outside) = (false, false);
            for ((value, (gain, offset)), ((raw, own), out)) in given.zip(results) {
                let value = value.to_f64();
                differs |= value != first;
                *raw = (value as f32 - low) / span;
                outside |= !(-1.0..=2.0).contains(raw);
                *own = gain * *raw + offset;
                *out = low + span * *own;
            }
            // A sum is finite if all its terms are, and they are not above 1e308.
            let total = sum(own);
            [total, f64::from(u8::from(differs)), f64::from(u8::from(outside))]
        });
        let [total, differing, outside] = fold(found);
        if total.is_finite() && outside > 0.0 {
            let problem = format!(
                "holds values more than one span outside of the range ({low}, {}): give the range of \
                 the raw values",
                low + span
            );
            return Err(Error::value("frame", problem));
        }
        Ok((total.is_finite() && differing > 0.0).then_some(total / self.raw.len() as f64))
    }

    fn state(&mut self) -> State<'_> {
        let sizes = [self.coefficients.shape.rows, self.coefficients.shape.cols];
        let own = State::default()
            .map("gain", sizes, &mut self.coefficients.gain)
            .map("offset", sizes, &mut self.coefficients.offset)
            .count("frames", &mut self.frames);
        own.and(self.method.state())
    }

    /// A copy of all that is remembered.
    pub fn snapshot(&mut self) -> Snapshot {
        self.state().snapshot()
    }

    /// Goes on from a snapshot of a correction with the same shape and options.
    ///
    /// # Errors
    /// [`Error::Value`] if the snapshot lacks a map or count, or one is of another size or not finite; then
    /// nothing is changed.
    pub fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        self.state().restore(snapshot)
    }
}

fn method(shape: Shape, options: &Options) -> Result<Box<dyn Method>> {
    Ok(match *options {
        Options::LocalMean { step, ref kernel, sizes } => {
            Box::new(LocalMean::new(shape, step, kernel, sizes)?)
        }
        Options::Gated { step, width, threshold, texture } => {
            Box::new(Gated::new(shape, [step, threshold, texture], width)?)
        }
        Options::Registered { step, least_motion, most_motion, cutoff, agreement } => {
            Box::new(Registered::new(shape, [step, least_motion, cutoff, agreement], most_motion)?)
        }
        Options::ConstantStatistics { width, window, motion, prior } => {
            Box::new(ConstantStatistics::new(shape, width, [window, prior], motion)?)
        }
        Options::Kalman { width, block, motion, gain_spread, offset_spread, memory } => Box::new(
            Kalman::new(shape, width, block, motion, [gain_spread, offset_spread, memory])?,
        ),
    })
}
