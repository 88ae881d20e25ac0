//! Where each exposure lies in the beam: shifts, rotations and the padded beam grid.
//!
//! In exposure `k` the sensor of R rows and C columns sees the window of the beam L whose smallest
//! corner is `d_k`, turned by `numpy.rot90(window, rotation/90)`:
//!
//! ```text
//! y_k(p) = c_k · L(u_k(p)) · M(p),   u_k(p) = A_k p + t_k + d_k
//! ```
//!
//! A [`View`] is the whole beam grid turned in the same way. In it an exposure is a plain window:
//! pixel `p` sees the view's cell `p` + ([`Placement::row`], [`Placement::col`]), so the kernels
//! walk along rows whatever the rotation.

use crate::error::{Error, Result};
use crate::frames::Shape;

/// How far the sensor is turned against the beam, counter-clockwise as by `numpy.rot90`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Rotation {
    /// Not turned.
    #[default]
    None,
    /// By 90°.
    Quarter,
    /// By 180°.
    Half,
    /// By 270°.
    ThreeQuarters,
}

impl Rotation {
    /// The rotation of so many degrees, if that is 0, 90, 180 or 270.
    #[must_use]
    pub const fn from_degrees(degrees: i64) -> Option<Self> {
        match degrees {
            0 => Some(Self::None),
            90 => Some(Self::Quarter),
            180 => Some(Self::Half),
            270 => Some(Self::ThreeQuarters),
            _ => None,
        }
    }

    /// The sizes of a grid of `shape` after this rotation.
    #[must_use]
    pub const fn turned(self, shape: Shape) -> Shape {
        match self {
            Self::None | Self::Half => shape,
            Self::Quarter | Self::ThreeQuarters => shape.transposed(),
        }
    }

    /// Whether rows become columns.
    pub(crate) const fn swaps_axes(self) -> bool {
        matches!(self, Self::Quarter | Self::ThreeQuarters)
    }

    /// Where a point of a grid of `shape` comes to lie after this rotation.
    pub(crate) fn turned_point(self, [row, col]: [f64; 2], shape: Shape) -> [f64; 2] {
        let (from_bottom, from_right) =
            (shape.rows as f64 - 1.0 - row, shape.cols as f64 - 1.0 - col);
        match self {
            Self::None => [row, col],
            Self::Quarter => [from_right, row],
            Self::Half => [from_bottom, from_right],
            Self::ThreeQuarters => [col, from_bottom],
        }
    }

    /// Lines that cut a grid between its rows and between its columns, from 0 to its size, after
    /// this rotation.
    pub(crate) fn turned_edges(self, rows: &[usize], cols: &[usize]) -> [Vec<usize>; 2] {
        let back = |edges: &[usize]| {
            let end = edges.last().copied().unwrap_or(0);
            edges.iter().rev().map(|edge| end - edge).collect()
        };
        match self {
            Self::None => [rows.to_vec(), cols.to_vec()],
            Self::Quarter => [back(cols), rows.to_vec()],
            Self::Half => [back(rows), back(cols)],
            Self::ThreeQuarters => [cols.to_vec(), back(rows)],
        }
    }

    /// The rotation that undoes this one.
    pub(crate) const fn inverse(self) -> Self {
        match self {
            Self::Quarter => Self::ThreeQuarters,
            Self::ThreeQuarters => Self::Quarter,
            other => other,
        }
    }
}

/// Walks a grid of one orientation in the order of another: the position is affine in both indices.
#[derive(Clone, Copy, Debug)]
pub struct Walk {
    base: isize,
    row_step: isize,
    col_step: isize,
}

impl Walk {
    /// Positions in a grid of `shape`, in the order of `numpy.rot90(grid, rotation/90)`.
    pub(crate) fn new(rotation: Rotation, shape: Shape) -> Self {
        let (rows, cols) = (shape.rows.cast_signed(), shape.cols.cast_signed());
        let (base, row_step, col_step) = match rotation {
            Rotation::None => (0, cols, 1),
            Rotation::Quarter => (cols - 1, -1, cols),
            Rotation::Half => (rows * cols - 1, -cols, -1),
            Rotation::ThreeQuarters => ((rows - 1) * cols, 1, -cols),
        };
        Self { base, row_step, col_step }
    }

