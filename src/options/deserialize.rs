//! Deserialization of fields that accept one of two forms.

use std::fmt;

use serde::de::{Error, IntoDeserializer, MapAccess, Visitor, value::MapAccessDeserializer};
use serde::{Deserialize, Deserializer};

use crate::{
    Dynamics, DynamicsChoice, DynamicsModel, Pose, RandomStart, Rig, RigChoice, ScenarioChoice,
    Start,
};

/// Chosen by the fields that are present. Serde's own `untagged` tries one variant after the other,
/// and cannot report the error of each.
impl<'de> Deserialize<'de> for Start {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Either {
            pose: Option<Pose>,
            trajectory: Option<String>,
            station_m: Option<f64>,
            random: Option<RandomStart>,
        }
        let Either { pose, trajectory, station_m, random } = Either::deserialize(deserializer)?;
        match (pose, trajectory, station_m, random) {
            (Some(pose), None, None, None) => Ok(Self::Pose { pose }),
            (None, None, None, Some(random)) => Ok(Self::Random { random }),
            (None, Some(trajectory), station_m, None) => {
                Ok(Self::Station { trajectory, station_m: station_m.unwrap_or_default() })
            }
            _ => Err(D::Error::custom(
                "a start has either pose, or trajectory and station_m, or random",
            )),
        }
    }
}

/// A string is a name.
impl<'de> Deserialize<'de> for ScenarioChoice {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = ScenarioChoice;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the name of a scenario, an object with name and values, or a scenario")
            }

            fn visit_str<E: Error>(self, name: &str) -> Result<ScenarioChoice, E> {
                Ok(ScenarioChoice::Name(name.to_owned()))
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<ScenarioChoice, A::Error> {
                serde_json::Map::deserialize(MapAccessDeserializer::new(map))
                    .map(ScenarioChoice::Object)
            }
        }
        deserializer.deserialize_any(Either)
    }
}

/// A string is the name of a preset, an object is a rig.
impl<'de> Deserialize<'de> for RigChoice {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = RigChoice;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the name of a preset, or a rig")
            }

            fn visit_str<E: Error>(self, name: &str) -> Result<RigChoice, E> {
                Ok(RigChoice::Preset(name.to_owned()))
            }

            fn visit_map<A: MapAccess<'de>>(self, rig: A) -> Result<RigChoice, A::Error> {
                Rig::deserialize(MapAccessDeserializer::new(rig)).map(RigChoice::Full)
            }
        }
        deserializer.deserialize_any(Either)
    }
}

/// A string is the name of a model, an object has all fields.
impl<'de> Deserialize<'de> for DynamicsChoice {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = DynamicsChoice;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the name of a model, or an object with model, speed and reverse")
            }

            fn visit_str<E: Error>(self, name: &str) -> Result<DynamicsChoice, E> {
                DynamicsModel::deserialize(name.into_deserializer()).map(DynamicsChoice::Model)
            }

            fn visit_map<A: MapAccess<'de>>(self, all: A) -> Result<DynamicsChoice, A::Error> {
                Dynamics::deserialize(MapAccessDeserializer::new(all)).map(DynamicsChoice::Full)
            }
        }
        deserializer.deserialize_any(Either)
    }
}
