//! Finds the spot: where it is, how high, and the window that holds it with its blur.

use std::f64::consts::PI;

use super::image::{BLOCKS, Image};
use super::region::Region;
use super::surface::{Point, Surface, Terms, along_row, median, robust_deviation};
use crate::connectivity::{NONE, label_pixels};
use crate::control::Control;
use crate::error::{Result, SpotProblem};
use crate::frames::Shape;

/// A spot has at least this many pixels: its level is that of the lowest of its brightest 16.
const SPOT_PIXELS: usize = 16;

/// A spot stands out by more than this many standard deviations of the smoothed background.
const DETECTION: f64 = 8.0;

/// Values of a block that its median and its noise are taken from: 2²⁰ of an image. The noise of the
/// image, from all blocks, errs by 0.1 % then, the background by 0.4 % of the noise of a pixel.
const SAMPLE: usize = 1 << 12;

/// Its multiples are evenly spread between whole numbers, and have no period.
const GOLDEN_RATIO: f64 = 0.618_033_988_749_894_9;

/// A second spot counts as comparable from this part of the first one's area.
const COMPARABLE: f64 = 0.25;

/// Background that the window leaves on every side at least.
pub(super) const RIM: i64 = 3;

/// Where the spot is.
#[derive(Debug)]
pub(super) struct Detection {
    /// Holds the spot and its blur.
    pub(super) window: Region,
    /// Level of the spot above the background.
    pub(super) level: f64,
    /// Level that it had to exceed.
    pub(super) wanted: f64,
    /// By how much light can depart from the mean of opposite neighbours at most: 0.75/σ² of the
    /// height at the top of a Gaussian, less on an outline; with room for non-uniformity and noise.
    pub(super) departure: f64,
}

/// Finds the largest connected spot.
pub(super) fn detect(image: &Image, control: &Control) -> Result<Detection> {
    let excess = excess(image, control)?;
    let noise = noise(&excess, image.shape, control)?;
    let level = level(&excess);
    let wanted = DETECTION * noise;
    let found = if level > wanted {
        components(&excess, image.shape, level / 2.0, control)?
    } else {
        Vec::new()
    };
    let spot = match found[..] {
        [] => return Err(image.missing(level, wanted)),
        [first, second, ..] if second.area as f64 >= COMPARABLE * first.area as f64 => {
            return Err(image.problem(SpotProblem::Doubled {
                first: first.centre(),
                second: second.centre(),
                areas: [first.area, second.area],
            }));
        }
        [first, ..] => first,
    };
    let blur = blur(&excess, image.shape, &spot, level, noise);
    let margin = 3.5 * blur;
    let window = spot.region.widened(margin.ceil() as i64 + 1);
    let needed = window.widened(RIM);
    if needed.clipped(Region::of(image.shape)) != needed {
        return Err(image.problem(SpotProblem::Cut {
            centre: spot.centre(),
            rows: [needed.top, needed.bottom - 1],
            cols: [needed.left, needed.right - 1],
            shape: [image.shape.rows, image.shape.cols],
        }));
    }
    let highest = excess.iter().copied().fold(level, f64::max);
    let departure = highest * (0.2 + 0.75 * blur.powi(-2)) + 15.0 * noise;
    Ok(Detection { window, level, wanted, departure })
}

/// The image, each pixel the median of itself and its neighbours, above the smooth background.
fn excess(image: &Image, control: &Control) -> Result<Vec<f64>> {
    let shape = image.shape;
    let background = background(image, control)?;
    let scaled = |index: usize, count: usize| (2 * index + 1) as f64 / count as f64 - 1.0;
    let places: Vec<f64> = (0..shape.cols).map(|col| scaled(col, shape.cols)).collect();
    let mut excess = vec![0.0; shape.len()];
    for (row, values) in excess.chunks_mut(shape.cols).enumerate() {
        control.check()?;
        median_of_nine(image, row, values);
        let [zeroth, first, second, third] = along_row(&background, scaled(row, shape.rows));
        for (value, c) in values.iter_mut().zip(&places) {
            *value -= ((third * c + second) * c + first) * c + zeroth;
        }
    }
    Ok(excess)
}

/// Row `row` of the median filter over 3×3 pixels, the outermost pixels repeated at the border:
/// single hot and dead pixels, and pairs of them, vanish.
fn median_of_nine(image: &Image, row: usize, medians: &mut [f64]) {
    let shape = image.shape;
    let line = |row: usize| &image.values[row * shape.cols..][..shape.cols];
    let [above, itself, below] =
        [row.saturating_sub(1), row, (row + 1).min(shape.rows - 1)].map(line);
    // The sorted values of each column, in arrays of their own, which vector registers hold.
    let [mut lows, mut middles, mut highs] = [(); 3].map(|()| vec![0.0; shape.cols + 2]);
    for col in 0..shape.cols {
        [lows[col + 1], middles[col + 1], highs[col + 1]] =
            sorted(above[col], itself[col], below[col]);
    }
    for values in [&mut lows, &mut middles, &mut highs] {
        values[0] = values[1];
        values[shape.cols + 1] = values[shape.cols];
    }
    let columns = lows.windows(3).zip(middles.windows(3)).zip(highs.windows(3));
    for (median, ((low, middle), high)) in medians.iter_mut().zip(columns) {
        // The middle of the highest low, the middle of the middles and the lowest high.
        let low = low[0].max(low[1]).max(low[2]);
        let high = high[0].min(high[1]).min(high[2]);
        *median = sorted(low, sorted(middle[0], middle[1], middle[2])[1], high)[1];
    }
}

