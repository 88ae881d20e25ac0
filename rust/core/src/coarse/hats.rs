//! Bilinear hats on a coarse grid over the sensor.

use crate::frames::Shape;

/// The hats along one side of the sensor: at node j the hat is 1, at the neighbouring nodes 0.
#[derive(Clone, Debug)]
pub(crate) struct Axis {
    pub(crate) spacing: f64,
    /// Number of nodes, at least two.
    pub(crate) nodes: usize,
}

impl Axis {
    /// Nodes on a side of `length` pixels, from the first pixel to the last, about `spacing` apart.
    pub(crate) fn new(length: usize, spacing: usize) -> Self {
        let span = (length - 1).max(1);
        let intervals = (span / spacing).max(1);
        Self { spacing: span as f64 / intervals as f64, nodes: intervals + 1 }
    }

    /// The node before a position and the height there of the hat of the node behind it; outside
    /// the sensor as at its border.
    pub(crate) fn at(&self, position: f64) -> (usize, f64) {
        let place = (position / self.spacing).clamp(0.0, (self.nodes - 1) as f64);
        let node = (place as usize).min(self.nodes - 2);
        (node, place - node as f64)
    }
}

/// The hats over a sensor, numbered row by row.
#[derive(Clone, Debug)]
pub(crate) struct Hats {
    pub(crate) rows: Axis,
    pub(crate) cols: Axis,
    /// [`Axis::at`] of each column of the sensor.
    pub(crate) columns: Vec<(u32, f32)>,
}

impl Hats {
    pub(crate) fn new(sensor: Shape, spacing: [usize; 2]) -> Self {
        let (rows, cols) = (Axis::new(sensor.rows, spacing[0]), Axis::new(sensor.cols, spacing[1]));
        let place = |col| {
            let (node, height) = cols.at(col as f64);
            (node as u32, height as f32)
        };
        let columns = (0..sensor.cols).map(place).collect();
        Self { rows, cols, columns }
    }

    pub(crate) fn count(&self) -> usize {
        self.rows.nodes * self.cols.nodes
    }

    /// The share of the sensor that a hat stands for: a hat at the border is half of one.
    pub(crate) fn share(&self, hat: usize) -> f64 {
        let half = |axis: &Axis, node| if node == 0 || node + 1 == axis.nodes { 0.5 } else { 1.0 };
        half(&self.rows, hat / self.cols.nodes) * half(&self.cols, hat % self.cols.nodes)
    }

    /// The four hats that cover a point of the sensor, with their heights there.
    pub(crate) fn over(&self, row: f64, col: f64) -> [(usize, f64); 4] {
        let ((i, s), (j, t)) = (self.rows.at(row), self.cols.at(col));
        let first = i * self.cols.nodes + j;
        let below = first + self.cols.nodes;
        [
            (first, (1.0 - s) * (1.0 - t)),
            (first + 1, (1.0 - s) * t),
            (below, s * (1.0 - t)),
            (below + 1, s * t),
        ]
    }
}
