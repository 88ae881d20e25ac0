//! Connected components: of measurements (what they can and cannot compare), of pixels in a spot.
//!
//! ln y_k(p) = ln L(u_k(p)) + ln M(p) is a bipartite graph of pixels and beam cells with an edge
//! for each used measurement. Within a connected component M is determined up to one factor;
//! between components nothing is. A pixel that does not respond tells nothing of the beam that it
//! sees, so it has no edge and joins nothing; nor has a pixel in the dark.

use std::collections::BTreeMap;
use std::ops::Range;

use crate::control::Control;
use crate::error::Result;
use crate::exposures::{Exposures, Mask};
use crate::frames::{Real, Shape};
use crate::geometry::Geometry;
use crate::memory;

/// Pixels or cells between two looks at whether to stop.
const CHECK_EVERY: usize = 1 << 20;

/// Disjoint sets of 0, 1, … with the smallest member as the root of each.
#[derive(Clone, Debug)]
pub struct DisjointSets {
    parents: Vec<u32>,
}

impl DisjointSets {
    /// `count` sets of one member each.
    #[must_use]
    pub fn new(count: usize) -> Self {
        Self { parents: (0..count as u32).collect() }
    }

    /// The smallest member of the set of `index`.
    pub fn find(&mut self, index: usize) -> usize {
        let mut node = index;
        while self.parents[node] as usize != node {
            let parent = self.parents[node] as usize;
            self.parents[node] = self.parents[parent];
            node = self.parents[node] as usize;
        }
        node
    }

    /// The smallest member of each set, by member.
    fn into_roots(mut self, control: &Control) -> Result<Vec<u32>> {
        // A parent is smaller than its child, so it is already a root when the child's turn comes.
        in_parts(self.parents.len(), control, |node| {
            self.parents[node] = self.parents[self.parents[node] as usize];
        })?;
        Ok(self.parents)
    }

    /// Makes one set of the sets of `a` and `b`.
    pub fn union(&mut self, a: usize, b: usize) {
        // Most are of one set already, and next to its root.
        if self.parents[a] == self.parents[b] {
            return;
        }
        let (a, b) = (self.find(a), self.find(b));
        if a != b {
            self.parents[a.max(b)] = a.min(b) as u32;
        }
    }
}

/// Calls `visit` for 0, 1, … `count` − 1, and looks now and then whether to stop.
pub(crate) fn in_parts(
    count: usize,
    control: &Control,
    mut visit: impl FnMut(usize),
) -> Result<()> {
    for start in (0..count).step_by(CHECK_EVERY) {
        control.check()?;
        (start..count.min(start + CHECK_EVERY)).for_each(&mut visit);
    }
    Ok(())
}

/// The label of what belongs to no component: it has no used measurement.
pub const NONE: i32 = -1;

/// What the measurements of a pixel do for others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tie {
    /// They compare what it sees.
    Firm,
    /// They carry next to no weight: they join nothing, but cells that no other pixel sees follow
    /// from it.
    Loose,
    /// It does not respond: they contain no information on the beam.
    None,
}

/// The connected components of an experiment.
#[derive(Clone, Debug)]
pub struct Components {
    /// The component of each pixel, or [`NONE`]. Component 0 has the most pixels; of equal ones
    /// the one with the lowest pixel index comes first.
    pub pixels: Vec<i32>,
    /// The component of each cell of the beam grid, or [`NONE`].
    pub cells: Vec<i32>,
    /// How many firmly tied pixels each component has, falling.
    pub sizes: Vec<usize>,
    /// How many pixels have a used measurement, however they are tied.
    pub seen: usize,
}

impl Components {
    /// Finds the components of the measurements that `model` uses.
    ///
    /// A pixel that is not tied firmly belongs to the component of the cells that it sees, if they
    /// are all of one.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
    pub fn of<T: Real>(
        exposures: &Exposures<'_, T>,
        ties: &[Tie],
        control: &Control,
    ) -> Result<Self> {
        let mut edges =
            Edges::new(exposures.geometry().sensor.len(), exposures.geometry().beam.len());
        exposures.for_each_used(control, |pixel, cell| {
            if ties[pixel] == Tie::Firm {
                edges.add(pixel, cell);
            }
        })?;
        let mut components = edges.components(control)?;
        if ties.iter().any(|&tie| tie != Tie::Firm) {
            components.attach(exposures, ties, control)?;
        }
        Ok(components)
    }

