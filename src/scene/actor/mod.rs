//! Actors: the moving objects in a twin, apart from the ego.

mod asset;
mod placed;

use serde::{Deserialize, Serialize};

pub use asset::{ActorAsset, ActorViewpoint, AssetDescription, AssetError, AssetLevel};
pub use placed::{ContactShadow, PlacedChunk};

/// The kind of an actor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActorClass {
    /// A car, van, truck, bus or motorcycle.
    Vehicle,
    /// A person on foot.
    Pedestrian,
    /// A bicycle with its rider.
    Bicycle,
    /// Anything else: a cone, a barrier, a box on the road.
    Object,
}

/// The box around an actor, in metres. Its origin is on the ground under its centre, x points
/// forward, y to the left and z up: the box reaches from -length/2 to length/2, from -width/2 to
/// width/2 and from 0 to height.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActorBox {
    /// Extent along x, in metres.
    pub length_m: f64,
    /// Extent along y, in metres.
    pub width_m: f64,
    /// Extent along z, in metres.
    pub height_m: f64,
}

/// Why a box was refused.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{field} is {value:?}; an actor is from {least:?} to {most:?} m in each direction")]
pub struct ActorBoxError {
    /// The field: `length_m`, `width_m` or `height_m`.
    pub field: &'static str,
    /// The refused value, in metres.
    pub value: f64,
    /// The smallest accepted, in metres.
    pub least: f64,
    /// The largest accepted, in metres.
    pub most: f64,
}

impl ActorClass {
    /// Every class, in the order of their declaration.
    pub const ALL: [Self; 4] = [Self::Vehicle, Self::Pedestrian, Self::Bicycle, Self::Object];

    /// The name in files and on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vehicle => "vehicle",
            Self::Pedestrian => "pedestrian",
            Self::Bicycle => "bicycle",
            Self::Object => "object",
        }
    }
}

impl ActorBox {
    /// Smallest extent of a box, in metres.
    pub const LEAST_M: f64 = 0.01;

    /// Largest extent of a box, in metres: longer than any road train (53.5 m) or tram (59 m).
    pub const MOST_M: f64 = 100.0;

    /// A pedestrian: 0.6 m x 0.6 m x 1.75 m.
    pub const PEDESTRIAN: Self = Self { length_m: 0.6, width_m: 0.6, height_m: 1.75 };

    /// Length, width and height as shares of those of another box.
    pub fn ratios(&self, other: &Self) -> [f64; 3] {
        [
            self.length_m / other.length_m,
            self.width_m / other.width_m,
            self.height_m / other.height_m,
        ]
    }

    /// Checks that each extent is finite and from [`Self::LEAST_M`] to [`Self::MOST_M`].
    ///
    /// # Errors
    /// Names the first extent out of range.
    pub fn check(&self) -> Result<(), ActorBoxError> {
        let extents =
            [("length_m", self.length_m), ("width_m", self.width_m), ("height_m", self.height_m)];
        for (field, value) in extents {
            // `contains` is false for NaN.
            let accepted = (Self::LEAST_M..=Self::MOST_M).contains(&value);
            if !accepted {
                let least = Self::LEAST_M;
                let most = Self::MOST_M;
                return Err(ActorBoxError { field, value, least, most });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_names_its_wrong_side() {
        assert_eq!(ActorBox::PEDESTRIAN.check(), Ok(()));
        for wrong_m in [0.0, -1.0, f64::NAN, f64::INFINITY, 101.0] {
            let refused = ActorBox { width_m: wrong_m, ..ActorBox::PEDESTRIAN }.check();
            assert_eq!(refused.unwrap_err().field, "width_m", "{wrong_m}");
        }
    }

    #[test]
    fn names_are_those_of_json() {
        for class in ActorClass::ALL {
            assert_eq!(serde_json::to_value(class).unwrap(), class.name());
        }
    }
}
