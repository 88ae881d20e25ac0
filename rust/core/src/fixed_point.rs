//! Corrections in fixed point, as a camera's electronics applies them, bit by bit.
//!
//! Behind the ADC a pixel has two words, a gain g and an offset o. Of the word x of the ADC they make
//!
//! ```text
//! z = base + round( (g x · 2^(gain + adc) + o · 2^offset) / 2^out )
//! ```
//!
//! where each exponent is the power of two that one step of the word stands for, in DN, and the gain
//! has no unit. Sums are exact whole numbers, the one rounding is half to even, and the result is
//! limited to the words of the output. [`adapt`] changes both words from frame to frame.

mod adaptive;
mod arithmetic;
mod table;

pub use adaptive::{Loop, Memories, adapt};
pub use arithmetic::{Arithmetic, Format};
pub use table::{Limited, Table};
