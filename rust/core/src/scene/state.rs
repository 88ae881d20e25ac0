//! What a method remembers between frames, as named maps and counts: saved and resumed exactly.

use crate::error::{Error, Result};

/// A map of the state.
#[derive(Debug)]
pub(super) struct Map<'a> {
    pub(super) name: &'static str,
    /// Rows and columns.
    pub(super) sizes: [usize; 2],
    pub(super) values: &'a mut [f32],
}

/// All that a method remembers.
#[derive(Debug, Default)]
pub(super) struct State<'a> {
    pub(super) maps: Vec<Map<'a>>,
    /// Name, value and the number that it must be below.
    pub(super) counts: Vec<(&'static str, &'a mut u64, u64)>,
    /// Maps of variances, which are not negative.
    pub(super) variances: Vec<&'static str>,
}

/// A copy of a state.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// Name, rows and columns, values.
    pub maps: Vec<(String, [usize; 2], Vec<f32>)>,
    /// Name and count.
    pub counts: Vec<(String, u64)>,
}

impl<'a> State<'a> {
    pub(super) fn map(
        mut self,
        name: &'static str,
        sizes: [usize; 2],
        values: &'a mut [f32],
    ) -> Self {
        self.maps.push(Map { name, sizes, values });
        self
    }

    pub(super) fn count(mut self, name: &'static str, count: &'a mut u64) -> Self {
        self.counts.push((name, count, u64::MAX));
        self
    }

    /// A count that is always below a number.
    pub(super) fn count_below(mut self, name: &'static str, count: &'a mut u64, end: u64) -> Self {
        self.counts.push((name, count, end));
        self
    }

    /// A map of which no value is negative.
    pub(super) fn squares(
        self,
        name: &'static str,
        sizes: [usize; 2],
        values: &'a mut [f32],
    ) -> Self {
        let mut state = self.map(name, sizes, values);
        state.variances.push(name);
        state
    }

    /// One after the other.
    pub(super) fn and(mut self, other: Self) -> Self {
        self.maps.extend(other.maps);
        self.counts.extend(other.counts);
        self.variances.extend(other.variances);
        self
    }

    pub(super) fn snapshot(self) -> Snapshot {
        let copy = |map: Map<'_>| (map.name.to_owned(), map.sizes, map.values.to_vec());
        let counts = self.counts.into_iter().map(|(name, count, _)| (name.to_owned(), *count));
        Snapshot { maps: self.maps.into_iter().map(copy).collect(), counts: counts.collect() }
    }

    /// Takes the values of a snapshot, all of them or none.
    pub(super) fn restore(self, from: &Snapshot) -> Result<()> {
        let maps: Vec<_> = self.maps.iter().map(|map| found(map, from)).collect::<Result<_>>()?;
        let counts: Vec<_> = self
            .counts
            .iter()
            .map(|(name, _, end)| counted(name, *end, from))
            .collect::<Result<_>>()?;
        for (map, values) in self.maps.iter().zip(&maps) {
            check_signs(map.name, values, self.variances.contains(&map.name))?;
        }
        for (map, values) in self.maps.into_iter().zip(maps) {
            map.values.copy_from_slice(values);
        }
        for ((_, count, _), value) in self.counts.into_iter().zip(counts) {
            *count = value;
        }
        Ok(())
    }
}

fn found<'s>(map: &Map<'_>, from: &'s Snapshot) -> Result<&'s [f32]> {
    let named = from.maps.iter().find(|(name, _, _)| name == map.name);
    let Some((_, sizes, values)) = named else {
        return Err(Error::value("state", format!("lacks the map '{}'", map.name)));
    };
    if *sizes != map.sizes || values.len() != map.values.len() {
        let ([got, cols], wanted) = (*sizes, map.sizes);
        return Err(Error::value(
            "state",
            format!(
                "has a map '{}' of ({got}, {cols}), expected ({}, {})",
                map.name, wanted[0], wanted[1]
            ),
        ));
    }
    match values.iter().find(|value| !value.is_finite()) {
        Some(bad) => Err(Error::value("state", format!("holds {bad} in the map '{}'", map.name))),
        None => Ok(values),
    }
}

fn check_signs(name: &str, values: &[f32], squares: bool) -> Result<()> {
    match values.iter().find(|value| squares && **value < 0.0) {
        Some(bad) => Err(Error::value("state", format!("holds {bad} in the map '{name}'"))),
        None => Ok(()),
    }
}

fn counted(wanted: &str, end: u64, from: &Snapshot) -> Result<u64> {
    match from.counts.iter().find(|(name, _)| name == wanted) {
        None => Err(Error::value("state", format!("lacks the count '{wanted}'"))),
        Some((_, count)) if *count >= end => Err(Error::value(
            "state",
            format!("has the count '{wanted}' {count}, expected below {end}"),
        )),
        Some((_, count)) => Ok(*count),
    }
}
