//! `locate_spots`: the spot before and after a move.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | before, after | uint8, uint16, float32 or float64, 3 | `Stack<u8>` … `Stack<f64>` | view |

use std::panic::resume_unwind;

use equipix_core::centroid::{Spot, locate};
use equipix_core::control::Control;
use equipix_core::error::Result;
use equipix_core::frames::{Sample, Shape, Stack};
use numpy::{Element, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::run;

/// Frames as cameras and files deliver them.
#[derive(FromPyObject)]
pub(crate) enum Samples<'py> {
    U8(PyReadonlyArray3<'py, u8>),
    U16(PyReadonlyArray3<'py, u16>),
    F32(PyReadonlyArray3<'py, f32>),
    F64(PyReadonlyArray3<'py, f64>),
}

/// Position and standard error, each (row, column).
type PySpot = ([f64; 2], [f64; 2]);

/// Finds the spot in one of the arguments.
type Search<'a> = Box<dyn Fn(&Control) -> Result<Spot> + Send + Sync + 'a>;

/// Finds the spot in `before` and in `after`, at the same time; each has a saturation level of its own, or none.
#[pyfunction]
#[pyo3(signature = (before, after, saturations))]
pub(crate) fn locate_spots(
    py: Python<'_>,
    before: Samples<'_>,
    after: Samples<'_>,
    saturations: (Option<f64>, Option<f64>),
) -> PyResult<(PySpot, PySpot)> {
    let searches =
        [search("before", &before, saturations.0)?, search("after", &after, saturations.1)?];
    // Not in the pool of workers, whose threads would be deaf to others for as long as a search takes.
    let work = |control: &Control| -> Result<[Spot; 2]> {
        let [before, after] = &searches;
        std::thread::scope(|scope| {
            let other = scope.spawn(|| after(control));
            let first = before(control);
            let second = other.join().unwrap_or_else(|panic| resume_unwind(panic));
            Ok([first?, second?])
        })
    };
    let [before, after] = run::interruptible(py, None, work)?;
    Ok(((before.position, before.std), (after.position, after.std)))
}

fn search<'a>(
    argument: &'static str,
    frames: &'a Samples<'_>,
    saturation: Option<f64>,
) -> PyResult<Search<'a>> {
    match frames {
        Samples::U8(frames) => typed(argument, frames, saturation),
        Samples::U16(frames) => typed(argument, frames, saturation),
        Samples::F32(frames) => typed(argument, frames, saturation),
        Samples::F64(frames) => typed(argument, frames, saturation),
    }
}

fn typed<'a, T: Sample + Element>(
    argument: &'static str,
    frames: &'a PyReadonlyArray3<'_, T>,
    saturation: Option<f64>,
) -> PyResult<Search<'a>> {
    let [count, rows, cols] = [0, 1, 2].map(|axis| frames.shape()[axis]);
    let data = frames.as_slice()?;
    Ok(Box::new(move |control| {
        let stack = Stack::new(argument, data, count, Shape::new(rows, cols))?;
        locate(argument, stack, saturation, control)
    }))
}