    /// Finds the components of all measurements that `mask` leaves, before any is made.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) if the mask does not fit;
    /// [`Error::Memory`](crate::Error::Memory) if the memory for it cannot be had;
    /// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
    pub fn planned(geometry: &Geometry, mask: Mask<'_>, control: &Control) -> Result<Self> {
        mask.check(geometry.placements.len(), geometry.sensor)?;
        memory::check(bytes_needed(geometry), || {
            format!("comparing the pixels of {}", geometry.sensor)
        })?;
        let mut edges = Edges::new(geometry.sensor.len(), geometry.beam.len());
        let cols = geometry.sensor.cols;
        for (exposure, place) in geometry.placements.iter().enumerate() {
            let cells = geometry.views[place.view].cells;
            for row in 0..geometry.sensor.rows {
                control.check()?;
                let masked = mask.row(exposure, row, geometry.sensor);
                for col in 0..cols {
                    if masked.is_none_or(|masked| !masked[col]) {
                        edges.add(row * cols + col, cells.at(row + place.row, col + place.col));
                    }
                }
            }
        }
        edges.components(control)
    }

    /// Gives pixels that are not tied firmly the label of the cells that they see, or [`NONE`] where
    /// these differ; and cells that only loose ones see the label of those.
    fn attach<T: Real>(
        &mut self,
        exposures: &Exposures<'_, T>,
        ties: &[Tie],
        control: &Control,
    ) -> Result<()> {
        // The lowest and the highest label seen: few pixels are in it, so it is small.
        let mut labels = BTreeMap::new();
        exposures.for_each_used(control, |pixel, cell| {
            if ties[pixel] != Tie::Firm {
                let range = labels.entry(pixel).or_insert((i32::MAX, NONE));
                if self.cells[cell] != NONE {
                    *range = (range.0.min(self.cells[cell]), range.1.max(self.cells[cell]));
                }
            }
        })?;
        self.seen += labels.len();
        for (pixel, (lowest, highest)) in labels {
            if lowest == highest {
                self.pixels[pixel] = lowest;
            }
        }
        exposures.for_each_used(control, |pixel, cell| {
            if ties[pixel] == Tie::Loose && self.cells[cell] == NONE {
                self.cells[cell] = self.pixels[pixel];
            }
        })
    }
}

impl Components {
    /// Gives loosely tied pixels that belong to no component, and cells that they alone see, the label of the
    /// largest one in their piece, `pieces` being those of pixels however they are tied.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
    pub(crate) fn adopt<T: Real>(
        &mut self,
        exposures: &Exposures<'_, T>,
        pieces: &[i32],
        ties: &[Tie],
        control: &Control,
    ) -> Result<()> {
        let count = pieces.iter().max().map_or(0, |&last| (last + 1) as usize);
        let mut largest = vec![NONE; count];
        for (&piece, &label) in pieces.iter().zip(&self.pixels).filter(|(_, label)| **label != NONE)
        {
            let Ok(piece) = usize::try_from(piece) else { continue };
            let known = &mut largest[piece];
            *known = if *known == NONE { label } else { label.min(*known) };
        }
        let pixels = self.pixels.iter_mut().zip(pieces).zip(ties);
        for ((label, &piece), _) in pixels.filter(|(_, tie)| **tie == Tie::Loose) {
            if let (NONE, Ok(piece)) = (*label, usize::try_from(piece)) {
                *label = largest[piece];
            }
        }
        exposures.for_each_used(control, |pixel, cell| {
            if ties[pixel] == Tie::Loose && self.cells[cell] == NONE {
                self.cells[cell] = self.pixels[pixel];
            }
        })
    }
}

/// What finding components holds at its fullest: sets and labels of 4 bytes and a byte of use for
/// each pixel and cell, sizes and the labels of roots of 4 bytes each for each pixel.
fn bytes_needed(geometry: &Geometry) -> u64 {
    let (pixels, cells) = (geometry.sensor.len() as u64, geometry.beam.len() as u64);
    9 * (pixels + cells) + 8 * pixels
}

/// The measurements seen so far, as edges between pixels and cells.
pub(crate) struct Edges {
    pixels: usize,
    sets: DisjointSets,
    used: Vec<bool>,
}

