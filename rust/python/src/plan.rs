//! `plan`: what an experiment can compare, before it is made.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | shifts | int64, 2 | `Vec<[i64; 2]>` | copy of a few numbers |
//! | rotation | int64, 1 | `Vec` | copy of a few numbers |
//! | mask | bool, 2 or 3 | `Mask` | view |

use equipix_core::Shape;
use equipix_core::connectivity::{Components, NONE};
use equipix_core::geometry::Geometry;
use numpy::{PyArray2, PyReadonlyArray2};
use pyo3::prelude::*;

use crate::arrays::{PyMask, image, rotations, view_mask};
use crate::run;

/// The component of each pixel, the sizes of the components, and how many beam cells are seen.
#[pyfunction]
#[pyo3(signature = (shape, shifts, *, rotation, mask))]
pub(crate) fn planned_components(
    py: Python<'_>,
    shape: (usize, usize),
    shifts: PyReadonlyArray2<'_, i64>,
    rotation: Vec<i64>,
    mask: Option<PyMask<'_>>,
) -> PyResult<(Py<PyArray2<i32>>, Vec<usize>, usize)> {
    let shifts: Vec<_> = shifts.as_slice()?.chunks_exact(2).map(|d| [d[0], d[1]]).collect();
    let mask = view_mask(mask.as_ref())?;
    let sensor = Shape::new(shape.0, shape.1);
    let (components, seen) = run::interruptible(py, None, |control| {
        let geometry = Geometry::new(sensor, &shifts, &rotations(&rotation)?)?;
        let components = Components::planned(&geometry, mask, control)?;
        let seen = components.cells.iter().filter(|&&label| label != NONE).count();
        Ok((components, seen))
    })?;
    Ok((image(py, components.pixels, sensor)?, components.sizes, seen))
}
