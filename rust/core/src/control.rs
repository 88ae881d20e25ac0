//! Cancellation and progress of long work, seen from another thread.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use crate::error::{Error, Result};

/// How far a piece of work has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Units done.
    pub done: u64,
    /// Units in all, as far as known: a forecast that may change.
    pub total: u64,
    /// What the work is doing.
    pub stage: &'static str,
}

/// A handle that a long computation reports to and asks whether to go on.
///
/// The computation calls [`report`](Self::report) and [`check`](Self::check); whoever started it
/// polls [`progress`](Self::progress) and may call [`cancel`](Self::cancel) at any time.
#[derive(Debug, Default)]
pub struct Control {
    cancelled: AtomicBool,
    progress: Mutex<Option<Progress>>,
}

impl Control {
    /// A handle on which nothing has been reported.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Asks the computation to stop at its next check.
    pub fn cancel(&self) {
        self.cancelled.store(true, Ordering::Relaxed);
    }

    /// Whether the computation was asked to stop.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed)
    }

    /// [`Error::Cancelled`] if the computation was asked to stop.
    ///
    /// # Errors
    /// [`Error::Cancelled`], once [`cancel`](Self::cancel) was called.
    pub fn check(&self) -> Result<()> {
        if self.is_cancelled() { Err(Error::Cancelled) } else { Ok(()) }
    }

    /// Says how far the work has come.
    pub fn report(&self, stage: &'static str, done: u64, total: u64) {
        *self.progress.lock().unwrap_or_else(PoisonError::into_inner) =
            Some(Progress { done, total, stage });
    }

    /// What was reported last.
    #[must_use]
    pub fn progress(&self) -> Option<Progress> {
        *self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