fn sorted(a: f64, b: f64, c: f64) -> [f64; 3] {
    let (low, high) = (a.min(b), a.max(b));
    [low.min(c), low.max(high.min(c)), high.max(c)]
}

/// Cubic surface through the medians of blocks, those with the spot clipped, in coordinates
/// from −1 to 1.
fn background(image: &Image, control: &Control) -> Result<Terms> {
    let shape = image.shape;
    let scaled = |first: i64, end: i64, count: usize| (first + end) as f64 / count as f64 - 1.0;
    let mut points = Vec::with_capacity(BLOCKS * BLOCKS);
    for block in blocks(shape) {
        control.check()?;
        let mut values = sample(block, &image.values, shape);
        let place = [
            scaled(block.top, block.bottom, shape.rows),
            scaled(block.left, block.right, shape.cols),
        ];
        points.push(Point { place, value: median(&mut values) });
    }
    Ok(Surface::fit(&points).coefficients)
}

fn blocks(shape: Shape) -> impl Iterator<Item = Region> {
    let edge = |index: usize, count: usize| (index * count / BLOCKS) as i64;
    (0..BLOCKS * BLOCKS).map(move |index| {
        let (i, j) = (index / BLOCKS, index % BLOCKS);
        Region {
            top: edge(i, shape.rows),
            bottom: edge(i + 1, shape.rows),
            left: edge(j, shape.cols),
            right: edge(j + 1, shape.cols),
        }
    })
}

/// Values of a block: of more than [`SAMPLE`] one in each of so many equal stretches. Where in its
/// stretch a value stands has no period, so that rows, columns and colours have their shares.
fn sample(block: Region, image: &[f64], shape: Shape) -> Vec<f64> {
    let (width, count) = (block.width(), block.width() * block.height());
    let first = block.top as usize * shape.cols + block.left as usize;
    let edge = |index: usize| index * count / count.min(SAMPLE);
    let place = |index: usize| {
        let within = (index as f64 * GOLDEN_RATIO).fract();
        edge(index) + (within * (edge(index + 1) - edge(index)) as f64) as usize
    };
    let value = |place: usize| image[first + place / width * shape.cols + place % width];
    (0..count.min(SAMPLE)).map(place).map(value).collect()
}

/// Standard deviation within blocks, the median over the blocks.
fn noise(excess: &[f64], shape: Shape, control: &Control) -> Result<f64> {
    let mut noises = Vec::with_capacity(BLOCKS * BLOCKS);
    for block in blocks(shape) {
        control.check()?;
        let mut values = sample(block, excess, shape);
        noises.push(robust_deviation(&mut values));
    }
    Ok(median(&mut noises))
}

/// The lowest of the [`SPOT_PIXELS`] highest values: clusters of fewer bad pixels do not count.
fn level(excess: &[f64]) -> f64 {
    let mut highest = [f64::NEG_INFINITY; SPOT_PIXELS];
    for &value in excess {
        if value > highest[0] {
            highest[0] = value;
            highest.sort_unstable_by(f64::total_cmp);
        }
    }
    highest[0]
}

/// A connected set of pixels.
#[derive(Clone, Copy, Debug)]
struct Component {
    area: usize,
    region: Region,
    sum: [f64; 2],
}

impl Component {
    fn centre(&self) -> [f64; 2] {
        self.sum.map(|sum| sum / self.area as f64)
    }
}

/// The sets of connected pixels above `threshold`, the largest first.
fn components(
    excess: &[f64],
    shape: Shape,
    threshold: f64,
    control: &Control,
) -> Result<Vec<Component>> {
    let Some(region) = region_above(excess, shape, threshold) else { return Ok(Vec::new()) };
    let mask: Vec<bool> =
        region.rows(excess, shape).flatten().map(|&value| value > threshold).collect();
    let labels = label_pixels(&mask, Shape::new(region.height(), region.width()), control)?;
    let mut found: Vec<Component> = Vec::new();
    for (&label, (row, col)) in labels.iter().zip(region.pixels()) {
        if label == NONE {
            continue;
        }
        if label as usize == found.len() {
            let region = Region { top: row, bottom: row, left: col, right: col };
            found.push(Component { area: 0, region, sum: [0.0; 2] });
        }
        let component = &mut found[label as usize];
        component.area += 1;
        component.region = component.region.joined(row, col);
        component.sum = [component.sum[0] + row as f64, component.sum[1] + col as f64];
    }
    found.sort_by_key(|component| std::cmp::Reverse(component.area));
    Ok(found)
}

