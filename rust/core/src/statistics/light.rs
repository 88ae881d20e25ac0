//! Variance of the means of frames over all pixels: of the light, where it varies between frames.

use super::bytes::{Bytes, Reader};

/// What is kept of the means of frames; its size does not depend on their number.
pub trait Light: Bytes + Clone + Default + std::fmt::Debug + Send + Sync {
    /// Adds a frame with this sum over so many samples.
    fn add(&mut self, sum: f64, samples: usize);
    /// Adds what `other` has of later frames, whose means count from a level that is higher by
    /// `offset`.
    fn merge(&mut self, other: &Self, offset: f64);
    /// Unbiased variance of the means; NaN of fewer than two.
    fn variance(&self) -> f64;
}

/// Sums of whole numbers, in which neither the order of the frames nor merging changes a bit.
#[derive(Clone, Debug, Default)]
pub struct WholeLight {
    frames: u32,
    samples: usize,
    sum: u128,
    squares: u128,
}

impl Light for WholeLight {
    fn add(&mut self, sum: f64, samples: usize) {
        let sum = sum as u128; // exact: below 2⁵³
        self.merge(&Self { frames: 1, samples, sum, squares: sum * sum }, 0.0);
    }

    fn merge(&mut self, other: &Self, _: f64) {
        self.frames += other.frames;
        self.samples = self.samples.max(other.samples);
        self.sum += other.sum;
        self.squares += other.squares;
    }

    fn variance(&self) -> f64 {
        let n = u128::from(self.frames);
        let square = self.sum.checked_mul(self.sum);
        let scatter = match (self.squares.checked_mul(n), square) {
            (Some(squares), Some(square)) => (squares - square) as f64,
            _ => n as f64 * self.squares as f64 - (self.sum as f64).powi(2),
        };
        let pairs = n as f64 * (n as f64 - 1.0);
        // 0/0 = NaN below two frames
        scatter / pairs.max(0.0) / (self.samples as f64).powi(2)
    }
}

impl Bytes for WholeLight {
    fn write(&self, bytes: &mut Vec<u8>) {
        self.frames.write(bytes);
        (self.samples as u64).write(bytes);
        self.sum.write(bytes);
        self.squares.write(bytes);
    }

    fn read(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        self.frames.read(reader)?;
        self.samples = reader.number::<u64>()?.try_into().ok()?;
        self.sum.read(reader)?;
        self.squares.read(reader)
    }
}

/// Mean of the means and their Σ(x − x̄)², by Chan's formula.
#[derive(Clone, Debug, Default)]
pub struct FloatLight {
    frames: f64,
    mean: f64,
    scatter: f64,
}

impl Light for FloatLight {
    fn add(&mut self, sum: f64, samples: usize) {
        if samples > 0 {
            self.merge(&Self { frames: 1.0, mean: sum / samples as f64, scatter: 0.0 }, 0.0);
        }
    }

    fn merge(&mut self, other: &Self, offset: f64) {
        let share = other.frames / (self.frames + other.frames).max(1.0);
        let delta = other.mean + offset - self.mean;
        self.mean += delta * share;
        self.scatter += other.scatter + delta * delta * self.frames * share;
        self.frames += other.frames;
    }

    fn variance(&self) -> f64 {
        if self.frames < 2.0 { f64::NAN } else { self.scatter / (self.frames - 1.0) }
    }
}

impl Bytes for FloatLight {
    fn write(&self, bytes: &mut Vec<u8>) {
        [self.frames, self.mean, self.scatter].iter().for_each(|each| each.write(bytes));
    }

    fn read(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        self.frames.read(reader)?;
        self.mean.read(reader)?;
        self.scatter.read(reader)
    }
}
