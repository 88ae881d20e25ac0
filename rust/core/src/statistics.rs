//! Mean and variance per pixel over frames that pass by, however many.
//!
//! Samples of 8 and 16 bits are summed exactly, so neither the order of the frames nor the way
//! they are split into partial sums changes a bit of
//!
//! ```text
//! x̄ = Σx / n        s² = (n Σx² − (Σx)²) / (n (n − 1))
//! ```
//!
//! Floating-point samples are summed batch by batch in two passes, and partial sums a and b are
//! merged by Chan's formula, with M = Σ(x − x̄)²:
//!
//! ```text
//! n = nₐ + n_b    δ = x̄_b − x̄ₐ    x̄ = x̄ₐ + δ n_b/n    M = Mₐ + M_b + δ² nₐ n_b/n    s² = M / (n − 1)
//! ```
//!
//! Their frames are taken in groups of 256, each summed by itself and then merged to those before. So
//! groups may be summed anywhere, stored as bytes, and merged in their order: the result is the same.
//!
//! The light may vary between frames. What it does to all pixels together shows in the means of the
//! frames over all pixels, whose variance is kept, one number, added frame by frame in their order.
//! Pixels may be left out of these means. Where samples are missing, frames are means over different
//! pixels: so a floating-point sample counts there as its difference to the first value of its pixel,
//! the mean of the first batch in which it has samples.
//!
//! Samples that are not finite do not count. Saturated samples do: they are counted apart, and
//! whoever uses the mean decides what to do with the pixel.
//!
//! T. F. Chan, G. H. Golub, R. J. LeVeque, "Algorithms for computing the sample variance",
//! The American Statistician 37 (1983) 242–247.

use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::{Sample, Shape, Stack};
use crate::memory;
use crate::parallel::Workers;

mod bytes;
mod light;
use bytes::{Bytes, Reader};
use light::{FloatLight, Light, WholeLight};

/// Pixels of one block: their sums stay in the first-level cache while a batch passes.
const BLOCK: usize = 1024;

/// Frames of one batch: enough to hide the traffic of the sums behind that of the frames.
const BATCH: usize = 16;

/// Frames of floating-point numbers that are summed before they are merged to those before.
pub const GROUP: u32 = 256;

/// Mean and scatter of repeated frames, pixel by pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct Statistics {
    /// Sizes of one frame.
    pub shape: Shape,
    /// Mean of the samples that count; NaN where none does.
    pub mean: Vec<f64>,
    /// Unbiased variance of one sample; NaN where fewer than two count.
    pub variance: Vec<f64>,
    /// Number of samples that count.
    pub count: Vec<u32>,
    /// Number of samples at or above the saturation level.
    pub saturated: Vec<u32>,
    /// Unbiased variance of the means of the frames over the pixels that are not masked; NaN of fewer
    /// than two.
    pub light_variance: f64,
}

impl Statistics {
    /// Bytes of one pixel.
    const BYTES: usize = 8 + 8 + 4 + 4;
}

/// A sample that can be summed.
pub trait Summable: Sample {
    /// The partial sums that suit it.
    type Sums: PartialSums<Self>;
    /// What is kept of the means of frames.
    type Light: Light;
    /// The level that no sample exceeds, where the type has one.
    const FULL_SCALE: Option<f64>;
}

/// Partial sums of a block of pixels.
pub trait PartialSums<T>: Bytes + Clone + std::fmt::Debug + Send + Sync {
    /// Bytes of the sums of one pixel.
    const BYTES: usize;
    /// Whether frames are summed in groups: the order of sums changes their last bits.
    const GROUPED: bool;
    /// Sums of no samples at all for `pixels` pixels.
    fn new(pixels: usize) -> Self;
    /// Adds the same block of several frames.
    fn add(&mut self, frames: &[&[T]], saturation: f64);
    /// Sum and number of the samples of each frame that was added, over the first values of pixels;
    /// `left_out` is empty, or tells for each pixel whether it does not count.
    fn totals(&self, frames: &[&[T]], left_out: &[bool]) -> Vec<(f64, usize)>;
    /// Sum and number of the differences between the first values of `other` and these, without
    /// pixels that are `left_out`.
    fn offsets(&self, other: &Self, left_out: &[bool]) -> (f64, usize);
    /// Adds what `other` has summed over the same pixels; its first values are higher by `offset`.
    fn merge(&mut self, other: &Self, offset: f64);
    /// Appends the block's pixels to `statistics`.
    fn finish(&self, statistics: &mut Statistics);
}