    /// The position of the element that stands at (`row`, `col`) of the turned grid.
    #[must_use]
    pub const fn at(&self, row: usize, col: usize) -> usize {
        let offset = self.row_step * row.cast_signed() + self.col_step * col.cast_signed();
        (self.base + offset).cast_unsigned()
    }
}

/// The beam grid in one orientation.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// The orientation.
    pub rotation: Rotation,
    /// Sizes of the turned grid.
    pub shape: Shape,
    /// Positions in the beam grid, in the order of this view.
    pub cells: Walk,
    /// Positions in this view, in the order of the beam grid.
    pub places: Walk,
}

impl View {
    fn new(rotation: Rotation, beam: Shape) -> Self {
        let shape = rotation.turned(beam);
        let cells = Walk::new(rotation, beam);
        Self { rotation, shape, cells, places: Walk::new(rotation.inverse(), shape) }
    }
}

/// Where one exposure lies: pixel `p` sees cell `p` + (`row`, `col`) of view number `view`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Placement {
    /// Index into [`Geometry::views`].
    pub view: usize,
    /// Row of the view that the sensor's first row sees.
    pub row: usize,
    /// Column of the view that the sensor's first column sees.
    pub col: usize,
}

/// The sensor, the padded beam grid and the exposures' places in it.
#[derive(Clone, Debug)]
pub struct Geometry {
    /// Sizes of the sensor.
    pub sensor: Shape,
    /// Sizes of the beam grid: it covers every position seen, and always shift 0.
    pub beam: Shape,
    /// The beam grid's cell that the sensor's first pixel sees at shift 0, unrotated.
    pub origin: [usize; 2],
    /// The orientations in use, in the order of their first exposure.
    pub views: Vec<View>,
    /// One place an exposure.
    pub exposures: Vec<Placement>,
}

impl Geometry {
    /// Places exposures at whole-pixel `shifts` (row, column), turned by `rotations`.
    ///
    /// # Errors
    /// [`Error::Shape`] if the two differ in number; [`Error::Value`] for fewer than two
    /// exposures, for a shift as large as the sensor or larger, and for a sensor whose pixels and
    /// beam cells cannot be numbered in 32 bits.
    pub fn new(sensor: Shape, shifts: &[[i64; 2]], rotations: &[Rotation]) -> Result<Self> {
        if shifts.len() < 2 {
            let problem = format!("holds {} exposure(s), at least two are needed", shifts.len());
            return Err(Error::value("shifts", problem));
        }
        if rotations.len() != shifts.len() {
            return Err(Error::Shape {
                argument: "rotation",
                got: format!("({},)", rotations.len()),
                wanted: format!("({},), one an exposure", shifts.len()),
            });
        }
        let sides = [sensor.rows, sensor.cols];
        let mut low = [0_i64; 2];
        let mut high = sides.map(usize::cast_signed).map(|side| side as i64);
        for (index, (&shift, rotation)) in shifts.iter().zip(rotations).enumerate() {
            let window = rotation.turned(sensor);
            for (axis, side) in [window.rows, window.cols].into_iter().enumerate() {
                check_shift(index, shift, axis, side)?;
                low[axis] = low[axis].min(shift[axis]);
                high[axis] = high[axis].max(shift[axis] + side as i64);
            }
        }
        let beam = Shape::new((high[0] - low[0]) as usize, (high[1] - low[1]) as usize);
        check_size(sensor, beam)?;
        let mut views: Vec<View> = Vec::new();
        let mut exposures = Vec::with_capacity(shifts.len());
        for (&[row, col], &rotation) in shifts.iter().zip(rotations) {
            let known = views.iter().position(|view| view.rotation == rotation);
            let view = known.unwrap_or_else(|| {
                views.push(View::new(rotation, beam));
                views.len() - 1
            });
            let corner = [(row - low[0]) as usize, (col - low[1]) as usize];
            let [row, col] = turned_corner(rotation, beam, rotation.turned(sensor), corner);
            exposures.push(Placement { view, row, col });
        }
        let origin = low.map(|low| low.unsigned_abs() as usize);
        Ok(Self { sensor, beam, origin, views, exposures })
    }
}

