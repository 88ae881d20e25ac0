//! `apply_words`, `adapt_words`: corrections in fixed point.
//!
//! | argument | dtype and rank | here | how |
//! |---|---|---|---|
//! | frames | uint16, 3 | `&[u16]` | view |
//! | out | uint16, 3 | `&mut [u16]` | view |
//! | gain, offset | uint16 and int16, 2 | `&[u16]`, `&[i16]` | view; `adapt_words` writes to both |

use std::num::NonZeroUsize;

use equipix_core::fixed_point::{Arithmetic, Format, Loop, Memories, Table, adapt};
use equipix_core::{Shape, Workers};
use numpy::{
    PyReadonlyArray2, PyReadonlyArray3, PyReadwriteArray2, PyReadwriteArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::run;

/// Widths of ADC and output, exponents of ADC, offset, gain and output, base.
type PyFormat = (u32, u32, i32, i32, i32, i32, i32);

/// Corrects frames of words into `out`; gives the numbers of outputs below 0 and above the largest.
#[pyfunction]
#[pyo3(signature = (frames, gain, offset, out, arithmetic, *, workers))]
pub(crate) fn apply_words(
    py: Python<'_>,
    frames: PyReadonlyArray3<'_, u16>,
    gain: PyReadonlyArray2<'_, u16>,
    offset: PyReadonlyArray2<'_, i16>,
    mut out: PyReadwriteArray3<'_, u16>,
    arithmetic: PyFormat,
    workers: Option<NonZeroUsize>,
) -> PyResult<(u64, u64)> {
    let shape = Shape::new(gain.shape()[0], gain.shape()[1]);
    let (gain, offset) = (gain.as_slice()?, offset.as_slice()?);
    let (frames, out) = (frames.as_slice()?, out.as_slice_mut()?);
    let limited = run::interruptible(py, None, |control| {
        let table = Table::new(shape, gain, offset, Arithmetic::new(&format_of(arithmetic))?)?;
        table.apply(frames, out, &Workers::new(workers)?, control)
    })?;
    Ok((limited.below, limited.above))
}

/// Corrects frames of words into `out`, and changes `gain` and `offset` after each.
#[pyfunction]
#[pyo3(signature = (frames, gain, offset, out, widths, step, *, workers))]
#[expect(clippy::too_many_arguments, reason = "arrays and widths of one call from Python")]
pub(crate) fn adapt_words(
    py: Python<'_>,
    frames: PyReadonlyArray3<'_, u16>,
    mut gain: PyReadwriteArray2<'_, u16>,
    mut offset: PyReadwriteArray2<'_, i16>,
    mut out: PyReadwriteArray3<'_, u16>,
    widths: [u32; 3],
    step: u32,
    workers: Option<NonZeroUsize>,
) -> PyResult<()> {
    let shape = Shape::new(gain.shape()[0], gain.shape()[1]);
    let mut memories = Memories { gain: gain.as_slice_mut()?, offset: offset.as_slice_mut()? };
    let (frames, out) = (frames.as_slice()?, out.as_slice_mut()?);
    run::interruptible(py, None, |control| {
        let (run, workers) = (Loop::new(shape, widths, step)?, Workers::new(workers)?);
        for (frame, out) in frames.chunks(shape.len()).zip(out.chunks_mut(shape.len())) {
            adapt(&run, &mut memories, frame, out, &workers, control)?;
        }
        Ok(())
    })
}

const fn format_of((adc_bits, out_bits, adc, offset, gain, out, base): PyFormat) -> Format {
    Format { adc_bits, out_bits, adc, offset, gain, out, base }
}
