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
    pub(super) counts: Vec<(&'static str, &'a mut u64)>,
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
        self.counts.push((name, count));
        self
    }

    /// One after the other.
    pub(super) fn and(mut self, other: Self) -> Self {
        self.maps.extend(other.maps);
        self.counts.extend(other.counts);
        self
    }

    pub(super) fn snapshot(self) -> Snapshot {
        let copy = |map: Map<'_>| (map.name.to_owned(), map.sizes, map.values.to_vec());
        let counts = self.counts.into_iter().map(|(name, count)| (name.to_owned(), *count));
        Snapshot { maps: self.maps.into_iter().map(copy).collect(), counts: counts.collect() }
    }

    /// Takes the values of a snapshot, all of them or none.
    pub(super) fn restore(self, from: &Snapshot) -> Result<()> {
        let maps: Vec<_> = self.maps.iter().map(|map| found(map, from)).collect::<Result<_>>()?;
        let counts: Vec<_> =
            self.counts.iter().map(|(name, _)| counted(name, from)).collect::<Result<_>>()?;
        for (map, values) in self.maps.into_iter().zip(maps) {
            map.values.copy_from_slice(values);
        }
        for ((_, count), value) in self.counts.into_iter().zip(counts) {
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

fn counted(wanted: &str, from: &Snapshot) -> Result<u64> {
    let named = from.counts.iter().find(|(name, _)| name == wanted);
    named
        .map(|(_, count)| *count)
        .ok_or_else(|| Error::value("state", format!("lacks the count '{wanted}'")))
}