/// Where the smallest corner of a `window` of the beam grid comes to lie when the grid is turned.
fn turned_corner(rotation: Rotation, beam: Shape, window: Shape, corner: [usize; 2]) -> [usize; 2] {
    let [row, col] = corner;
    let from_bottom = beam.rows - row - window.rows;
    let from_right = beam.cols - col - window.cols;
    match rotation {
        Rotation::None => [row, col],
        Rotation::Quarter => [from_right, row],
        Rotation::Half => [from_bottom, from_right],
        Rotation::ThreeQuarters => [col, from_bottom],
    }
}

/// Pixels and cells together are numbered in 32 bits.
fn check_size(sensor: Shape, beam: Shape) -> Result<()> {
    let count = |shape: Shape| shape.rows as u128 * shape.cols as u128;
    if count(sensor) + count(beam) <= u128::from(u32::MAX) {
        return Ok(());
    }
    let problem = format!(
        "have {sensor} pixels and a beam grid of {beam} cells: more than {} together cannot be \
         calibrated at once",
        u32::MAX
    );
    Err(Error::value("frames", problem))
}

/// A shift as large as the window leaves nothing in common with the beam at shift 0.
fn check_shift(index: usize, shift: [i64; 2], axis: usize, side: usize) -> Result<()> {
    if shift[axis].unsigned_abs() < side as u64 {
        return Ok(());
    }
    let name = ["row", "column"][axis];
    Err(Error::value(
        "shifts",
        format!(
            "of exposure {index} is ({}, {}): its {name} part must be smaller than the sensor, \
             which has {side} there",
            shift[0], shift[1]
        ),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROTATIONS: [Rotation; 4] =
        [Rotation::None, Rotation::Quarter, Rotation::Half, Rotation::ThreeQuarters];

    /// u_k(p) = A p + t + d, straight from the table of the model.
    fn cell(rotation: Rotation, sensor: Shape, p: [i64; 2], d: [i64; 2]) -> [i64; 2] {
        let (rows, cols) = (sensor.rows as i64, sensor.cols as i64);
        let [r, c] = match rotation {
            Rotation::None => p,
            Rotation::Quarter => [p[1], rows - 1 - p[0]],
            Rotation::Half => [rows - 1 - p[0], cols - 1 - p[1]],
            Rotation::ThreeQuarters => [cols - 1 - p[1], p[0]],
        };
        [r + d[0], c + d[1]]
    }

    #[test]
    fn every_pixel_sees_the_cell_that_the_model_names() {
        let sensor = Shape::new(5, 7);
        let shifts = [[0, 0], [-2, 3], [4, -4], [1, 2]];
        for turn in 0..4 {
            let rotations: Vec<_> = (0..4).map(|k| ROTATIONS[(k + turn) % 4]).collect();
            let geometry = Geometry::new(sensor, &shifts, &rotations).unwrap();
            for (k, place) in geometry.exposures.iter().enumerate() {
                let view = geometry.views[place.view];
                for (row, col) in (0..5).flat_map(|r| (0..7).map(move |c| (r, c))) {
                    let u = cell(rotations[k], sensor, [row as i64, col as i64], shifts[k]);
                    let wanted = (u[0] + geometry.origin[0] as i64) * geometry.beam.cols as i64
                        + u[1]
                        + geometry.origin[1] as i64;
                    let got = view.cells.at(row + place.row, col + place.col);
                    assert_eq!(got as i64, wanted);
                }
            }
        }
    }

    #[test]
    fn a_grid_beyond_32_bits_is_refused() {
        let shifts = [[0, 0], [1, 0]];
        let refused = Geometry::new(Shape::new(50_000, 50_000), &shifts, &[Rotation::None; 2]);
        assert!(refused.unwrap_err().to_string().contains("more than 4294967295 together"));
    }

    #[test]
    fn places_undo_cells() {
        let beam = Shape::new(3, 4);
        for rotation in ROTATIONS {
            let view = View::new(rotation, beam);
            for (row, col) in (0..3).flat_map(|r| (0..4).map(move |c| (r, c))) {
                let place = view.places.at(row, col);
                let (i, j) = (place / view.shape.cols, place % view.shape.cols);
                assert_eq!(view.cells.at(i, j), row * beam.cols + col);
            }
        }
    }

    #[test]
    fn the_grid_always_holds_shift_zero() {
        let geometry =
            Geometry::new(Shape::new(4, 6), &[[2, 1], [3, 3]], &[Rotation::None; 2]).unwrap();
        assert_eq!((geometry.beam, geometry.origin), (Shape::new(7, 9), [0, 0]));
    }
}
