//! The shift between two frames by phase correlation on low frequencies.
//!
//! C. D. Kuglin, D. C. Hines, "The phase correlation image alignment method", Proceedings of the IEEE
//! International Conference on Cybernetics and Society (1975) 163–165. A pattern of the pixels stands
//! still, and is white, so at high frequencies the correlation locks on it and gives no shift. Scenes have
//! most of their power at low frequencies.

use super::spectrum::{Spectrum, Transform};
use crate::parallel::Workers;

/// Most Newton steps from the best whole shift.
const STEPS: usize = 8;

/// A step in pixels after which the shift is known to the rounding of the phases.
const SMALL: f64 = 1e-9;

/// Least amplitude of a cross spectrum that has a phase.
const NOTHING: f64 = 1e-30;

/// The frequencies of which the phases are used, one of each pair ±f, and the largest whole shift.
#[derive(Debug)]
pub(super) struct PhaseCorrelation {
    most: isize,
    /// Entries of the spectrum, and their frequencies in radians per pixel.
    entries: Vec<(usize, [f64; 2])>,
}

/// A shift d with after(p) = before(p + d).
#[derive(Clone, Copy, Debug)]
pub(super) struct Shift {
    pub(super) pixels: [f64; 2],
    /// Mean cosine of the phases that the shift leaves: 1 for a perfect match, 0 by chance.
    pub(super) agreement: f64,
}

impl PhaseCorrelation {
    pub(super) fn new(transform: &Transform, cutoff: f64, most: usize) -> Self {
        let [lines, cols] = transform.sizes();
        let largest = 2.0 * std::f64::consts::PI * cutoff;
        let used = |[u, v]: [f64; 2]| (v > 0.0 || u > 0.0) && u.hypot(v) < largest;
        let entries = (0..lines * cols).map(|entry| (entry, transform.frequency(entry)));
        Self { most: most as isize, entries: entries.filter(|(_, f)| used(*f)).collect() }
    }

    /// The shift with the largest Σ cos(phase − f·d).
    pub(super) fn shift(&self, before: &Spectrum, after: &Spectrum, workers: &Workers) -> Shift {
        let phases: Vec<_> = self.entries.iter().map(|(i, _)| phase(before, after, *i)).collect();
        let mut pixels = self.best_whole(&phases, workers);
        for _ in 0..STEPS {
            let last = pixels;
            pixels = self.newton(&phases, last);
            if (pixels[0] - last[0]).hypot(pixels[1] - last[1]) < SMALL {
                break;
            }
        }
        let left = phases.iter().zip(&self.entries).map(|(p, (_, f))| turned(*p, *f, pixels)[0]);
        let agreement = left.sum::<f64>() / phases.len() as f64;
        Shift { pixels, agreement }
    }

    /// The best of all whole shifts within reach.
    fn best_whole(&self, phases: &[[f64; 2]], workers: &Workers) -> [f64; 2] {
        let shifts = |index: usize| index as isize - self.most;
        let count = 2 * self.most as usize + 1;
        let best = workers.map(count, |col| {
            let lines = self.summed_along_cols(phases, shifts(col) as f64);
            let height = |row: usize| {
                let row = [shifts(row) as f64, 0.0];
                let terms = lines.iter().map(|(u, sum)| turned(*sum, [*u, 0.0], row)[0]);
                (terms.sum::<f64>(), [row[0], shifts(col) as f64])
            };
            (0..count).map(height).fold((f64::NEG_INFINITY, [0.0; 2]), higher)
        });
        best.into_iter().fold((f64::NEG_INFINITY, [0.0; 2]), higher).1
    }

    /// Σ over the frequencies along the columns, for each frequency along the rows.
    fn summed_along_cols(&self, phases: &[[f64; 2]], col: f64) -> Vec<(f64, [f64; 2])> {
        let mut lines: Vec<(f64, [f64; 2])> = Vec::new();
        for (value, (_, frequency)) in phases.iter().zip(&self.entries) {
            let [re, im] = turned(*value, [0.0, frequency[1]], [0.0, col]);
            match lines.last_mut() {
                Some((u, sum)) if *u == frequency[0] => *sum = [sum[0] + re, sum[1] + im],
                _ => lines.push((frequency[0], [re, im])),
            }
        }
        lines
    }

    /// A Newton step to the maximum, if the curvature has one.
    fn newton(&self, phases: &[[f64; 2]], pixels: [f64; 2]) -> [f64; 2] {
        let (mut slope, mut curvature) = ([0.0; 2], [0.0; 3]);
        for (value, (_, [u, v])) in phases.iter().zip(&self.entries) {
            let [re, im] = turned(*value, [*u, *v], pixels);
            slope = [slope[0] + u * im, slope[1] + v * im];
            curvature =
                [curvature[0] + u * u * re, curvature[1] + v * v * re, curvature[2] + u * v * re];
        }
        let [uu, vv, uv] = curvature;
        let determinant = uu * vv - uv * uv;
        if uu <= 0.0 || determinant <= 0.0 {
            return pixels;
        }
        let step = [
            (vv * slope[0] - uv * slope[1]) / determinant,
            (uu * slope[1] - uv * slope[0]) / determinant,
        ];
        [pixels[0] + step[0].clamp(-1.0, 1.0), pixels[1] + step[1].clamp(-1.0, 1.0)]
    }
}

/// The higher of two peaks, the first of equal ones.
fn higher(one: (f64, [f64; 2]), other: (f64, [f64; 2])) -> (f64, [f64; 2]) {
    if other.0 > one.0 { other } else { one }
}

/// exp(i phase) of the cross spectrum.
fn phase(before: &Spectrum, after: &Spectrum, entry: usize) -> [f64; 2] {
    let [a, b, c, d] = [&before.re, &before.im, &after.re, &after.im].map(|v| f64::from(v[entry]));
    let (re, im) = (c * a + d * b, d * a - c * b);
    let size = re.hypot(im).max(NOTHING);
    [re / size, im / size]
}

/// value · exp(−i f·d).
fn turned([re, im]: [f64; 2], [u, v]: [f64; 2], [row, col]: [f64; 2]) -> [f64; 2] {
    let (sin, cos) = (u * row + v * col).sin_cos();
    [re * cos + im * sin, im * cos - re * sin]
}
