//! Connected components: what the measurements can and cannot compare.
//!
//! ln y_k(p) = ln L(u_k(p)) + ln M(p) is a bipartite graph of pixels and beam cells with an edge
//! for each used measurement. Within a connected component M is determined up to one factor;
//! between components nothing is.

use crate::control::Control;
use crate::error::Result;
use crate::frames::Real;
use crate::model::Model;

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

    /// Makes one set of the sets of `a` and `b`.
    pub fn union(&mut self, a: usize, b: usize) {
        let (a, b) = (self.find(a), self.find(b));
        if a != b {
            self.parents[a.max(b)] = a.min(b) as u32;
        }
    }
}

/// The label of what belongs to no component: it has no used measurement.
pub const NONE: i32 = -1;

/// The connected components of an experiment.
#[derive(Clone, Debug)]
pub struct Components {
    /// The component of each pixel, or [`NONE`]. Component 0 has the most pixels; of equal ones
    /// the one with the lowest pixel index comes first.
    pub pixels: Vec<i32>,
    /// The component of each cell of the beam grid, or [`NONE`].
    pub cells: Vec<i32>,
    /// How many pixels each component has, falling.
    pub sizes: Vec<usize>,
}

impl Components {
    /// Finds the components of the measurements that `model` uses.
    ///
    /// # Errors
    /// [`Error::Cancelled`](crate::Error::Cancelled) if `control` asks to stop.
    pub fn of<T: Real>(model: &Model<'_, T>, control: &Control) -> Result<Self> {
        let geometry = &model.geometry;
        let pixels = geometry.sensor.len();
        let mut sets = DisjointSets::new(pixels + geometry.beam.len());
        let mut used = vec![false; pixels + geometry.beam.len()];
        model.for_each_used(control, |pixel, cell| {
            sets.union(pixel, pixels + cell);
            used[pixel] = true;
            used[pixels + cell] = true;
        })?;
        // Each component has a pixel, and pixels come before cells: so roots are pixels.
        let mut sizes = vec![0_usize; pixels];
        for pixel in (0..pixels).filter(|&pixel| used[pixel]) {
            sizes[sets.find(pixel)] += 1;
        }
        let mut roots: Vec<usize> = (0..pixels).filter(|&root| sizes[root] > 0).collect();
        roots.sort_by_key(|&root| (std::cmp::Reverse(sizes[root]), root));
        let mut labels = vec![NONE; pixels];
        for (label, &root) in roots.iter().enumerate() {
            labels[root] = label as i32;
        }
        let mut label = |node: usize| {
            if node.is_multiple_of(CHECK_EVERY) {
                control.check()?;
            }
            Ok(if used[node] { labels[sets.find(node)] } else { NONE })
        };
        Ok(Self {
            pixels: (0..pixels).map(&mut label).collect::<Result<_>>()?,
            cells: (pixels..used.len()).map(&mut label).collect::<Result<_>>()?,
            sizes: roots.iter().map(|&root| sizes[root]).collect(),
        })
    }
}