/// The smallest region that holds all values above `threshold`.
fn region_above(excess: &[f64], shape: Shape, threshold: f64) -> Option<Region> {
    let mut found: Option<Region> = None;
    for (row, values) in (0..).zip(excess.chunks(shape.cols)) {
        let above = |&value: &f64| value > threshold;
        let ends = values.iter().position(above).zip(values.iter().rposition(above));
        if let Some((first, last)) = ends.map(|(first, last)| (first as i64, last as i64)) {
            let begin = Region { top: row, bottom: row, left: first, right: first };
            found = Some(found.unwrap_or(begin).joined(row, first).joined(row, last));
        }
    }
    found
}

/// Width σ of the spot's outline, as if it were a Gaussian's.
///
/// The radii of equal area at half the level and at a lower level q are, for a Gaussian,
/// σ√(2 ln 2) and σ√(2 ln(level/q)); q is a tenth of the level or, in noise, more.
fn blur(excess: &[f64], shape: Shape, spot: &Component, level: f64, noise: f64) -> f64 {
    let radius = (spot.area as f64 / PI).sqrt();
    let low = (level / 10.0).max(3.0 * noise);
    let around = spot.region.widened(radius.ceil() as i64).clipped(Region::of(shape));
    let area = around.rows(excess, shape).flatten().filter(|&&value| value > low).count();
    let wide = (area as f64 / PI).sqrt();
    let steps = (2.0 * (level / low).ln()).sqrt() - (2.0 * 2.0_f64.ln()).sqrt();
    (wide - radius).max(0.0) / steps
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn median_of_nine_is_the_fifth(
            values in prop::collection::vec(-9_i8..9, 16 * 17)
        ) {
            let shape = Shape::new(16, 17);
            let values = values.into_iter().map(f64::from).collect();
            let image = Image { argument: "frames", values, shape };
            let mut medians = [0.0; 17];
            for row in 0..16 {
                median_of_nine(&image, row, &mut medians);
                for (col, got) in medians.into_iter().enumerate() {
                    let near = |at: usize, step: usize, end: usize| (at + step).clamp(1, end) - 1;
                    let mut nine: Vec<f64> = (0..9)
                        .map(|k| near(row, k / 3, 16) * 17 + near(col, k % 3, 17))
                        .map(|pixel| image.values[pixel])
                        .collect();
                    prop_assert_eq!(got, median(&mut nine));
                }
            }
        }
    }

    #[test]
    fn the_window_follows_the_blur() {
        let shape = Shape::new(96, 128);
        for width in [2.0, 4.0] {
            let value = |(row, col): (i64, i64)| {
                let r2 = (row as f64 - 40.0).powi(2) + (col as f64 - 70.0).powi(2);
                1000.0 * (-r2 / (2.0 * width * width)).exp() + 20.0
            };
            let values = Region::of(shape).pixels().map(value).collect();
            let image = Image { argument: "frames", values, shape };
            let found = detect(&image, &Control::new()).unwrap();
            assert_eq!(found.window.centre(), [40.0, 70.0]);
            // Half maximum at 1.18 widths, then 3.5 widths and 1 pixel; the level is below the top.
            let half = found.window.height() as f64 / 2.0;
            assert!((4.6 * width..5.2 * width + 2.0).contains(&half), "{half} for {width}");
        }
    }

    #[test]
    fn a_sample_is_spread_evenly() {
        // Four colours, and light that rises along rows and columns.
        let shape = Shape::new(250, 190);
        let value = |(row, col): (i64, i64)| (row % 2 * 2 + col % 2) as f64;
        let rise = |(row, col): (i64, i64)| row as f64 / 250.0 + col as f64 / 190.0;
        let all = Region::of(shape);
        for of_place in [&value as &dyn Fn((i64, i64)) -> f64, &rise] {
            let image: Vec<f64> = all.pixels().map(of_place).collect();
            let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
            let part = sample(all, &image, shape);
            assert_eq!(part.len(), SAMPLE);
            let std = image.iter().map(|v| (v - mean(&image)).powi(2)).sum::<f64>();
            let limit = 3.0 * (std / image.len() as f64 / SAMPLE as f64).sqrt();
            assert!((mean(&part) - mean(&image)).abs() < limit);
        }
        let small = Region { top: 3, bottom: 67, left: 5, right: 69 };
        let image: Vec<f64> = (0..shape.len()).map(|index| index as f64).collect();
        let every = small.rows(&image, shape).collect::<Vec<_>>().concat();
        assert_eq!(sample(small, &image, shape), every);
    }
}
