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

/// Frames that show different scenes are taken for a pair this often, at most.
const FALSE_ALARMS: f64 = 0.01;

/// Largest share of the power of both frames that their difference has, moved by the shift: half of their power is
/// noise then, or they are unrelated.
const MOST_LEFT: f64 = 0.5;

/// Phases for each independent one: Hann windows correlate the amplitudes of neighbouring frequencies by 2/3
/// and 1/6, the phase factors of the cross spectrum by 0.308 and 0.017 along an axis, and 0.128, 0.0076 and
/// 0.0005 across: 1 + 4·0.308 + 4·0.017 + 4·0.128 + 8·0.0076 + 4·0.0005.
const CORRELATED: f64 = 2.88;

/// Largest parameter s of the bound: there A is 1 − 1/2000.
const MOST_SHARP: f64 = 1e3;

/// Most halvings of the interval of s.
const STEPS_OF_CHANCE: usize = 60;

/// Places of the mean over a phase: exp(s cos) is 1/√s = 0.03 rad wide at least.
const PLACES: usize = 1024;

/// The frequencies of which the phases are used, one of each pair ±f, and the largest whole shift.
#[derive(Debug)]
pub(super) struct PhaseCorrelation {
    most: isize,
    /// Frequencies along the columns, and those along the rows from the lowest.
    cols: Vec<f64>,
    rows: Vec<f64>,
    /// Entries of the spectrum, and their frequencies in radians per pixel.
    entries: Vec<(usize, [f64; 2])>,
}

/// A shift d with after(p) = before(p + d).
#[derive(Clone, Copy, Debug)]
pub(super) struct Shift {
    pub(super) pixels: [f64; 2],
    /// Mean cosine of the phases that the shift leaves: 1 for a perfect match, 0 by chance.
    pub(super) agreement: f64,
    /// Whether both frames show one scene that moved.
    pub(super) shows: bool,
}

impl PhaseCorrelation {
    pub(super) fn new(transform: &Transform, cutoff: f64, most: usize) -> Self {
        let [lines, cols] = transform.sizes();
        let largest = 2.0 * std::f64::consts::PI * cutoff;
        let used = |[u, v]: [f64; 2]| (v > 0.0 || u > 0.0) && u.hypot(v) < largest;
        let entries = (0..lines * cols).map(|entry| (entry, transform.frequency(entry)));
        let entries = entries.filter(|(_, f)| used(*f)).collect();
        let rows = (0..lines).map(|line| transform.frequency(line * cols)[0]).collect();
        let cols = (0..cols).map(|col| transform.frequency(col)[1]).collect();
        Self { most: most as isize, cols, rows, entries }
    }

    /// The mean cosine that the best shift between frames of different scenes exceeds with the probability
    /// `FALSE_ALARMS`.
    ///
    /// Of n independent phases it exceeds A(s) = I₁(s)/I₀(s) with a probability of at most
    /// exp(−n (s A(s) − ln I₀(s))), Chernoff's bound. The search covers (2 most + 1)² · π cutoff² independent
    /// shifts.
    pub(super) fn chance(&self, cutoff: f64) -> f64 {
        let side = 2.0 * self.most as f64 + 1.0;
        let searched = (std::f64::consts::PI * (side * cutoff).powi(2)).max(1.0);
        let wanted = (searched / FALSE_ALARMS).ln() * CORRELATED / self.entries.len() as f64;
        let (mut low, mut high) = (0.0, MOST_SHARP);
        for _ in 0..STEPS_OF_CHANCE {
            let middle = 0.5 * (low + high);
            let [mean, rate] = concentrated(middle);
            (low, high) = if rate < wanted { (middle, high) } else { (low, middle) };
            if high - low < SMALL * mean {
                break;
            }
        }
        concentrated(high)[0]
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
        let turns = self.turns(pixels);
        let left = phases.iter().zip(&self.entries).map(|(p, (i, _))| turned(*p, turns(*i))[0]);
        let agreement = left.sum::<f64>() / phases.len() as f64;
        let shows = self.shows(before, after, pixels);
        Shift { pixels, agreement, shows }
    }

    /// Whether the shift leaves a small part of the power of both frames, and less than no shift leaves: in a scene
    /// that stands still, wholly or half, a shift explains nothing.
    fn shows(&self, before: &Spectrum, after: &Spectrum, pixels: [f64; 2]) -> bool {
        let (mut power, mut left, mut unmoved) = (0.0, 0.0, 0.0);
        let turns = self.turns(pixels);
        for (entry, _) in &self.entries {
            let [a, b, c, d] =
                [&before.re, &before.im, &after.re, &after.im].map(|v| f64::from(v[*entry]));
            let sum = a * a + b * b + c * c + d * d;
            let cross = [c * a + d * b, d * a - c * b];
            power += sum;
            left += sum - 2.0 * turned(cross, turns(*entry))[0];
            unmoved += sum - 2.0 * cross[0];
        }
        left < MOST_LEFT * power && left < unmoved
    }

    /// The best of all whole shifts within reach.
    fn best_whole(&self, phases: &[[f64; 2]], workers: &Workers) -> [f64; 2] {
        let shifts: Vec<_> = (-self.most..=self.most).map(|shift| shift as f64).collect();
        let rows: Vec<_> = shifts.iter().map(|row| factors(&self.rows, *row)).collect();
        let best = workers.map(shifts.len(), |col| {
            let lines = self.summed_along_cols(phases, shifts[col]);
            let height = |row: usize| {
                let terms = lines.iter().zip(&rows[row]).map(|(sum, by)| turned(*sum, *by)[0]);
                (terms.sum::<f64>(), [shifts[row], shifts[col]])
            };
            (0..shifts.len()).map(height).fold((f64::NEG_INFINITY, [0.0; 2]), higher)
        });
        best.into_iter().fold((f64::NEG_INFINITY, [0.0; 2]), higher).1
    }

