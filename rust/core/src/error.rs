//! What can go wrong, in one enum; the variants carry the numbers.

use std::path::PathBuf;

/// The result of everything in this crate that can fail.
pub type Result<T> = std::result::Result<T, Error>;

/// What went wrong, grouped as validation, input and output, resources, and
/// control.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    // Validation: an argument is not what it should be.
    /// An argument's sizes do not fit the others.
    #[error("'{argument}' has shape {got}, expected {wanted}")]
    Shape {
        /// The argument's name.
        argument: &'static str,
        /// What was given.
        got: String,
        /// What was wanted.
        wanted: String,
    },
    /// An argument's value is out of its range.
    #[error("'{argument}' {problem}")]
    Value {
        /// The argument's name.
        argument: &'static str,
        /// What is wrong with it, what was wanted, what to do.
        problem: String,
    },

    // Validation: spot.
    /// An image has no spot that can be measured.
    #[error("'{argument}' has {problem}")]
    Spot {
        /// The argument's name.
        argument: &'static str,
        /// What is wrong with the spot.
        problem: SpotProblem,
    },

    // Input and output.
    /// A file cannot be read, or holds something else than was wanted.
    #[error("{}: {problem}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it and what was wanted.
        problem: String,
        /// The decoder's or the system's own error.
        #[source]
        source: Option<Box<dyn std::error::Error + Send + Sync>>,
    },
    /// A file is of a kind that this crate does not decode, though another reader may.
    #[error("{}: not decoded here: {feature}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What the file has that the decoder lacks.
        feature: String,
    },

    // Resources.
    /// The work needs more memory than this process may still have.
    #[error(
        "{what} needs {} ({needed} bytes) beside its input, {} are available: {remedy}",
        size(*needed), size(*available)
    )]
    Memory {
        /// The work, as the beginning of a sentence.
        what: String,
        /// Bytes that it needs.
        needed: u64,
        /// Bytes to be had.
        available: u64,
        /// How more could be had.
        remedy: &'static str,
    },

    // Control.
    /// The work was cancelled through its [`Control`](crate::control::Control).
    #[error("cancelled")]
    Cancelled,
    /// The threads to work with cannot be started.
    #[error("cannot start {workers} worker threads: {reason}")]
    Workers {
        /// How many were asked for.
        workers: usize,
        /// The system's reason.
        reason: String,
    },
}

/// Why a spot cannot be measured; places are (row, column) in pixels.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SpotProblem {
    /// Nothing stands out of the background.
    #[error(
        "no spot: its brightest area stands {level:.3} above the background, where more than \
         {wanted:.3} (8 standard deviations of the smoothed background) is wanted; is the hole in \
         the beam?"
    )]
    Missing {
        /// Level of the brightest area above the background.
        level: f64,
        /// Level that a spot must exceed.
        wanted: f64,
    },
    /// The spot, with its blurred outline and some background, does not lie wholly on the sensor.
    #[error(
        "a spot cut by the edge: with its blur and 3 pixels of background the spot at \
         ({:.1}, {:.1}) needs rows {} to {} and columns {} to {} of a ({}, {}) sensor; \
         move it inwards", centre[0], centre[1], rows[0], rows[1], cols[0], cols[1], shape[0],
         shape[1]
    )]
    Cut {
        /// Centre of the part that is seen.
        centre: [f64; 2],
        /// First and last row needed.
        rows: [i64; 2],
        /// First and last column needed.
        cols: [i64; 2],
        /// Sizes of the sensor.
        shape: [usize; 2],
    },
    /// Two spots of comparable size.
    #[error(
        "a doubled spot: {} pixels around ({:.1}, {:.1}) and {} pixels around ({:.1}, {:.1}); \
         leave one hole open and shield reflections",
        areas[0], first[0], first[1], areas[1], second[0], second[1]
    )]
    Doubled {
        /// Centre of the largest spot.
        first: [f64; 2],
        /// Centre of the second largest.
        second: [f64; 2],
        /// Their areas in pixels.
        areas: [usize; 2],
    },
    /// Pixels of the spot reached the saturation level.
    #[error(
        "a saturated spot: {pixels} of its pixels reach {level}, the first at ({}, {}); expose it \
         less", first[0], first[1]
    )]
    Saturated {
        /// Number of pixels.
        pixels: usize,
        /// The first of them.
        first: [i64; 2],
        /// The saturation level.
        level: f64,
    },
}

/// Bytes in the unit that people expect.
fn size(bytes: u64) -> String {
    let bytes = bytes as f64;
    if bytes < 1e9 { format!("{:.1} MB", bytes / 1e6) } else { format!("{:.2} GB", bytes / 1e9) }
}

impl Error {
    /// An [`Error::Value`].
    pub(crate) fn value(argument: &'static str, problem: impl Into<String>) -> Self {
        Self::Value { argument, problem: problem.into() }
    }
}
