//! Tiny experiments whose truth is known.

use crate::common::{Experiment, Lamp, Noise};

/// A cross that a sensor of eight pixels a side sees.
pub(crate) const CROSS: [[f64; 2]; 5] =
    [[0.0, 0.0], [0.0, 2.0], [0.0, 3.0], [2.0, 0.0], [3.0, 0.0]];
/// The same with fractions of a pixel.
pub(crate) const BETWEEN: [[f64; 2]; 5] =
    [[0.0, 0.0], [0.31, 2.27], [-0.42, 2.64], [1.73, 0.36], [3.38, -0.29]];
/// Fluxes of a lamp that drifts.
pub(crate) const DRIFT: [f64; 5] = [1.0, 1.01, 0.99, 1.005, 0.98];
/// Times that are not affine in the shifts of a cross.
pub(crate) const TIMES: [f64; 5] = [0.0, 3.0, 1.0, 4.0, 2.0];
/// All rotations.
pub(crate) const TURNED: [i64; 5] = [0, 90, 180, 270, 0];
/// Standard deviations of measured shifts: of one that is exact, and of others.
pub(crate) const SHIFT_STD: [[f64; 2]; 5] =
    [[0.0; 2], [0.05; 2], [0.03, 0.05], [0.05; 2], [0.02; 2]];
/// The small sensor.
pub(crate) const SMALL: [usize; 2] = [8, 9];
/// One long enough for shifts to be refined on it.
pub(crate) const LONG: [usize; 2] = [8, 30];

/// How the exposures of a simulated experiment are made.
#[derive(Clone, Debug)]
pub(crate) struct Simulation {
    pub(crate) shape: [usize; 2],
    pub(crate) shifts: Vec<[f64; 2]>,
    pub(crate) degrees: Vec<i64>,
    /// The true fluxes.
    pub(crate) flux: Vec<f64>,
    pub(crate) beam: fn([f64; 2]) -> f64,
    /// The largest offset.
    pub(crate) offset: f64,
    /// The standard deviation of the noise.
    pub(crate) noise: f64,
    pub(crate) seed: u64,
}

impl Simulation {
    /// A sensor of these sizes that sees a structured beam from these positions, without noise.
    pub(crate) fn new(shape: [usize; 2], shifts: &[[f64; 2]]) -> Self {
        let count = shifts.len();
        Self {
            shape,
            shifts: shifts.to_vec(),
            degrees: vec![0; count],
            flux: vec![1.0; count],
            beam: wavy,
            offset: 0.0,
            noise: 0.0,
            seed: 1,
        }
    }

    /// The same with another beam.
    pub(crate) fn seeing(
        beam: fn([f64; 2]) -> f64,
        shape: [usize; 2],
        shifts: &[[f64; 2]],
    ) -> Self {
        Self { beam, ..Self::new(shape, shifts) }
    }

    pub(crate) fn turned(mut self, degrees: &[i64]) -> Self {
        self.degrees = degrees.to_vec();
        self
    }

    pub(crate) fn with_flux(mut self, flux: &[f64]) -> Self {
        self.flux = flux.to_vec();
        self
    }

    pub(crate) fn with_noise(mut self, noise: f64, seed: u64) -> Self {
        (self.noise, self.seed) = (noise, seed);
        self
    }

    /// Each position seen at two levels of light, the second one half of the first, with offsets.
    pub(crate) fn at_two_levels(mut self) -> Self {
        self.flux = self.flux.iter().copied().chain(self.flux.iter().map(|c| c / 2.0)).collect();
        self.shifts.extend_from_within(..);
        self.degrees.extend_from_within(..);
        self.offset = 0.1;
        self
    }

    fn pixels(&self) -> usize {
        self.shape[0] * self.shape[1]
    }

    /// The true M, of mean 1.
    pub(crate) fn sensitivity(&self) -> Vec<f64> {
        let m: Vec<f64> = (0..self.pixels()).map(|p| 1.0 + 0.05 * self.random(0, p)).collect();
        let mean = m.iter().sum::<f64>() / m.len() as f64;
        m.into_iter().map(|m| m / mean).collect()
    }

    /// The true O.
    pub(crate) fn offsets(&self) -> Vec<f64> {
        (0..self.pixels()).map(|p| 0.5 * self.offset * (1.0 + self.random(1, p))).collect()
    }

    /// The experiment, with known fluxes and shifts, and the variance of its noise for each exposure.
    pub(crate) fn experiment(&self) -> Experiment {
        let (sensitivity, offsets) = (self.sensitivity(), self.offsets());
        let mut frames = Vec::new();
        for (k, (shift, flux)) in self.shifts.iter().zip(&self.flux).enumerate() {
            for pixel in 0..self.pixels() {
                let [row, col] = place(self.shape, self.degrees[k], pixel);
                let light = flux * (self.beam)([row + shift[0], col + shift[1]]);
                let noise = self.noise * 3.0_f64.sqrt() * self.random(2 + k as u64, pixel);
                frames.push(light * sensitivity[pixel] + offsets[pixel] + noise);
            }
        }
        let variance = if self.noise > 0.0 { self.noise * self.noise } else { 1e-6 };
        Experiment {
            shape: self.shape,
            frames,
            shifts: self.shifts.clone(),
            shift_std: None,
            degrees: self.degrees.clone(),
            flux: self.flux.clone(),
            lamp: Lamp::Known,
            noise: Noise::Exposures(vec![variance; self.shifts.len()]),
            mask: Vec::new(),
            offset: self.offset > 0.0,
            dark: Vec::new(),
        }
    }

