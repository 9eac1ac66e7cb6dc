//! Axis-aligned boxes.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// An axis-aligned box in metres; empty until something is added.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Smallest corner, in metres.
    pub min_m: DVec3,
    /// Largest corner, in metres.
    pub max_m: DVec3,
}

impl Bounds {
    /// Contains nothing; the neutral element of [`Bounds::union`].
    pub const EMPTY: Self = Self { min_m: DVec3::INFINITY, max_m: DVec3::NEG_INFINITY };

    /// Whether nothing was added yet.
    pub fn is_empty(&self) -> bool {
        self.min_m.x > self.max_m.x
    }

    /// Grows to contain the box of half-size `reach_m` around a point.
    pub fn add(&mut self, point_m: DVec3, reach_m: DVec3) {
        self.min_m = self.min_m.min(point_m - reach_m);
        self.max_m = self.max_m.max(point_m + reach_m);
    }

    /// The smallest box that contains both.
    pub fn union(&self, other: &Self) -> Self {
        Self { min_m: self.min_m.min(other.min_m), max_m: self.max_m.max(other.max_m) }
    }

    /// How far a point is from the nearest one of the box, in metres; 0 within.
    pub fn distance_m(&self, point_m: DVec3) -> f64 {
        point_m.clamp(self.min_m, self.max_m).distance(point_m)
    }

    /// The middle, in metres; meaningless for an empty box.
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