macro_rules! summable {
    ($($sample:ty: $sums:ty, $light:ty, $full_scale:expr;)*) => {$(
        impl Summable for $sample {
            type Sums = $sums;
            type Light = $light;
            const FULL_SCALE: Option<f64> = $full_scale;
        }
    )*};
}

summable! {
    u8: ExactSums, WholeLight, Some(255.0);
    u16: ExactSums, WholeLight, Some(65535.0);
    f32: Moments, FloatLight, None;
    f64: Moments, FloatLight, None;
}

/// Σx and Σx² in whole numbers: 2³² samples of 16 bits fill 64.
#[derive(Clone, Debug)]
pub struct ExactSums {
    count: u32,
    sum: Vec<u64>,
    squares: Vec<u64>,
    saturated: Vec<u32>,
}

impl<T: Sample + Into<u32>> PartialSums<T> for ExactSums {
    const BYTES: usize = 8 + 8 + 4;
    const GROUPED: bool = false;

    fn new(pixels: usize) -> Self {
        let zeros = || vec![0; pixels];
        Self { count: 0, sum: zeros(), squares: zeros(), saturated: vec![0; pixels] }
    }

    #[inline(always)]
    fn add(&mut self, frames: &[&[T]], saturation: f64) {
        let level = saturation.ceil() as u32;
        for samples in frames {
            let sums = self.sum.iter_mut().zip(&mut self.squares).zip(&mut self.saturated);
            for (((sum, squares), saturated), &sample) in sums.zip(*samples) {
                let value: u32 = sample.into();
                *sum += u64::from(value);
                *squares += u64::from(value * value);
                *saturated += u32::from(value >= level);
            }
        }
        self.count += frames.len() as u32;
    }

    #[inline(always)]
    fn totals(&self, frames: &[&[T]], left_out: &[bool]) -> Vec<(f64, usize)> {
        let whole = |sample: T| -> u64 { u64::from(Into::<u32>::into(sample)) };
        let total = |samples: &&[T]| {
            if left_out.is_empty() {
                return (
                    samples.iter().map(|&each| whole(each)).sum::<u64>() as f64,
                    samples.len(),
                );
            }
            let kept = samples.iter().zip(left_out).filter(|&(_, &out)| !out);
            let (sum, count) = kept.fold((0, 0), |(sum, n), (&each, _)| (sum + whole(each), n + 1));
            (sum as f64, count)
        };
        frames.iter().map(total).collect()
    }

    fn offsets(&self, _: &Self, _: &[bool]) -> (f64, usize) {
        (0.0, 0)
    }

    fn merge(&mut self, other: &Self, _: f64) {
        self.count += other.count;
        self.sum.iter_mut().zip(&other.sum).for_each(|(a, b)| *a += b);
        self.squares.iter_mut().zip(&other.squares).for_each(|(a, b)| *a += b);
        self.saturated.iter_mut().zip(&other.saturated).for_each(|(a, b)| *a += b);
    }

    fn finish(&self, statistics: &mut Statistics) {
        let n = u64::from(self.count);
        let pairs = n as f64 * n.saturating_sub(1) as f64;
        let variance = |(&sum, &squares): (&u64, &u64)| {
            let scatter = u128::from(n) * u128::from(squares) - u128::from(sum).pow(2);
            scatter as f64 / pairs // 0/0 = NaN below two samples
        };
        statistics.mean.extend(self.sum.iter().map(|&sum| sum as f64 / n as f64));
        statistics.variance.extend(self.sum.iter().zip(&self.squares).map(variance));
        statistics.count.resize(statistics.count.len() + self.sum.len(), self.count);
        statistics.saturated.extend(&self.saturated);
    }
}

impl Bytes for ExactSums {
    fn write(&self, bytes: &mut Vec<u8>) {
        self.count.write(bytes);
        self.sum.write(bytes);
        self.squares.write(bytes);
        self.saturated.write(bytes);
    }

    fn read(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        self.count.read(reader)?;
        self.sum.read(reader)?;
        self.squares.read(reader)?;
        self.saturated.read(reader)
    }
}

