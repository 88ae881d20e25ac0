//! Response curves of pixels from levels of a uniform source.
//!
//! At level j every pixel sees the same light, and a pixel's mean V_j deviates from the array's mean
//! V̄_j. The deviation is a polynomial of the array's mean,
//!
//! ```text
//! V − V̄ = a + K V̄ + c V̄² + e V̄³
//! ```
//!
//! V̄ averages over all pixels, so it is nearly free of noise: a regressor without error. Each pixel
//! is a weighted least-squares fit of its own,
//!
//! ```text
//! min Σ_j [V_j − V̄_j − Σ_i q_i x_j^i]² / σ_j²,   x = (V̄ − centre) / half,   σ_j² = r_j + g_j · (V − dark)
//! ```
//!
//! in x, which lies in [−1, 1], so that the normal equations are well conditioned; the coefficients
//! are then converted to powers of V̄ in DN. The variance follows the signal that the pixel is
//! expected to have: V̄ in a first fit, the first fit in the second. Evaluated at the noisy V, low
//! values would get too large weights.

use crate::control::Control;
use crate::error::{Error, Result};
use crate::frames::{Real, Shape, Stack};
use crate::memory;
use crate::parallel::Workers;

/// Most coefficients of a pixel: those of a cubic.
const TERMS: usize = 4;

/// Fits of a pixel: with variances at the array's mean, and at the signals of the fit before.
const ROUNDS: usize = 2;

/// Rows that are fitted before their polynomials are put into planes.
const ROWS: usize = 64;

/// Least pivot of the normal equations, relative to its diagonal element: below it the levels do not
/// distinguish the terms.
const PIVOT: f64 = 1e-12;

type Terms = [f64; TERMS];

/// Which powers of the array's mean the deviation of a pixel has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// a alone: one-point correction by the offset.
    Offset,
    /// K V̄ alone: one-point correction by the gain.
    Gain,
    /// a + K V̄, two-point.
    Line,
    /// To the second power.
    Quadratic,
    /// To the third power.
    Cubic,
}

impl Form {
    /// Lowest power.
    const fn first(self) -> usize {
        matches!(self, Self::Gain) as usize
    }

    /// Highest power.
    #[must_use]
    pub const fn order(self) -> usize {
        match self {
            Self::Offset => 0,
            Self::Gain | Self::Line => 1,
            Self::Quadratic => 2,
            Self::Cubic => 3,
        }
    }

    /// Number of coefficients fitted.
    #[must_use]
    pub const fn terms(self) -> usize {
        self.order() + 1 - self.first()
    }
}

/// Variance of a level's mean as a function of its value: `constant + slope · (value − dark)`.
#[derive(Clone, Copy, Debug)]
pub struct LevelNoise {
    /// Variance at `dark` and below.
    pub constant: f64,
    /// Photon noise per unit of signal.
    pub slope: f64,
    /// Value from which the signal is counted: 0 where a dark was subtracted.
    pub dark: f64,
}

impl LevelNoise {
    fn variance(self, value: f64) -> f64 {
        self.constant + self.slope * (value - self.dark).max(0.0)
    }
}

/// Mean frames of a uniform source at several levels.
#[derive(Clone, Copy, Debug)]
pub struct Levels<'a, T> {
    /// Mean frames, one a level; not finite where a value is not to be used.
    pub means: Stack<'a, T>,
    /// The array's mean V̄ at each level, in DN.
    pub references: &'a [f64],
    /// Noise of each level's mean; without it all levels have weight 1.
    pub noise: Option<&'a [LevelNoise]>,
}

/// The polynomials of all pixels; not a number where the levels of a pixel do not determine it.
#[derive(Clone, Debug)]
pub struct ResponseFit {
    /// a, K, c, e as far as the order goes: one plane of pixels behind the other, for V̄ in DN.
    pub coefficients: Vec<f64>,
    /// Their variances, in units of the variance of a value of weight 1.
    pub variances: Vec<f64>,
    /// Σ_j r_j²/σ_j² of each pixel.
    pub misfit: Vec<f64>,
    /// Levels used of each pixel.
    pub used: Vec<u32>,
}

/// Fits the deviation of every pixel from the array's mean.
///
/// # Errors
/// [`Error::Value`] if there are fewer levels than coefficients, references that are not finite or
/// do not differ, or noise that is no variance; [`Error::Memory`]; [`Error::Cancelled`].
pub fn fit<T: Real>(
    levels: &Levels<'_, T>,
    form: Form,
    workers: &Workers,
    control: &Control,
) -> Result<ResponseFit> {
    let abscissa = Abscissa::of(levels, form)?;
    let pixels = levels.means.shape().len();
    memory::check(bytes_needed(levels.means.shape(), form), || {
        format!("fitting response curves of {}", levels.means.shape())
    })?;
    let Shape { rows, cols } = levels.means.shape();
    let planes = form.order() + 1;
    let mut found = ResponseFit {
        coefficients: vec![0.0; planes * pixels],
        variances: vec![0.0; planes * pixels],
        misfit: Vec::with_capacity(pixels),
        used: Vec::with_capacity(pixels),
    };
    for start in (0..rows).step_by(ROWS) {
        let band = workers.map(ROWS.min(rows - start), |row| {
            control.check()?;
            Ok(abscissa.fit_row(levels, start + row))
        });
        for (row, polynomials) in band.into_iter().enumerate() {
            for (col, pixel) in polynomials?.iter().enumerate() {
                for power in 0..planes {
                    let place = power * pixels + (start + row) * cols + col;
                    found.coefficients[place] = pixel.coefficients[power];
                    found.variances[place] = pixel.variances[power];
                }
                found.misfit.push(pixel.misfit);
                found.used.push(pixel.used);
            }
        }
    }
    Ok(found)
}

