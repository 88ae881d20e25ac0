//! The places of the exposures on the padded beam grid, at whole-pixel shifts.

use super::rotation::Rotation;
use crate::error::{Error, Result};
use crate::frames::Shape;

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
        let origin = rotation.to_beam([0, 0], rotation.turned(shape));
        let position = |[row, col]: [i64; 2]| (row * shape.cols as i64 + col) as isize;
        let [row_step, col_step] = [[1, 0], [0, 1]].map(|step| position(rotation.direction(step)));
        let base = position(origin);
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
    pub placements: Vec<Placement>,
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
            let found = if shifts.is_empty() { "no exposure" } else { "one exposure" };
            return Err(Error::value("shifts", format!("holds {found}, at least two are needed")));
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
        let mut placements = Vec::with_capacity(shifts.len());
        for (&[row, col], &rotation) in shifts.iter().zip(rotations) {
            let known = views.iter().position(|view| view.rotation == rotation);
            let view = known.unwrap_or_else(|| {
                views.push(View::new(rotation, beam));
                views.len() - 1
            });
            let corner = [(row - low[0]) as usize, (col - low[1]) as usize];
            let [row, col] = turned_corner(rotation, beam, rotation.turned(sensor), corner);
            placements.push(Placement { view, row, col });
        }
        let origin = low.map(|low| low.unsigned_abs() as usize);
        Ok(Self { sensor, beam, origin, views, placements })
    }
}

/// Where the smallest corner of a `window` of the beam grid comes to lie when the grid is turned.
fn turned_corner(rotation: Rotation, beam: Shape, window: Shape, corner: [usize; 2]) -> [usize; 2] {
    let first = corner.map(|place| place as i64);
    let last = [first[0] + window.rows as i64 - 1, first[1] + window.cols as i64 - 1];
    let [first, last] = [first, last].map(|cell| rotation.to_view(cell, beam));
    [0, 1].map(|axis| first[axis].min(last[axis]) as usize)
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
            for (k, place) in geometry.placements.iter().enumerate() {
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
