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
mod descent;
mod field;
mod fill;
mod floor;
mod gated;
mod history;
mod kalman;
mod local_mean;
mod method;
mod motion;
mod moved;
mod neighbourhood;
mod options;
mod registered;
mod saturation;
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
use field::Field;
use fill::Fill;
use floor::Floor;
use gated::Gated;
use history::History;
use kalman::Kalman;
use local_mean::LocalMean;
use method::{Frame, Method};
use registered::Registered;
use state::State;

use crate::error::{Error, Result};
use crate::frames::{Sample, Shape};
use crate::memory;
use crate::parallel::Workers;

/// Most bytes for each pixel: those of `Kalman`, ten values of the estimate and fourteen others, or of
/// `Registered`.
const BYTES: u64 = 128;

/// Largest error of the gauge: it holds to half a unit in the last place of each value.
const GAUGE: f64 = 1e-6;

/// A correction that learns from the scene.
#[derive(Debug)]
pub struct SceneCorrection {
    low: f64,
    span: f64,
    coefficients: Coefficients,
    method: Box<dyn Method>,
    /// Frames that changed what is remembered, and usable ones in all.
    frames: u64,
    taken: u64,
    history: History,
    field: Field,
    floor: Floor,
    /// 1 for masked pixels, and what they hold.
    masked: Vec<f32>,
    fill: Fill,
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
        let single = |span: f64| span.is_finite() && span as f32 > 0.0 && (span as f32).is_finite();
        if !(single(high - low) && low.is_finite()) {
            let problem = format!(
                "is ({low}, {high}), expected two numbers, the second larger by a number of single precision"
            );
            return Err(Error::value("range", problem));
        }
        memory::check(shape.len() as u64 * BYTES, || {
            format!("a correction from the scene of {shape}")
        })?;
        let coefficients = Coefficients::new(shape);
        Ok(Self {
            low,
            span: high - low,
            method: method(shape, options)?,
            floor: Floor::new(&coefficients),
            coefficients,
            frames: 0,
            taken: 0,
            history: History::new(shape),
            field: Field::new(shape),
            masked: vec![0.0; shape.len()],
            fill: Fill::default(),
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

    /// Number of usable frames that were given, whether they counted or not.
    #[must_use]
    pub const fn taken(&self) -> u64 {
        self.taken
    }

    /// Standard deviation of each pixel over the usable frames, on the scale [0, 1].
    #[must_use]
    pub fn deviation(&self) -> Vec<f32> {
        self.history.deviation()
    }

    /// Frames that were refused since they are far from the ones around them.
    #[must_use]
    pub const fn foreign(&self) -> u64 {
        self.field.foreign
    }

    /// Share of the field that does not move, from 51 frames on.
    #[must_use]
    pub fn still(&self) -> Option<f64> {
        self.field.still()
    }

    /// Standard deviation of the pattern that is left, on the scale [0, 1]: from the variances of the method, or else
    /// from the change of the pattern since a quarter to a half of the frames, at the mean level.
    #[must_use]
    pub fn floor(&self, workers: &Workers) -> Option<f64> {
        let level = self.history.level();
        let (change, early) = self.floor.change(&self.coefficients, level, workers)?;
        let changed = || change * change * self.method.forgets(early, self.frames);
        Some(self.method.leaves(level).unwrap_or_else(changed).sqrt())
    }

    /// Masks pixels: they do not learn, and their neighbours do not learn from them.
    ///
    /// # Errors
    /// [`Error::Shape`] if the mask is of another size; [`Error::Value`] if it leaves no pixel.
    pub fn mask(&mut self, masked: &[bool]) -> Result<()> {
        let shape = self.shape();
        if masked.len() != shape.len() {
            return Err(Error::Shape {
                argument: "mask",
                got: format!("{} values", masked.len()),
                wanted: format!("those of a sensor {shape}"),
            });
        }
        if masked.iter().all(|masked| *masked) {
            return Err(Error::value("mask", "masks all pixels, expected some that are good"));
        }
        self.fill = Fill::new(shape, masked);
        self.masked = masked.iter().map(|masked| f32::from(u8::from(*masked))).collect();
        Ok(())
    }

    /// Masked pixels.
    #[must_use]
    pub fn masked(&self) -> Vec<bool> {
        self.masked.iter().map(|masked| *masked > 0.0).collect()
    }

    /// Corrects a frame by the coefficients before it, then learns from it; whether it counted.
    ///
    /// A frame that holds a value which is not finite, or of which half of the rows or more hold one value
    /// each, as one that was lost or cut, counts for nothing and changes no state. Nor do, of methods that need motion, frames in which the scene has not moved.
    /// Pixels from the raw value `saturation` on do not learn, nor do those with many of them around.
    ///
    /// # Errors
    /// [`Error::Shape`] if the frame or `corrected` is of another size; [`Error::Value`] if it holds a finite
    /// value more than one span outside of the range. Then no state is changed.
    pub fn update<T: Sample>(
        &mut self,
        frame: &[T],
        corrected: &mut [f32],
        saturation: Option<f64>,
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
        let Some([mean, level]) = self.correct(frame, corrected, workers)? else {
            return Ok(false);
        };
        let refuse = !self.method.compares_frames();
        if !self.field.takes(shape, &self.raw, refuse, workers) {
            return Ok(false);
        }
        self.taken += 1;
        self.history.add(&self.raw, self.taken, workers);
        self.fill.write(&mut self.raw);
        self.fill.write(&mut self.corrected);
        let saturation =
            saturation.map_or(f32::INFINITY, |level| ((level - self.low) / self.span) as f32);
        let rule = (self.method.width(), self.method.leaves_out_saturated());
        let mut left_out = saturation::left_out(shape, &self.raw, saturation, rule, workers);
        if rule.1 {
            left_out = self.fill.mark(left_out, shape.len());
        }
        let frame = Frame {
            shape,
            raw: &self.raw,
            corrected: &self.corrected,
            mean,
            level,
            saturation,
            left_out: left_out.as_deref(),
            fill: &self.fill,
        };
        let used = self.method.update(&frame, &mut self.coefficients, workers);
        self.frames += u64::from(used);
        self.floor.follow(self.frames, &self.coefficients, || self.history.level());
        Ok(used)
    }

    /// Writes y, X and the corrected frame in raw units; the means of X and y, unless the frame is unusable.
    ///
    /// A value may exceed the range by noise and offset. One far outside would change its neighbours' gains
    /// by more than they can be.
    fn correct<T: Sample>(
        &mut self,
        frame: &[T],
        corrected: &mut [f32],
        workers: &Workers,
    ) -> Result<Option<[f64; 2]>> {
        let (low, span, size) = (self.low, self.span, BAND * self.shape().cols);
        let (gain, offset) = (&self.coefficients.gain, &self.coefficients.offset);
        let cols = self.shape().cols;
        let bands = bands!(size; &mut self.raw, &mut self.corrected, corrected);
        let found = workers.each(bands, |index, (raw, own, out)| {
            let start = index * size;
            let maps = gain[start..].chunks(cols).zip(offset[start..].chunks(cols));
            let given = frame[start..].chunks(cols).zip(maps);
            let results = raw.chunks_mut(cols).zip(own.chunks_mut(cols)).zip(out.chunks_mut(cols));
            let (mut flat, mut outside) = (0_u32, false);
            for ((values, (gain, offset)), ((raw, own), out)) in given.zip(results) {
                let (first, mut differs) = (values[0].to_f64(), false);
                for (col, value) in values.iter().enumerate() {
                    let value = value.to_f64();
                    let y = (value - low) / span;
                    differs |= value != first;
                    outside |= value.is_finite() && !(-1.0..=2.0).contains(&y);
                    raw[col] = y as f32;
                    own[col] = gain[col] * raw[col] + offset[col];
                    out[col] = (low + span * f64::from(own[col])) as f32;
                }
                flat += u32::from(!differs);
            }
            // A sum is finite if all its terms are: those that are not outside are small.
            [sum(own), sum(raw), f64::from(flat), f64::from(u8::from(outside))]
        });
        let [total, level, flat, outside] = fold(found);
        if outside > 0.0 {
            let problem = format!(
                "holds values more than one span outside of the range ({low}, {}): give the range of \
                 the raw values",
                low + span
            );
            return Err(Error::value("frame", problem));
        }
        let usable = total.is_finite() && 2.0 * flat < self.shape().rows as f64;
        let pixels = self.raw.len() as f64;
        Ok(usable.then_some([total / pixels, level / pixels]))
    }

    fn state(&mut self) -> State<'_> {
        let sizes = [self.coefficients.shape.rows, self.coefficients.shape.cols];
        let own = State::default()
            .map("gain", sizes, &mut self.coefficients.gain)
            .map("offset", sizes, &mut self.coefficients.offset)
            .map("history_mean", sizes, &mut self.history.mean)
            .squares("history_variance", sizes, &mut self.history.variance)
            .squares("masked", sizes, &mut self.masked)
            .count("frames", &mut self.frames)
            .count("taken", &mut self.taken);
        own.and(self.field.state()).and(self.floor.state()).and(self.method.state())
    }

    /// A copy of all that is remembered.
    pub fn snapshot(&mut self) -> Snapshot {
        self.state().snapshot()
    }

    /// Goes on from a snapshot of a correction with the same shape and options.
    ///
    /// # Errors
    /// [`Error::Value`] if the snapshot lacks a map or count, one is of another size or not finite, or no frames
    /// lead to it; then nothing is changed.
    pub fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let before = self.snapshot();
        self.state().restore(snapshot)?;
        let masked = self.masked();
        if let Err(error) = self.check().and_then(|()| self.mask(&masked)) {
            self.state().restore(&before)?;
            return Err(error);
        }
        Ok(())
    }

    /// Refuses a state without the gauge, with more frames that counted than there were, or values that frames
    /// do not have.
    fn check(&self) -> Result<()> {
        let pixels = self.raw.len() as f64;
        let [gain, offset] = [&self.coefficients.gain, &self.coefficients.offset];
        let [gain, offset] = [gain, offset].map(|values| sum(values) / pixels);
        if (gain - 1.0).abs() > GAUGE || offset.abs() > GAUGE {
            let problem =
                format!("has the mean gain {gain} and the mean offset {offset}, expected 1 and 0");
            return Err(Error::value("state", problem));
        }
        if self.frames > self.taken {
            let problem = format!("has {} frames that counted of {}", self.frames, self.taken);
            return Err(Error::value("state", problem));
        }
        if !self.history.mean.iter().all(|mean| (-1.0..=2.0).contains(mean)) {
            return Err(Error::value("state", "has a mean frame that is out of the range"));
        }
        self.method.check()
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