/// Mean and Σ(x − x̄)² of floating-point samples.
#[derive(Clone, Debug)]
pub struct Moments {
    count: Vec<u32>,
    mean: Vec<f64>,
    scatter: Vec<f64>,
    saturated: Vec<u32>,
    /// First value of each pixel; NaN where there is none yet.
    first: Vec<f64>,
}

impl Moments {
    /// The samples' mean, and which of them are saturated.
    #[inline(always)]
    fn add_means<T: Sample>(&mut self, frames: &[&[T]], saturation: f64) {
        for samples in frames {
            let sums = self.count.iter_mut().zip(&mut self.mean).zip(&mut self.saturated);
            for (((count, sum), saturated), sample) in sums.zip(*samples) {
                let value = sample.to_f64();
                *count += u32::from(value.is_finite());
                *sum += if value.is_finite() { value } else { 0.0 };
                *saturated += u32::from(value >= saturation);
            }
        }
        let sums = self.mean.iter_mut().zip(&mut self.first).zip(&self.count);
        for ((mean, first), &count) in sums {
            *mean /= f64::from(count.max(1));
            *first = if count == 0 { f64::NAN } else { *mean };
        }
    }

    /// The samples' scatter about the mean that is already there.
    #[inline(always)]
    fn add_scatter<T: Sample>(&mut self, frames: &[&[T]]) {
        for samples in frames {
            for ((scatter, mean), sample) in self.scatter.iter_mut().zip(&self.mean).zip(*samples) {
                let value = sample.to_f64();
                let deviation = if value.is_finite() { value - mean } else { 0.0 };
                *scatter += deviation * deviation;
            }
        }
    }
}

impl<T: Sample> PartialSums<T> for Moments {
    const BYTES: usize = 4 + 8 + 8 + 4 + 8;
    const GROUPED: bool = true;

    fn new(pixels: usize) -> Self {
        let zeros = || vec![0.0; pixels];
        let counts = || vec![0; pixels];
        let first = vec![f64::NAN; pixels];
        Self { count: counts(), mean: zeros(), scatter: zeros(), saturated: counts(), first }
    }

    #[inline(always)]
    fn add(&mut self, frames: &[&[T]], saturation: f64) {
        let mut batch = <Self as PartialSums<T>>::new(self.mean.len());
        batch.add_means(frames, saturation);
        batch.add_scatter(frames);
        <Self as PartialSums<T>>::merge(self, &batch, 0.0);
    }

    #[inline(always)]
    fn totals(&self, frames: &[&[T]], left_out: &[bool]) -> Vec<(f64, usize)> {
        let total = |samples: &&[T]| {
            let (mut sum, mut count) = (0.0, 0);
            for (i, (sample, first)) in samples.iter().zip(&self.first).enumerate() {
                let difference = sample.to_f64() - first;
                if difference.is_finite() && left_out.get(i) != Some(&true) {
                    (sum, count) = (sum + difference, count + 1);
                }
            }
            (sum, count)
        };
        frames.iter().map(total).collect()
    }

    fn offsets(&self, other: &Self, left_out: &[bool]) -> (f64, usize) {
        let pairs = self.first.iter().zip(&other.first).map(|(here, there)| there - here);
        let known = pairs
            .enumerate()
            .filter(|&(i, difference)| difference.is_finite() && left_out.get(i) != Some(&true));
        known.fold((0.0, 0), |(sum, count), (_, difference)| (sum + difference, count + 1))
    }

    #[inline(always)]
    fn merge(&mut self, other: &Self, offset: f64) {
        for i in 0..self.mean.len() {
            let (here, there) = (f64::from(self.count[i]), f64::from(other.count[i]));
            let share = there / (here + there).max(1.0);
            let delta = other.mean[i] - self.mean[i];
            self.mean[i] += delta * share;
            self.scatter[i] += other.scatter[i] + delta * delta * here * share;
            self.count[i] += other.count[i];
            self.saturated[i] += other.saturated[i];
            if self.first[i].is_nan() {
                self.first[i] = other.first[i] - offset;
            }
        }
    }

