//! Classes of Gaussians: what a Gaussian is a part of.
//!
//! The names are those of the Cityscapes data set (Cordts et al. 2016, "The Cityscapes Dataset for
//! Semantic Urban Scene Understanding"; the table `labels.py` of its scripts). Its 19 training
//! classes have their training id plus 2, so that a network's output compares after one addition.
//! `ground`, `static` and `dynamic` are further labels of that table, and `vehicle` is a category
//! of it: an actor of a scenario says that it is a vehicle, and not which.
//!
//! A Gaussian takes one byte, and only where a scene has classes ([`Gaussians::classes`],
//! [`Chunk::classes`]).
//!
//! [`Gaussians::classes`]: crate::Gaussians::classes
//! [`Chunk::classes`]: crate::Chunk::classes

use crate::ActorClass;

/// The class of a Gaussian, or of a pixel by the Gaussian that owns it. The discriminant is the
/// value in files, on the wire and in images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum SemanticClass {
    /// Of a pixel that no Gaussian owns: a sky behind the Gaussians, or nothing. No Gaussian has
    /// it.
    None = 0,
    /// Nothing is known about the Gaussian.
    #[default]
    Unlabelled = 1,
    Road,
    Sidewalk,
    Building,
    Wall,
    Fence,
    Pole,
    TrafficLight,
    TrafficSign,
    Vegetation,
    /// Soil, sand and lawn.
    Terrain,
    /// Gaussians that stand for the sky.
    Sky,
    /// A person on foot.
    Person,
    /// A person on a bicycle or a motorcycle.
    Rider,
    Car,
    Truck,
    Bus,
    /// A vehicle on rails.
    Train,
    Motorcycle,
    Bicycle,
    /// Ground of any other kind.
    Ground,
    /// Any other thing that stays where it is.
    Static,
    /// Any other thing that may move.
    Dynamic,
    /// A vehicle of unknown kind.
    Vehicle,
}

impl SemanticClass {
    /// Every class, in the order of their values, which count up from 0.
    pub const ALL: [Self; 25] = [
        Self::None,
        Self::Unlabelled,
        Self::Road,
        Self::Sidewalk,
        Self::Building,
        Self::Wall,
        Self::Fence,
        Self::Pole,
        Self::TrafficLight,
        Self::TrafficSign,
        Self::Vegetation,
        Self::Terrain,
        Self::Sky,
        Self::Person,
        Self::Rider,
        Self::Car,
        Self::Truck,
        Self::Bus,
        Self::Train,
        Self::Motorcycle,
        Self::Bicycle,
        Self::Ground,
        Self::Static,
        Self::Dynamic,
        Self::Vehicle,
    ];

    /// The class of a value; `None` if there is none.
    pub fn from_value(value: u8) -> Option<Self> {
        Self::ALL.get(usize::from(value)).copied()
    }

    /// The class that a Gaussian may have with this value: any but [`SemanticClass::None`].
    pub fn for_gaussian(value: u8) -> Option<Self> {
        Self::from_value(value).filter(|&class| class != Self::None)
    }

    /// The class of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|class| class.name() == name)
    }

    /// The value in files, on the wire and in images.
    pub fn value(self) -> u8 {
        self as u8
    }

    /// The name in options and on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Unlabelled => "unlabelled",
            Self::Road => "road",
            Self::Sidewalk => "sidewalk",
            Self::Building => "building",
            Self::Wall => "wall",
            Self::Fence => "fence",
            Self::Pole => "pole",
            Self::TrafficLight => "traffic light",
            Self::TrafficSign => "traffic sign",
            Self::Vegetation => "vegetation",
            Self::Terrain => "terrain",
            Self::Sky => "sky",
            Self::Person => "person",
            Self::Rider => "rider",
            Self::Car => "car",
            Self::Truck => "truck",
            Self::Bus => "bus",
            Self::Train => "train",
            Self::Motorcycle => "motorcycle",
            Self::Bicycle => "bicycle",
            Self::Ground => "ground",
            Self::Static => "static",
            Self::Dynamic => "dynamic",
            Self::Vehicle => "vehicle",
        }
    }

    /// The class of what an actor's own Gaussians say nothing about. A bicycle counts with its
    /// rider.
    pub fn from_actor(class: ActorClass) -> Self {
        match class {
            ActorClass::Vehicle => Self::Vehicle,
            ActorClass::Pedestrian => Self::Person,
            ActorClass::Bicycle => Self::Bicycle,
            // An actor may move, whatever it is: `Static` is for the scene.
            ActorClass::Object => Self::Dynamic,
        }
    }

    /// This class, or `other` if it is [`SemanticClass::Unlabelled`].
    pub fn or(self, other: Self) -> Self {
        if self == Self::Unlabelled { other } else { self }
    }
}

impl std::fmt::Display for SemanticClass {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_count_up_and_names_are_distinct() {
        for (value, class) in (0..).zip(SemanticClass::ALL) {
            assert_eq!(class.value(), value);
            assert_eq!(SemanticClass::from_value(value), Some(class));
            assert_eq!(SemanticClass::from_name(class.name()), Some(class));
        }
        assert_eq!(SemanticClass::from_value(25), None);
        assert_eq!(SemanticClass::for_gaussian(0), None);
    }

    /// The 19 training ids of Cityscapes' `labels.py`.
    #[test]
    fn training_ids_of_cityscapes_are_two_less() {
        let names = [
            "road",
            "sidewalk",
            "building",
            "wall",
            "fence",
            "pole",
            "traffic light",
            "traffic sign",
            "vegetation",
            "terrain",
            "sky",
            "person",
            "rider",
            "car",
            "truck",
            "bus",
            "train",
            "motorcycle",
            "bicycle",
        ];
        for (id, name) in (0..).zip(names) {
            assert_eq!(SemanticClass::from_value(id + 2).map(SemanticClass::name), Some(name));
        }
    }
}
