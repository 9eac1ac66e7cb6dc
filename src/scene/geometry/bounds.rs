//! Axis-aligned boxes.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// An axis-aligned box, in metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Smallest corner, in metres.
    pub min_m: DVec3,
    /// Largest corner, in metres.
    pub max_m: DVec3,
}

impl Bounds {
    /// The empty box: the neutral element of [`Bounds::union`].
    pub const EMPTY: Self = Self { min_m: DVec3::INFINITY, max_m: DVec3::NEG_INFINITY };

    /// Whether the box contains no point.
    pub fn is_empty(&self) -> bool {
        // All axes are empty or none is: `add` changes all of them.
        self.min_m.x > self.max_m.x
    }

    /// Grows to contain the box with half-size `half_size_m` around `point_m`, both in metres.
    pub fn add(&mut self, point_m: DVec3, half_size_m: DVec3) {
        self.min_m = self.min_m.min(point_m - half_size_m);
        self.max_m = self.max_m.max(point_m + half_size_m);
    }

    /// The smallest box that contains both boxes.
    pub fn union(&self, other: &Self) -> Self {
        Self { min_m: self.min_m.min(other.min_m), max_m: self.max_m.max(other.max_m) }
    }

    /// Distance from a point to the box, in metres; 0 inside.
    pub fn distance_m(&self, point_m: DVec3) -> f64 {
        // The nearest point of the box is the point itself with each coordinate clamped.
        point_m.clamp(self.min_m, self.max_m).distance(point_m)
    }

    /// Centre of the box, in metres; meaningless for an empty box.
    pub fn center_m(&self) -> DVec3 {
        0.5 * (self.min_m + self.max_m)
    }

    /// Edge lengths, in metres.
    pub fn size_m(&self) -> DVec3 {
        self.max_m - self.min_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_grows_around_what_is_added() {
        let mut bounds = Bounds::EMPTY;
        assert!(bounds.is_empty());
        bounds.add(DVec3::new(1.0, 2.0, 3.0), DVec3::splat(0.5));
        bounds.add(DVec3::new(-1.0, 2.0, 3.0), DVec3::ZERO);
        assert_eq!(bounds.min_m, DVec3::new(-1.0, 1.5, 2.5));
        assert_eq!(bounds.max_m, DVec3::new(1.5, 2.5, 3.5));
        assert_eq!(bounds.union(&Bounds::EMPTY), bounds);
    }
}