impl Edges {
    /// None yet between so many pixels and cells.
    pub(crate) fn new(pixels: usize, cells: usize) -> Self {
        let sets = DisjointSets::new(pixels + cells);
        Self { pixels, sets, used: vec![false; pixels + cells] }
    }

    /// One that a measurement makes.
    pub(crate) fn add(&mut self, pixel: usize, cell: usize) {
        self.sets.union(pixel, self.pixels + cell);
        self.used[pixel] = true;
        self.used[self.pixels + cell] = true;
    }

    /// The components that they make.
    pub(crate) fn components(self, control: &Control) -> Result<Components> {
        let Self { pixels, sets, used } = self;
        let roots = sets.into_roots(control)?;
        // Each component has a pixel, and pixels come before cells: so roots are pixels. One
        // that is not tied is its own root, and not used.
        let mut sizes = vec![0_u32; pixels];
        in_parts(pixels, control, |pixel| {
            sizes[roots[pixel] as usize] += u32::from(used[pixel]);
        })?;
        let mut order = Vec::new();
        in_parts(pixels, control, |pixel| order.extend((sizes[pixel] > 0).then_some(pixel)))?;
        order.sort_by_key(|&root| (std::cmp::Reverse(sizes[root]), root));
        let mut label_of = vec![NONE; pixels];
        for (label, &root) in order.iter().enumerate() {
            label_of[root] = label as i32;
        }
        let mut labels = Vec::with_capacity(used.len());
        in_parts(used.len(), control, |node| {
            labels.push(if used[node] { label_of[roots[node] as usize] } else { NONE });
        })?;
        let cells = labels.split_off(pixels);
        let sizes: Vec<usize> = order.iter().map(|&root| sizes[root] as usize).collect();
        let seen = sizes.iter().sum();
        Ok(Components { pixels: labels, cells, sizes, seen })
    }
}

/// Stretches of rows whose pixels, or cells, are known to be of one component: one a row, so that most
/// measurements of rows that hang together are seen at once.
pub(crate) struct Stretches {
    sensor: Shape,
    beam: Shape,
    pixels: Vec<Option<Range<usize>>>,
    cells: Vec<Option<Range<usize>>>,
}

impl Stretches {
    /// None yet.
    pub(crate) fn new(sensor: Shape, beam: Shape) -> Self {
        Self { sensor, beam, pixels: vec![None; sensor.rows], cells: vec![None; beam.rows] }
    }

    /// Makes one component of pixels side by side in a row and of cells side by side in some rows.
    pub(crate) fn join(
        &mut self,
        edges: &mut Edges,
        row: usize,
        pixels: Range<usize>,
        rows: Range<usize>,
        cells: Range<usize>,
    ) {
        let first = row * self.sensor.cols;
        let pixel = first + pixels.start;
        join_stretch(edges, &mut self.pixels[row], first, pixels);
        for row in rows {
            let first = edges.pixels + row * self.beam.cols;
            let cell = first + cells.start;
            join_stretch(edges, &mut self.cells[row], first, cells.clone());
            edges.sets.union(pixel, cell);
        }
    }
}

/// Joins the nodes of a row, which begins at `first`, in these columns; `known` are joined already.
fn join_stretch(
    edges: &mut Edges,
    known: &mut Option<Range<usize>>,
    first: usize,
    columns: Range<usize>,
) {
    let meets = |known: &&mut Range<usize>| columns.start < known.end && known.start < columns.end;
    let met = known.as_mut().filter(meets);
    let inside = met.as_deref().map_or(columns.start..columns.start, Range::clone);
    for col in (columns.start..inside.start).chain(inside.end..columns.end) {
        edges.sets.union(first + columns.start, first + col);
        edges.used[first + col] = true;
    }
    match met {
        Some(known) => {
            edges.sets.union(first + columns.start, first + known.start);
            *known = known.start.min(columns.start)..known.end.max(columns.end);
        }
        None => {
            known.get_or_insert(columns);
        }
    }
}