    fn finish(&self, statistics: &mut Statistics) {
        let mean = |(&mean, &count): (&f64, &u32)| if count == 0 { f64::NAN } else { mean };
        let variance = |(&scatter, &count): (&f64, &u32)| {
            if count < 2 { f64::NAN } else { scatter / f64::from(count - 1) }
        };
        statistics.mean.extend(self.mean.iter().zip(&self.count).map(mean));
        statistics.variance.extend(self.scatter.iter().zip(&self.count).map(variance));
        statistics.count.extend(&self.count);
        statistics.saturated.extend(&self.saturated);
    }
}

impl Bytes for Moments {
    fn write(&self, bytes: &mut Vec<u8>) {
        self.count.write(bytes);
        self.saturated.write(bytes);
        [&self.mean, &self.scatter, &self.first].iter().for_each(|each| each.write(bytes));
    }

    fn read(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        self.count.read(reader)?;
        self.saturated.read(reader)?;
        self.mean.read(reader)?;
        self.scatter.read(reader)?;
        self.first.read(reader)
    }
}

/// Sums over some frames.
#[derive(Clone, Debug)]
struct Part<T: Summable> {
    light: T::Light,
    blocks: Vec<T::Sums>,
}

impl<T: Summable> Part<T> {
    fn new(shape: Shape) -> Self {
        let blocks = (0..shape.len()).step_by(BLOCK);
        let blocks = blocks.map(|start| T::Sums::new(BLOCK.min(shape.len() - start))).collect();
        Self { light: T::Light::default(), blocks }
    }

    /// By how much the first values of `later` are higher.
    fn offset(&self, later: &Self, left_out: &[bool]) -> f64 {
        let pairs = self.blocks.iter().zip(&later.blocks).enumerate();
        let offsets = pairs.map(|(index, (a, b))| a.offsets(b, block_of(left_out, index)));
        let (sum, count) = offsets.fold((0.0, 0), |(a, m), (b, n)| (a + b, m + n));
        sum / count.max(1) as f64
    }

    fn merge(&mut self, later: &Self, left_out: &[bool]) {
        let offset = self.offset(later, left_out);
        self.light.merge(&later.light, offset);
        self.blocks.iter_mut().zip(&later.blocks).for_each(|(a, b)| a.merge(b, offset));
    }
}

/// Partial sums of frames of one shape; its size does not depend on their number.
#[derive(Clone, Debug)]
pub struct Accumulator<T: Summable> {
    shape: Shape,
    saturation: f64,
    frames: u32,
    left_out: Vec<bool>,
    /// Whole groups, merged in their order.
    earlier: Option<Part<T>>,
    /// The last group, and the number of its frames.
    group: Part<T>,
    in_group: u32,
}

impl<T: Summable> Accumulator<T> {
    /// Sums of no frames; samples of `saturation` and above are counted as saturated, by default
    /// those at the full scale of an integer type.
    ///
    /// # Errors
    /// [`Error::Value`] if `saturation` is NaN; [`Error::Shape`] if a frame has no pixel;
    /// [`Error::Memory`] if there is no memory for the sums and what comes of them.
    pub fn new(shape: Shape, saturation: Option<f64>) -> Result<Self> {
        Stack::<T>::new("frames", &[], 0, shape)?;
        let saturation = saturation.or(T::FULL_SCALE).unwrap_or(f64::INFINITY);
        if saturation.is_nan() {
            return Err(Error::value("saturation", "is NaN, expected a level in DN"));
        }
        memory::check(Self::bytes(shape), || format!("averaging frames of {shape}"))?;
        let (group, left_out) = (Part::new(shape), Vec::new());
        Ok(Self { shape, saturation, frames: 0, left_out, earlier: None, group, in_group: 0 })
    }

    /// The same sums, of which pixels where `mask` is true show no light.
    ///
    /// # Errors
    /// [`Error::Shape`] if it has not as many pixels as a frame.
    pub fn masked(mut self, mask: &[bool]) -> Result<Self> {
        if mask.len() != self.shape.len() {
            let (got, wanted) = (format!("{} pixels", mask.len()), self.shape.to_string());
            return Err(Error::Shape { argument: "mask", got, wanted });
        }
        self.left_out = mask.to_vec();
        Ok(self)
    }

    /// Sizes of one frame.
    #[must_use]
    pub const fn shape(&self) -> Shape {
        self.shape
    }