/// Bytes of the planes, and of the polynomials of a few rows.
fn bytes_needed(shape: Shape, form: Form) -> u64 {
    let planes = (2 * (form.order() + 1) + 1) * size_of::<f64>() + size_of::<u32>();
    let band = shape.cols.saturating_mul(ROWS.min(shape.rows) * size_of::<Polynomial>());
    shape.len().saturating_mul(planes).saturating_add(band) as u64
}

/// The polynomial of one pixel.
struct Polynomial {
    coefficients: Terms,
    variances: Terms,
    misfit: f64,
    used: u32,
}

/// The regressor in [−1, 1], and how coefficients in it become coefficients in DN.
struct Abscissa {
    form: Form,
    /// x of each level.
    x: Vec<f64>,
    /// Row i: what the coefficient of x^i adds to the coefficient of each power of V̄.
    to_dn: [Terms; TERMS],
}

impl Abscissa {
    fn of<T: Real>(levels: &Levels<'_, T>, form: Form) -> Result<Self> {
        let references = levels.references;
        checked(levels, form)?;
        let low = references.iter().copied().fold(f64::INFINITY, f64::min);
        let high = references.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        // A gain alone has no constant term, so its x must be 0 where V̄ is.
        let centred = form.first() == 0 && form.order() > 0;
        let centre = if centred { 0.5 * (low + high) } else { 0.0 };
        let half = if centred { 0.5 * (high - low) } else { low.abs().max(high.abs()) };
        if form.order() > 0 && half <= 0.0 {
            return Err(Error::value(
                "levels",
                format!("all have the mean {low:.6}: take levels that differ"),
            ));
        }
        let half = if form.order() > 0 { half } else { 1.0 };
        let x = references.iter().map(|reference| (reference - centre) / half).collect();
        Ok(Self { form, x, to_dn: powers_of_dn(centre, half) })
    }

    fn fit_row<T: Real>(&self, levels: &Levels<'_, T>, row: usize) -> Vec<Polynomial> {
        let rows: Vec<&[T]> = (0..self.x.len()).map(|level| levels.means.row(level, row)).collect();
        let mut values = vec![0.0; rows.len()];
        (0..levels.means.shape().cols)
            .map(|col| {
                for (value, row) in values.iter_mut().zip(&rows) {
                    *value = row[col].to_f64();
                }
                self.fit_pixel(levels, &values)
            })
            .collect()
    }

    fn fit_pixel<T: Real>(&self, levels: &Levels<'_, T>, values: &[f64]) -> Polynomial {
        let mut q = [0.0; TERMS];
        let mut normal = Normal::default();
        for _ in 0..ROUNDS {
            normal = self.normal(levels, values, &q);
            match normal.solved(self.form) {
                Some(solved) => q = solved,
                None => return Polynomial::undetermined(normal.used),
            }
        }
        let covariance = normal.inverse(self.form);
        let mut pixel = Polynomial {
            coefficients: [0.0; TERMS],
            variances: [0.0; TERMS],
            misfit: normal.misfit(&q),
            used: normal.used,
        };
        // A power of x holds lower powers of V̄ alone.
        let terms = 0..=self.form.order();
        for power in terms.clone() {
            let row = self.to_dn.map(|powers| powers[power]);
            pixel.coefficients[power] = terms.clone().map(|i| row[i] * q[i]).sum();
            pixel.variances[power] = terms
                .clone()
                .map(|i| terms.clone().map(|j| row[i] * covariance[i][j] * row[j]).sum::<f64>())
                .sum();
        }
        pixel
    }

    /// The normal equations, with variances at the signal that coefficients `q` predict.
    fn normal<T: Real>(&self, levels: &Levels<'_, T>, values: &[f64], q: &Terms) -> Normal {
        let mut normal = Normal::default();
        for (level, (&value, &x)) in values.iter().zip(&self.x).enumerate() {
            if !value.is_finite() {
                continue;
            }
            let reference = levels.references[level];
            let signal = reference + horner(q, x);
            let variance = levels.noise.map_or(1.0, |noise| noise[level].variance(signal));
            normal.add(x, value - reference, 1.0 / variance, self.form.order());
        }
        normal
    }
}