    /// A number from −1 to 1 for each pixel of a stream.
    fn random(&self, stream: u64, pixel: usize) -> f64 {
        random(self.seed * 1000 + stream, pixel)
    }
}

impl Experiment {
    /// The same with unknown fluxes, of which the lamp is all that is known: they start as equal.
    pub(crate) fn with_lamp(mut self, lamp: Lamp) -> Self {
        self.flux = vec![1.0; self.shifts.len()];
        self.lamp = lamp;
        self
    }

    /// The same with shifts that are known up to a prior, and measured wrong by half of it.
    pub(crate) fn measured_to(mut self, std: &[[f64; 2]]) -> Self {
        for (k, (shift, std)) in self.shifts.iter_mut().zip(std).enumerate() {
            (0..2).for_each(|axis| shift[axis] += 0.5 * std[axis] * random(92, 2 * k + axis));
        }
        self.shift_std = Some(std.to_vec());
        self
    }

    /// The same where a dark was subtracted whose variance is some four times that of an exposure.
    pub(crate) fn with_dark(mut self) -> Self {
        let Noise::Exposures(variance) = &self.noise else { return self };
        let pixels = self.shape[0] * self.shape[1];
        let of_pixel = |pixel| 4.0 * variance[0] * (1.0 + 0.5 * random(93, pixel));
        self.dark = (0..pixels).map(of_pixel).collect();
        self
    }

    /// The same without these measurements, by exposure.
    pub(crate) fn without(mut self, lost: &[Vec<usize>]) -> Self {
        let pixels = self.shape[0] * self.shape[1];
        self.mask.resize(self.frames.len(), false);
        for (k, own) in lost.iter().enumerate() {
            own.iter().for_each(|pixel| self.mask[k * pixels + pixel] = true);
        }
        self
    }

    /// Variances that differ threefold from measurement to measurement, and one in 67 masked, but for pixels
    /// of which that would leave so few that they leave the search. On sensors so small, more gaps would lose
    /// so many others that pixels leave it for those.
    pub(crate) fn uneven(mut self) -> Self {
        let size = self.frames.len();
        if let Noise::Exposures(variance) = &self.noise {
            let uneven = (0..size).map(|i| variance[0] * (1.0 + 0.5 * random(90, i)));
            self.noise = Noise::Measurements(uneven.collect());
        }
        let (count, pixels) = (self.shifts.len(), self.shape[0] * self.shape[1]);
        let masked = |i: usize| random(91, i) > 0.97;
        let left = |p: usize| (0..count).filter(|k| !masked(k * pixels + p)).count();
        self.mask = (0..size).map(|i| masked(i) && left(i % pixels) > 2.min(count - 1)).collect();
        self
    }
}

/// A p + t: where a pixel lies in the beam at shift 0.
pub(crate) fn place([rows, cols]: [usize; 2], degrees: i64, pixel: usize) -> [f64; 2] {
    let [row, col] = [(pixel / cols) as f64, (pixel % cols) as f64];
    let [last_row, last_col] = [rows as f64 - 1.0, cols as f64 - 1.0];
    match degrees {
        90 => [col, last_row - row],
        180 => [last_row - row, last_col - col],
        270 => [last_col - col, row],
        _ => [row, col],
    }
}

/// A beam with structure of some eight pixels.
pub(crate) fn wavy([row, col]: [f64; 2]) -> f64 {
    let waves = (0.9 * row + 0.3 * col).sin() + (0.8 * col - 0.4 * row + 1.0).sin();
    (1.0 + 0.1 * waves) * smooth([row, col])
}

/// A beam with structure of some twenty pixels, which tells shifts.
pub(crate) fn rolling([row, col]: [f64; 2]) -> f64 {
    even([row, col]) * smooth([row, col])
}

/// A narrow beam: a thousandth of the light and less at the sides.
pub(crate) fn narrow([row, col]: [f64; 2]) -> f64 {
    (-((row - 4.0).powi(2) + (col - 5.0).powi(2)) / 4.0).exp()
}

/// A beam without structure.
pub(crate) fn smooth([row, col]: [f64; 2]) -> f64 {
    (-((row - 4.0).powi(2) + (col - 5.0).powi(2)) / 900.0).exp()
}

/// A beam of third degree, which a cubic spline is, without any fourth difference.
pub(crate) fn cubic([row, col]: [f64; 2]) -> f64 {
    let [r, c] = [(row - 4.0) / 30.0, (col - 14.0) / 30.0];
    1.0 + 0.3 * r - 0.4 * c + 0.5 * r * c - 0.6 * r * r - 0.5 * c * c
        + 1.5 * r * r * r
        + 2.0 * c * c * c
}

/// The same structure in a beam that is as bright on a tall sensor as on a small one.
pub(crate) fn even([row, col]: [f64; 2]) -> f64 {
    let waves = (0.35 * row + 0.15 * col).sin() + (0.3 * col - 0.2 * row + 1.0).sin();
    1.0 + 0.2 * waves
}

/// A number from −1 to 1 that looks random: SplitMix64 (Steele, Lea and Flood 2014).
pub(crate) const fn random(stream: u64, index: usize) -> f64 {
    let mut bits = (stream << 32).wrapping_add(index as u64 + 1);
    bits = bits.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^= bits >> 31;
    bits as f64 / (1_u64 << 63) as f64 - 1.0
}