    /// Σ over the frequencies along the columns, for each frequency along the rows.
    fn summed_along_cols(&self, phases: &[[f64; 2]], col: f64) -> Vec<[f64; 2]> {
        let (mut lines, by) = (vec![[0.0; 2]; self.rows.len()], factors(&self.cols, col));
        for (value, (entry, _)) in phases.iter().zip(&self.entries) {
            let [re, im] = turned(*value, by[entry % by.len()]);
            let sum = &mut lines[entry / by.len()];
            *sum = [sum[0] + re, sum[1] + im];
        }
        lines
    }

    /// exp(i f·d) of each entry of a spectrum, as the product of those along both axes: as many as a side has pixels are
    /// computed, not as many as the array has.
    fn turns(&self, [row, col]: [f64; 2]) -> impl Fn(usize) -> [f64; 2] {
        let (rows, cols) = (factors(&self.rows, row), factors(&self.cols, col));
        move |entry| {
            let ([a, b], [c, d]) = (rows[entry / cols.len()], cols[entry % cols.len()]);
            [a * c - b * d, a * d + b * c]
        }
    }

    /// A Newton step to the maximum, if the curvature has one.
    fn newton(&self, phases: &[[f64; 2]], pixels: [f64; 2]) -> [f64; 2] {
        let (mut slope, mut curvature) = ([0.0; 2], [0.0; 3]);
        let turns = self.turns(pixels);
        for (value, (entry, [u, v])) in phases.iter().zip(&self.entries) {
            let [re, im] = turned(*value, turns(*entry));
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

/// exp(i f d) of some frequencies.
fn factors(frequencies: &[f64], shift: f64) -> Vec<[f64; 2]> {
    let factor = |f: &f64| [(f * shift).cos(), (f * shift).sin()];
    frequencies.iter().map(factor).collect()
}

/// value / factor, of a factor of size 1.
fn turned([re, im]: [f64; 2], [cos, sin]: [f64; 2]) -> [f64; 2] {
    [re * cos + im * sin, im * cos - re * sin]
}

/// A(s) and s A(s) − ln I₀(s), from means of exp(s (cos − 1)) over a phase.
fn concentrated(s: f64) -> [f64; 2] {
    let (mut sum, mut moment) = (0.0, 0.0);
    for place in 0..PLACES {
        let cos = (2.0 * std::f64::consts::PI * place as f64 / PLACES as f64).cos();
        let weight = (s * (cos - 1.0)).exp();
        sum += weight;
        moment += weight * cos;
    }
    let mean = moment / sum;
    [mean, s * (mean - 1.0) - (sum / PLACES as f64).ln()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Shape;

    #[test]
    fn shifts_are_found_to_a_fraction_of_a_pixel() {
        let workers = Workers::new(std::num::NonZeroUsize::new(2)).unwrap();
        let transform = Transform::new(Shape::new(96, 128), 0.1);
        let correlation = PhaseCorrelation::new(&transform, 0.1, 8);
        let count = transform.sizes().iter().product::<usize>();
        let part = |i: usize, factor: usize| ((i * factor) % 1009) as f32 / 505.0 - 1.0;
        let before = Spectrum {
            re: (0..count).map(|i| part(i, 7919)).collect(),
            im: (0..count).map(|i| part(i, 6007)).collect(),
        };
        for wanted in [[0.5, -1.5], [2.4, 0.6], [-0.3, 3.7]] {
            let moved = |i: usize| {
                let value = [f64::from(before.re[i]), f64::from(before.im[i])];
                let [u, v] = transform.frequency(i);
                let angle = u * wanted[0] + v * wanted[1];
                turned(value, [angle.cos(), -angle.sin()])
            };
            let after = Spectrum {
                re: (0..count).map(|i| moved(i)[0] as f32).collect(),
                im: (0..count).map(|i| moved(i)[1] as f32).collect(),
            };
            let found = correlation.shift(&before, &after, &workers);
            let error = (found.pixels[0] - wanted[0]).hypot(found.pixels[1] - wanted[1]);
            // Amplitudes are above 1e-3, so phases err by 1e-4 at most, over frequencies near 0.3 a pixel.
            assert!(error < 1e-4 / 0.3, "{wanted:?}: {found:?}");
        }
    }

    #[test]
    fn chance_agrees_with_the_normal_law_of_many_phases_and_stays_below_one() {
        let chance = |side: usize| {
            let transform = Transform::new(Shape::new(side, side), 0.1);
            let correlation = PhaseCorrelation::new(&transform, 0.1, 8);
            (correlation.chance(0.1), correlation.entries.len() as f64)
        };
        let (found, phases) = chance(512);
        let searched = std::f64::consts::PI * 1.7 * 1.7;
        let wanted = ((searched / 0.01).ln() * CORRELATED / phases).sqrt();
        // The rate is A² (1 + A²/4 + …) of the mean cosine A.
        assert!((found / wanted - 1.0).abs() < found * found);
        assert!(chance(24).0 < 1.0 && chance(24).0 > chance(64).0);
    }
}