    /// Bytes of the sums over frames of `shape` and of what comes of them.
    pub(crate) const fn bytes(shape: Shape) -> u64 {
        let parts = if T::Sums::GROUPED { 2 } else { 1 };
        (shape.len() as u64).saturating_mul((parts * T::Sums::BYTES + Statistics::BYTES) as u64)
    }

    /// Adds frames.
    ///
    /// # Errors
    /// [`Error::Shape`] if they have another shape, [`Error::Value`] if there are more than
    /// 2³² − 1 in all; nothing is added then. [`Error::Cancelled`]: a part has been added.
    pub fn add(&mut self, frames: &Stack<T>, workers: &Workers, control: &Control) -> Result<()> {
        self.fits(frames.shape())?;
        self.frames = self.total(frames.count())?;
        let all: Vec<&[T]> = (0..frames.count()).map(|index| frames.frame(index)).collect();
        let mut rest = all.as_slice();
        while !rest.is_empty() {
            if T::Sums::GROUPED && self.in_group >= GROUP {
                self.close_group();
            }
            let room = if T::Sums::GROUPED { (GROUP - self.in_group) as usize } else { BATCH };
            let (batch, others) = rest.split_at(rest.len().min(BATCH).min(room));
            self.add_batch(batch, workers, control)?;
            rest = others;
        }
        Ok(())
    }

    fn add_batch(&mut self, batch: &[&[T]], workers: &Workers, control: &Control) -> Result<()> {
        let (saturation, left_out) = (self.saturation, &self.left_out);
        let totals = workers.map_blocks(&mut self.group.blocks, 1, |index, block| {
            if control.is_cancelled() {
                return Vec::new();
            }
            add_block::<T>(&mut block[0], batch, index, saturation, left_out)
        });
        control.check()?;
        for frame in 0..batch.len() {
            let every = totals.iter().map(|block| block[frame]);
            let (sum, count) = every.fold((0.0, 0), |(a, m), (b, n)| (a + b, m + n));
            self.group.light.add(sum, count);
        }
        self.in_group = self.in_group.saturating_add(batch.len() as u32);
        Ok(())
    }

    /// Merges the last group to those before.
    fn close_group(&mut self) {
        let whole = std::mem::replace(&mut self.group, Part::new(self.shape));
        match &mut self.earlier {
            Some(earlier) => earlier.merge(&whole, &self.left_out),
            None => self.earlier = Some(whole),
        }
        self.in_group = 0;
    }

    /// Adds what `other` has summed over later frames, with the same mask.
    ///
    /// # Errors
    /// As [`add`](Self::add), and [`Error::Value`] if the saturation levels differ.
    pub fn merge(&mut self, other: &Self) -> Result<()> {
        self.fits(other.shape)?;
        if self.saturation != other.saturation {
            let (here, there) = (self.saturation, other.saturation);
            return Err(Error::value("saturation", format!("is {there}, expected {here} as here")));
        }
        self.frames = self.total(other.frames as usize)?;
        if self.in_group > 0 {
            self.close_group();
        }
        for part in other.earlier.iter().chain((other.in_group > 0).then_some(&other.group)) {
            match &mut self.earlier {
                Some(earlier) => earlier.merge(part, &self.left_out),
                None => self.earlier = Some(part.clone()),
            }
        }
        Ok(())
    }

