//! Reading requests so that a mistake can be named: fields that are one of two things, and fields
//! that do not exist.

use std::fmt;

use serde::de::{Error, IntoDeserializer, MapAccess, Visitor, value::MapAccessDeserializer};
use serde::{Deserialize, Deserializer};
use serde_json::Value;

use super::message::{Dynamics, DynamicsChoice, DynamicsModel, Pose, Rig, RigChoice, Start};

/// The first field of a request that was sent and not understood, as `rig.cameras[2].widht`.
///
/// Answers may gain fields, so the types that requests share with them let unknown ones pass; what
/// was understood, written as JSON again, tells which those were.
pub fn unknown_field(sent: &Value, understood: &Value) -> Option<String> {
    match (sent, understood) {
        (Value::Object(sent), Value::Object(understood)) => {
            sent.iter().find_map(|(name, value)| match understood.get(name) {
                Some(same) => unknown_field(value, same).map(|path| join(name, &path)),
                // Left out is what a missing option is when it is written.
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

/// By its fields rather than by trying one variant after the other, which would forget what was
/// wrong with each.
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

/// A text is the name of a preset, an object is a rig.
impl<'de> Deserialize<'de> for RigChoice {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = RigChoice;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the name of a preset, or a rig written out")
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

/// A text is the name of a model, an object has all of it.
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
