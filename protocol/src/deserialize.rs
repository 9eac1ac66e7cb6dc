//! Parsing of requests with errors that name the mistake: fields that accept one of two forms, and fields
//! that do not exist.

use std::fmt;

use serde::de::{Error, IntoDeserializer, MapAccess, Visitor, value::MapAccessDeserializer};
use serde::{Deserialize, Deserializer};
use serde_json::Value;

use crate::message::{
    BranchPoint, Dynamics, DynamicsChoice, DynamicsModel, Pose, Rig, RigChoice, ScenarioChoice,
    Start,
};

/// Path of the first field of a request that no type knows, for example `rig.cameras[2].widht`.
///
/// Answers may gain fields, so the types that requests share with answers ignore unknown ones. `understood`
/// is the parsed request written as JSON again: a field that is missing there was ignored.
pub fn unknown_field(sent: &Value, understood: &Value) -> Option<String> {
    match (sent, understood) {
        (Value::Object(sent), Value::Object(understood)) => {
            sent.iter().find_map(|(name, value)| match understood.get(name) {
                Some(same) => unknown_field(value, same).map(|path| join(name, &path)),
                // An option that is `null` is left out when it is written again.
                None if value.is_null() => None,
                None => Some(name.clone()),
            })
        }
        (Value::Array(sent), Value::Array(understood)) => {
            sent.iter().zip(understood).enumerate().find_map(|(index, (value, same))| {
                unknown_field(value, same).map(|path| join(&format!("[{index}]"), &path))
            })
        }
        _ => None,
    }
}

fn join(outer: &str, inner: &str) -> String {
    let dot = if inner.starts_with('[') { "" } else { "." };
    format!("{outer}{dot}{inner}")
}

/// Decided by the fields that are present. Serde's own `untagged` tries one variant after the other, and
/// cannot say what was wrong with each.
impl<'de> Deserialize<'de> for Start {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Either {
            pose: Option<Pose>,
            trajectory: Option<String>,
            station_m: Option<f64>,
        }
        let Either { pose, trajectory, station_m } = Either::deserialize(deserializer)?;
        match (pose, trajectory, station_m) {
            (Some(pose), None, None) => Ok(Self::Pose { pose }),
            (None, Some(trajectory), station_m) => {
                Ok(Self::Station { trajectory, station_m: station_m.unwrap_or_default() })
            }
            _ => Err(D::Error::custom("a start has either pose, or trajectory and station_m")),
        }
    }
}

/// Decided by the fields that are present.
impl<'de> Deserialize<'de> for BranchPoint {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Either {
            session: Option<String>,
            snapshot: Option<String>,
            episode: Option<String>,
            step: Option<u64>,
        }
        let Either { session, snapshot, episode, step } = Either::deserialize(deserializer)?;
        match (session, snapshot, episode, step) {
            (Some(session), Some(snapshot), None, None) => Ok(Self::Snapshot { session, snapshot }),
            (None, None, Some(episode), Some(step)) => Ok(Self::Recorded { episode, step }),
            _ => Err(D::Error::custom(
                "a branch is from either session and snapshot, or episode and step",
            )),
        }
    }
}

/// A string is a name; an object is the scenario if it has a format, and else a name with values.
impl<'de> Deserialize<'de> for ScenarioChoice {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Values {
            name: String,
            #[serde(default)]
            values: serde_json::Map<String, serde_json::Value>,
        }
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
                let map = serde_json::Map::deserialize(MapAccessDeserializer::new(map))?;
                if map.contains_key("format") {
                    return Ok(ScenarioChoice::Inline(map));
                }
                let Values { name, values } =
                    serde_json::from_value(map.into()).map_err(A::Error::custom)?;
                Ok(ScenarioChoice::Values { name, values })
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
