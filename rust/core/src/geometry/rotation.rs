//! Rotations of the sensor against the beam: the one table of A and t in u = A p + t + d.
//!
//! | rotation | window shape | A | t |
//! |---|---|---|---|
//! | 0 | (R, C) | I | (0, 0) |
//! | 90° | (C, R) | [[0, 1], [−1, 0]] | (0, R−1) |
//! | 180° | (R, C) | −I | (R−1, C−1) |
//! | 270° | (C, R) | [[0, −1], [1, 0]] | (C−1, 0) |
//!
//! Each axis of the sensor lies along one axis of the beam, forwards or reversed. A, t and
//! everything else follows from that ([`Rotation::axes`]).

use std::ops::{Neg, Sub};

use crate::frames::Shape;

/// How far the sensor is turned against the beam, counter-clockwise as by `numpy.rot90`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Rotation {
    /// Not turned.
    #[default]
    None,
    /// By 90°.
    Quarter,
    /// By 180°.
    Half,
    /// By 270°.
    ThreeQuarters,
}

/// The axis of the beam that an axis of the sensor lies along.
#[derive(Clone, Copy)]
pub(crate) struct Axis {
    /// 0 for rows, 1 for columns.
    pub(crate) beam: usize,
    /// Whether one rises where the other falls.
    pub(crate) reversed: bool,
}

impl Rotation {
    /// The rotation of so many degrees, if that is 0, 90, 180 or 270.
    #[must_use]
    pub const fn from_degrees(degrees: i64) -> Option<Self> {
        match degrees {
            0 => Some(Self::None),
            90 => Some(Self::Quarter),
            180 => Some(Self::Half),
            270 => Some(Self::ThreeQuarters),
            _ => None,
        }
    }

    /// The axes of the sensor, rows first: column k of A has ±1 in row `beam`.
    pub(crate) fn axes(self) -> [Axis; 2] {
        let axis = |beam, reversed| Axis { beam, reversed };
        match self {
            Self::None => [axis(0, false), axis(1, false)],
            Self::Quarter => [axis(1, true), axis(0, false)],
            Self::Half => [axis(0, true), axis(1, true)],
            Self::ThreeQuarters => [axis(1, false), axis(0, true)],
        }
    }

    /// The rotation that undoes this one.
    pub(crate) const fn inverse(self) -> Self {
        match self {
            Self::Quarter => Self::ThreeQuarters,
            Self::ThreeQuarters => Self::Quarter,
            other => other,
        }
    }

    /// Whether rows become columns.
    pub(crate) const fn swaps_axes(self) -> bool {
        matches!(self, Self::Quarter | Self::ThreeQuarters)
    }

    /// The sizes of a grid of `shape` after this rotation.
    #[must_use]
    pub const fn turned(self, shape: Shape) -> Shape {
        if self.swaps_axes() { shape.transposed() } else { shape }
    }

    /// A p + t: where a point of a sensor lies in its window of the beam.
    pub(crate) fn to_beam<N: Coordinate>(self, point: [N; 2], sensor: Shape) -> [N; 2] {
        let mut place = point;
        let sides = [sensor.rows, sensor.cols];
        for ((axis, at), side) in self.axes().into_iter().zip(point).zip(sides) {
            place[axis.beam] = if axis.reversed { N::of(side) - N::of(1) - at } else { at };
        }
        place
    }

    /// The point of a turned grid that a point of the grid, of `shape` before, becomes.
    pub(crate) fn to_view<N: Coordinate>(self, point: [N; 2], shape: Shape) -> [N; 2] {
        self.inverse().to_beam(point, shape)
    }

    /// A v: a direction of the sensor as one of the beam.
    pub(crate) fn direction<N: Coordinate>(self, vector: [N; 2]) -> [N; 2] {
        let mut turned = vector;
        for (axis, part) in self.axes().into_iter().zip(vector) {
            turned[axis.beam] = if axis.reversed { -part } else { part };
        }
        turned
    }

    /// Aᵀ v: a direction of the beam as one of the sensor.
    pub(crate) fn in_sensor<N: Coordinate>(self, vector: [N; 2]) -> [N; 2] {
        self.inverse().direction(vector)
    }

    /// Lines that cut a grid between its rows and between its columns, from 0 to its size, after
    /// this rotation.
    pub(crate) fn turned_edges(self, rows: &[usize], cols: &[usize]) -> [Vec<usize>; 2] {
        self.axes().map(|axis| {
            let edges = [rows, cols][axis.beam];
            let end = edges.last().copied().unwrap_or(0);
            let back = || edges.iter().rev().map(|edge| end - edge).collect();
            if axis.reversed { back() } else { edges.to_vec() }
        })
    }
}

/// A coordinate: whole or between cells.
pub(crate) trait Coordinate: Copy + Neg<Output = Self> + Sub<Output = Self> {
    fn of(size: usize) -> Self;
}

impl Coordinate for i64 {
    fn of(size: usize) -> Self {
        size as Self
    }
}

impl Coordinate for f64 {
    fn of(size: usize) -> Self {
        size as Self
    }
}