impl Polynomial {
    const fn undetermined(used: u32) -> Self {
        Self {
            coefficients: [f64::NAN; TERMS],
            variances: [f64::NAN; TERMS],
            misfit: f64::NAN,
            used,
        }
    }
}

/// Sums of a weighted fit of powers of x.
#[derive(Default)]
struct Normal {
    /// Σ w x^i for i up to twice the highest power.
    moments: [f64; 2 * TERMS - 1],
    /// Σ w x^i y.
    right: Terms,
    /// Σ w y².
    square: f64,
    used: u32,
}

impl Normal {
    fn add(&mut self, x: f64, y: f64, weight: f64, order: usize) {
        let mut power = weight;
        for i in 0..=2 * order {
            self.moments[i] += power;
            if i <= order {
                self.right[i] += power * y;
            }
            power *= x;
        }
        self.square += weight * y * y;
        self.used += 1;
    }

    /// The minimum, if the levels determine it.
    fn solved(&self, form: Form) -> Option<Terms> {
        let factor = self.factor(form)?;
        Some(solve(&factor, &self.right, form))
    }

    /// The inverse of the matrix: the covariance, in units of the variance of weight 1.
    fn inverse(&self, form: Form) -> [Terms; TERMS] {
        let mut inverse = [[0.0; TERMS]; TERMS];
        if let Some(factor) = self.factor(form) {
            for i in form.first()..=form.order() {
                let mut unit = [0.0; TERMS];
                unit[i] = 1.0;
                inverse[i] = solve(&factor, &unit, form);
            }
        }
        inverse
    }

    /// Cholesky factor of the matrix Σ w x^(i+j), lower triangle.
    fn factor(&self, form: Form) -> Option<[Terms; TERMS]> {
        let mut factor = [[0.0; TERMS]; TERMS];
        if (self.used as usize) < form.terms() {
            return None;
        }
        for i in form.first()..=form.order() {
            for j in form.first()..=i {
                let before: f64 = (form.first()..j).map(|k| factor[i][k] * factor[j][k]).sum();
                let rest = self.moments[i + j] - before;
                factor[i][j] = if i > j {
                    rest / factor[j][j]
                } else if rest > PIVOT * self.moments[2 * i] {
                    rest.sqrt()
                } else {
                    return None;
                };
            }
        }
        Some(factor)
    }

    /// Σ w (y − Σ q_i x^i)².
    fn misfit(&self, q: &Terms) -> f64 {
        let explained: f64 = (0..TERMS).map(|i| q[i] * self.right[i]).sum();
        (self.square - explained).max(0.0)
    }
}

/// Forward and back substitution.
fn solve(factor: &[Terms; TERMS], right: &Terms, form: Form) -> Terms {
    let (first, last) = (form.first(), form.order());
    let mut y = [0.0; TERMS];
    for i in first..=last {
        let before: f64 = (first..i).map(|k| factor[i][k] * y[k]).sum();
        y[i] = (right[i] - before) / factor[i][i];
    }
    for i in (first..=last).rev() {
        let after: f64 = (i + 1..=last).map(|k| factor[k][i] * y[k]).sum();
        y[i] = (y[i] - after) / factor[i][i];
    }
    y
}

fn horner(coefficients: &Terms, x: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, coefficient| sum * x + coefficient)
}

/// ((V̄ − centre)/half)^i as powers of V̄: entry [i][power] is binomial(i, power) (−centre)^(i − power)
/// / half^i.
fn powers_of_dn(centre: f64, half: f64) -> [Terms; TERMS] {
    let mut table = [[0.0; TERMS]; TERMS];
    let mut row = [1.0, 0.0, 0.0, 0.0];
    for entry in &mut table {
        *entry = row;
        let mut next = [0.0; TERMS];
        for power in 0..TERMS {
            next[power] -= centre / half * row[power];
            if power > 0 {
                next[power] += row[power - 1] / half;
            }
        }
        row = next;
    }
    table
}

fn checked<T: Real>(levels: &Levels<'_, T>, form: Form) -> Result<()> {
    let count = levels.means.count();
    if levels.references.len() != count || levels.noise.is_some_and(|noise| noise.len() != count) {
        return Err(Error::Shape {
            argument: "references",
            got: format!("({},)", levels.references.len()),
            wanted: format!("({count},), as many as levels, and as many noises"),
        });
    }
    if count < form.terms() {
        return Err(Error::value(
            "levels",
            format!("are {count}: a fit of {} coefficients needs as many levels", form.terms()),
        ));
    }
    if let Some(bad) = levels.references.iter().find(|reference| !reference.is_finite()) {
        return Err(Error::value("levels", format!("hold one of mean {bad}: no pixel is usable")));
    }
    let noise = levels.noise.unwrap_or_default();
    let wrong = |noise: &&LevelNoise| {
        !(noise.constant > 0.0 && noise.slope >= 0.0 && noise.dark.is_finite())
    };
    match noise.iter().find(wrong) {
        Some(bad) => Err(Error::value(
            "noise",
            format!("has the variance {} + {} · signal: expected above 0", bad.constant, bad.slope),
        )),
        None => Ok(()),
    }
}