/// The 8-connected component of each pixel of `mask`, numbered in the order of their first pixels;
/// [`NONE`] outside the mask.
///
/// Eight neighbours, not four: a spot's outline is ragged with noise and a slit may lie obliquely,
/// and pixels that touch at a corner only are still the same light.
///
/// # Errors
/// [`Error::Cancelled`](crate::Error::Cancelled).
pub fn label_pixels(mask: &[bool], shape: Shape, control: &Control) -> Result<Vec<i32>> {
    let mut sets = DisjointSets::new(mask.len());
    for row in 0..shape.rows {
        control.check()?;
        for col in (0..shape.cols).filter(|col| mask[row * shape.cols + col]) {
            let pixel = row * shape.cols + col;
            for neighbour in earlier_neighbours(row, col, shape).filter(|&other| mask[other]) {
                sets.union(pixel, neighbour);
            }
        }
    }
    number_sets(&mut sets, mask, shape, control)
}

/// The neighbours of a pixel that come before it, row by row: west, north-west, north, north-east.
fn earlier_neighbours(row: usize, col: usize, shape: Shape) -> impl Iterator<Item = usize> {
    let pixel = row * shape.cols + col;
    let above = |step: usize, inside: bool| (row > 0 && inside).then(|| pixel + step - shape.cols);
    let west = (col > 0).then(|| pixel - 1);
    let north_west = if col > 0 { above(0, true).map(|north| north - 1) } else { None };
    [west, north_west, above(0, true), above(1, col + 1 < shape.cols)].into_iter().flatten()
}

fn number_sets(
    sets: &mut DisjointSets,
    mask: &[bool],
    shape: Shape,
    control: &Control,
) -> Result<Vec<i32>> {
    let mut labels = vec![NONE; mask.len()];
    let mut count = 0;
    for row in 0..shape.rows {
        control.check()?;
        for pixel in (row * shape.cols..(row + 1) * shape.cols).filter(|&pixel| mask[pixel]) {
            let root = sets.find(pixel);
            // The root is the smallest number of its set, so it has its label already.
            if root == pixel {
                labels[pixel] = count;
                count += 1;
            } else {
                labels[pixel] = labels[root];
            }
        }
    }
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn labels(mask: &[bool], rows: usize, cols: usize) -> Vec<i32> {
        label_pixels(mask, Shape::new(rows, cols), &Control::new()).unwrap()
    }

    /// Spreads the smallest index of a component until nothing changes.
    fn spread(mask: &[bool], rows: usize, cols: usize) -> Vec<usize> {
        let mut smallest: Vec<usize> = (0..mask.len()).collect();
        loop {
            let former = smallest.clone();
            for (a, b) in (0..mask.len()).flat_map(|a| (0..mask.len()).map(move |b| (a, b))) {
                let near = (a / cols).abs_diff(b / cols) <= 1 && (a % cols).abs_diff(b % cols) <= 1;
                if near && mask[a] && mask[b] {
                    smallest[a] = smallest[a].min(smallest[b]);
                }
            }
            if smallest == former {
                assert!(rows * cols == mask.len());
                return smallest;
            }
        }
    }

    #[test]
    fn the_smallest_number_is_the_root() {
        let mut sets = DisjointSets::new(6);
        sets.union(5, 3);
        sets.union(3, 1);
        sets.union(4, 2);
        assert_eq!((0..6).map(|i| sets.find(i)).collect::<Vec<_>>(), [0, 1, 2, 1, 2, 1]);
    }

    #[test]
    fn corners_connect() {
        assert_eq!(labels(&[true, false, false, true], 2, 2), [0, NONE, NONE, 0]);
        assert_eq!(labels(&[false, true, true, false], 2, 2), [NONE, 0, 0, NONE]);
        assert_eq!(labels(&[true, false, true], 1, 3), [0, NONE, 1]);
        assert_eq!(labels(&[], 0, 0), [NONE; 0]);
    }

    proptest! {
        #[test]
        fn labels_are_the_components(
            (cols, mask) in (1_usize..7, 1_usize..7).prop_flat_map(|(rows, cols)| {
                (Just(cols), prop::collection::vec(any::<bool>(), rows * cols))
            })
        ) {
            let rows = mask.len() / cols;
            let got = labels(&mask, rows, cols);
            let smallest = spread(&mask, rows, cols);
            let roots: Vec<usize> = (0..mask.len()).filter(|&i| mask[i] && smallest[i] == i).collect();
            for pixel in 0..mask.len() {
                let number = roots.iter().position(|&root| mask[pixel] && root == smallest[pixel]);
                prop_assert_eq!(got[pixel], number.map_or(NONE, |number| number as i32));
            }
        }
    }
}
