//! Long work on a thread of its own, while the calling thread hears signals and shows progress.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use equipix_core::control::Control;
use equipix_core::{Error, Result};
use pyo3::prelude::*;

use crate::errors;

/// How often signals are checked and progress is shown.
const POLL: Duration = Duration::from_millis(50);

/// Runs `work` without the GIL; Ctrl-C or an exception in `progress` cancels it and is raised.
///
/// Python runs its signal handlers on its main thread only, and only between byte codes: so the
/// work moves to another thread and this one keeps asking.
pub(crate) fn interruptible<R: Send>(
    py: Python<'_>,
    progress: Option<&Bound<'_, PyAny>>,
    work: impl FnOnce(&Control) -> Result<R> + Send,
) -> PyResult<R> {
    let control = Control::new();
    let (sender, receiver) = channel();
    let receiver = std::sync::Mutex::new(receiver);
    std::thread::scope(|scope| {
        let started = std::thread::Builder::new().spawn_scoped(scope, || {
            let outcome = catch_unwind(AssertUnwindSafe(|| work(&control)));
            // The receiver waits until this arrives, so there is always somebody to send it to.
            let _ = sender.send(outcome);
        });
        started.map_err(|error| {
            let reason = error.to_string();
            errors::exception(py, &Error::Workers { workers: 1, reason })
        })?;
        let mut raised = None;
        loop {
            let wait = || receiver.lock().ok().map(|receiver| receiver.recv_timeout(POLL));
            match py.detach(wait) {
                Some(Ok(outcome)) => {
                    return match (raised, outcome) {
                        (Some(error), _) => Err(error),
                        (None, Ok(Ok(result))) => show(&control, progress).map(|()| result),
                        (None, Ok(Err(error))) => Err(errors::exception(py, &error)),
                        (None, Err(panic)) => Err(errors::internal(py, panic_message(&*panic))),
                    };
                }
                Some(Err(RecvTimeoutError::Timeout)) if raised.is_none() => {
                    if let Err(error) = py.check_signals().and_then(|()| show(&control, progress)) {
                        control.cancel();
                        raised = Some(error);
                    }
                }
                Some(Err(RecvTimeoutError::Timeout)) => {}
                Some(Err(RecvTimeoutError::Disconnected)) | None => {
                    return Err(errors::internal(py, "the worker thread vanished"));
                }
            }
        }
    })
}

/// Runs `work` of a few milliseconds without the GIL, on this thread: to start another one takes as
/// long as to correct a small frame.
pub(crate) fn brief<R: Send>(
    py: Python<'_>,
    work: impl FnOnce(&Control) -> Result<R> + Send,
) -> PyResult<R> {
    let control = Control::new();
    match py.detach(|| catch_unwind(AssertUnwindSafe(|| work(&control)))) {
        Ok(outcome) => outcome.map_err(|error| errors::exception(py, &error)),
        Err(panic) => Err(errors::internal(py, panic_message(&*panic))),
    }
}

/// Calls `progress(done, total, stage)` with what the work reported last.
fn show(control: &Control, progress: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
    if let (Some(callback), Some(state)) = (progress, control.progress()) {
        callback.call1((state.done, state.total, state.stage))?;
    }
    Ok(())
}

fn panic_message(panic: &(dyn std::any::Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("a panic")
}