    /// The sums as bytes, which [`restore`](Self::restore) takes; the mask is no part of them.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let (rows, cols) = (self.shape.rows as u64, self.shape.cols as u64);
        let mut bytes = Vec::with_capacity(128 + self.shape.len() * T::Sums::BYTES);
        bytes.extend([T::Sums::GROUPED.into(), (T::Sums::BYTES as u8)]);
        bytes.extend([rows, cols].map(u64::to_le_bytes).as_flattened());
        bytes.extend(self.saturation.to_le_bytes());
        bytes.extend([self.frames, self.in_group].map(u32::to_le_bytes).as_flattened());
        bytes.push(self.earlier.is_some().into());
        for part in self.earlier.iter().chain(Some(&self.group)) {
            part.light.write(&mut bytes);
            part.blocks.iter().for_each(|block| block.write(&mut bytes));
        }
        bytes
    }

    /// Takes the sums that [`to_bytes`](Self::to_bytes) gave in the place of its own.
    ///
    /// # Errors
    /// [`Error::Value`] if they are of another shape, type or saturation level, or incomplete;
    /// nothing is changed then.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<()> {
        let problem = "are no sums of such frames: delete them, and add the frames again";
        self.restored(bytes).ok_or_else(|| Error::value("state", problem))
    }

    fn restored(&mut self, bytes: &[u8]) -> Option<()> {
        let mut reader = Reader::new(bytes);
        let kind = reader.take(2)?;
        let sizes: [u64; 2] = [reader.number()?, reader.number()?];
        let is_same = kind == [T::Sums::GROUPED.into(), (T::Sums::BYTES as u8)]
            && sizes == [self.shape.rows as u64, self.shape.cols as u64]
            && reader.number::<f64>()? == self.saturation;
        let (frames, in_group) = (reader.number::<u32>()?, reader.number::<u32>()?);
        let has_earlier = reader.take(1)? == [1];
        if !is_same {
            return None;
        }
        let earlier = if has_earlier { Some(self.part(&mut reader)?) } else { None };
        let group = self.part(&mut reader)?;
        reader.is_empty().then_some(())?;
        (self.frames, self.in_group, self.earlier, self.group) = (frames, in_group, earlier, group);
        Some(())
    }

    fn part(&self, reader: &mut Reader<'_>) -> Option<Part<T>> {
        let mut part = Part::<T>::new(self.shape);
        part.light.read(reader)?;
        part.blocks.iter_mut().try_for_each(|block| block.read(reader))?;
        Some(part)
    }

    /// Mean and variance of all that was added.
    #[must_use]
    pub fn finish(&self) -> Statistics {
        let Some(earlier) = &self.earlier else { return self.finished(&self.group, None) };
        self.finished(earlier, (self.in_group > 0).then_some(&self.group))
    }

    /// What the sums come to, with those over later frames: block by block, in no memory of a frame.
    fn finished(&self, sums: &Part<T>, later: Option<&Part<T>>) -> Statistics {
        let size = self.shape.len();
        let offset = later.map_or(0.0, |later| sums.offset(later, &self.left_out));
        let mut light = sums.light.clone();
        if let Some(later) = later {
            light.merge(&later.light, offset);
        }
        let mut statistics = Statistics {
            shape: self.shape,
            mean: Vec::with_capacity(size),
            variance: Vec::with_capacity(size),
            count: Vec::with_capacity(size),
            saturated: Vec::with_capacity(size),
            light_variance: light.variance(),
        };
        for (index, block) in sums.blocks.iter().enumerate() {
            match later {
                Some(later) => {
                    let mut both = block.clone();
                    both.merge(&later.blocks[index], offset);
                    both.finish(&mut statistics);
                }
                None => block.finish(&mut statistics),
            }
        }
        statistics
    }

    fn fits(&self, shape: Shape) -> Result<()> {
        if shape == self.shape {
            return Ok(());
        }
        Err(Error::Shape {
            argument: "frames",
            got: shape.to_string(),
            wanted: format!("{} like the frames before", self.shape),
        })
    }

    fn total(&self, more: usize) -> Result<u32> {
        let total = u32::try_from(more).ok().and_then(|more| self.frames.checked_add(more));
        total.ok_or_else(|| Error::value("frames", "are more than 4294967295 in all"))
    }
}

/// The values of a block's pixels; none of none.
fn block_of(mask: &[bool], index: usize) -> &[bool] {
    let start = index * BLOCK;
    &mask[start.min(mask.len())..mask.len().min(start + BLOCK)]
}

/// Adds the pixels of a block of a batch of frames, by the widest vectors the processor has;
/// the sum and number of those that show the light of each frame.
fn add_block<T: Summable>(
    block: &mut T::Sums,
    batch: &[&[T]],
    index: usize,
    saturation: f64,
    left_out: &[bool],
) -> Vec<(f64, usize)> {
    let start = index * BLOCK;
    let pieces: Vec<&[T]> =
        batch.iter().map(|frame| &frame[start..frame.len().min(start + BLOCK)]).collect();
    let left_out = block_of(left_out, index);
    pulp::Arch::new().dispatch(
        #[inline(always)]
        || {
            block.add(&pieces, saturation);
            block.totals(&pieces, left_out)
        },
    )
}
