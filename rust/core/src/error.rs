//! What can go wrong, in one enum; the variants carry the numbers.

use std::path::PathBuf;

/// The result of everything in this crate that can fail.
pub type Result<T> = std::result::Result<T, Error>;

/// What went wrong, grouped as validation, input and output, and control.
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

impl Error {
    /// An [`Error::Value`].
    pub(crate) fn value(argument: &'static str, problem: impl Into<String>) -> Self {
        Self::Value { argument, problem: problem.into() }
    }
}
