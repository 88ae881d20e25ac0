//! How bright the beam was in each exposure.

use super::tally::VALUES;
use crate::error::{Error, Result};

/// The flux c of each exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct Flux {
    /// Relative fluxes: as they are, or the first guess.
    pub values: Vec<f64>,
    /// What is known of them.
    pub kind: FluxKind,
}

/// What is known of the fluxes.
#[derive(Clone, Debug, PartialEq)]
pub enum FluxKind {
    /// They are as given.
    Known,
    /// Nothing, but that the mean of ln c is 0.
    Free,
    /// ln c is linear in time: the times of the exposures.
    Linear(Vec<f64>),
    /// They are as given up to relative errors of these standard deviations.
    Prior(Vec<f64>),
}

impl Flux {
    /// So many exposures of a steady lamp.
    #[must_use]
    pub fn steady(count: usize) -> Self {
        Self { values: vec![1.0; count], kind: FluxKind::Known }
    }

    /// Whether all exposures were made at one level, as far as it was given.
    pub(crate) fn is_one_level(&self) -> bool {
        let given = matches!(self.kind, FluxKind::Known | FluxKind::Prior(_));
        given && self.values.iter().all(|c| *c == self.values[0])
    }

    /// Checks the values and what is known of them, for so many exposures.
    pub(crate) fn check(&self, count: usize) -> Result<()> {
        check_length("flux", &self.values, count)?;
        if let Some(k) = self.values.iter().position(|c| !VALUES.contains(c)) {
            let c = self.values[k];
            let problem =
                format!("of exposure {k} is {c}: expected a positive number from 1e-50 to 1e50");
            return Err(Error::value("flux", problem));
        }
        match &self.kind {
            FluxKind::Known | FluxKind::Free => Ok(()),
            FluxKind::Linear(times) => check_times(times, count),
            FluxKind::Prior(std) => check_std(std, count),
        }
    }
}

fn check_length(argument: &'static str, values: &[f64], count: usize) -> Result<()> {
    if values.len() == count {
        return Ok(());
    }
    let wanted = format!("({count},), one an exposure");
    Err(Error::Shape { argument, got: format!("({},)", values.len()), wanted })
}

fn check_times(times: &[f64], count: usize) -> Result<()> {
    check_length("time", times, count)?;
    let finite = times.iter().all(|time| time.is_finite());
    if finite && times.iter().any(|time| *time != times[0]) {
        return Ok(());
    }
    Err(Error::value("time", format!("is {times:?}: expected seconds, not all the same")))
}

fn check_std(std: &[f64], count: usize) -> Result<()> {
    check_length("flux_std", std, count)?;
    if std.iter().all(|std| *std > 0.0 && std.is_finite()) {
        return Ok(());
    }
    Err(Error::value("flux_std", format!("is {std:?}: expected positive numbers")))
}
