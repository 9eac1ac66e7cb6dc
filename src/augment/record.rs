//! augment.json: the settings of a data set, and its samples.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use wildcity_scene::geometry::Pose;

use crate::limits::WEIGHT;

pub(crate) const FORMAT: &str = "wildcity.augment/1";

/// Meaning of each folder and number, by its name.
pub(crate) const CONVENTIONS: [(&str, &str); 7] = [
    ("images", "PNG, 8-bit sRGB; repaired if `made_with.repair` is there, else as rendered"),
    ("rendered", "PNG, the images before the repair; there only if `made_with.repair` is"),
    (
        "masks",
        "PNG, 255 where the opacity is at least 1/2 and within the lens' field, else 0; there is no overlay",
    ),
    (
        "depth",
        "PNG, 16 bits, millimetres up to 65 m, 0 for none: camera z, of fisheye lenses the distance; as rendered, not \
         repaired",
    ),
    (
        "world_from_camera",
        "metres, axes of the twin; camera x right, y down, z forward; q is w, x, y, z",
    ),
    ("weight", "0.3 x trust: factor of the image's loss against 1 of a recorded image"),
    ("files", "SHA-256 of each file of the sample, by its path"),
];

/// Settings of a data set. A folder is continued only with the same settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MadeWith {
    /// Name of the twin.
    pub twin: String,
    /// Hash of its version.
    pub version_hash: String,
    pub backend: String,
    /// The model; `None` for views as rendered.
    pub repair: Option<RepairedWith>,
    /// The plan and the form.
    pub options: Options,
}

/// The repair of a data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RepairedWith {
    /// Name of the model.
    pub model: String,
    pub version: String,
    /// Hash of manifest, files, runtime and provider.
    pub repair_hash: String,
    /// `cpu`, `cuda` or `tensorrt`.
    pub provider: String,
    /// Under this trust images are left as rendered.
    pub at_least: f64,
    /// `recorded` or `rendered`: images that the model compares with, if it needs any.
    pub references: Option<String>,
}

/// Options of the command.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Options {
    pub round: u32,
    /// Wanted offsets, in metres.
    pub wanted_offsets_m: Vec<f64>,
    /// Distance of two stations, in metres.
    pub every_m: f64,
    /// Names of the cameras, in the order of the rig.
    pub cameras: Vec<String>,
    /// Longest side of an image, in pixels; `None` for the rig's sizes.
    pub side_px: Option<u32>,
    /// Whether the lenses of the rig are kept.
    pub lenses: bool,
    /// Largest number of points of the COLMAP model, and the seed of their choice.
    pub points: u32,
    pub seed: u64,
    /// Form of the COLMAP model: `txt` or `bin`.
    pub colmap: String,
}

/// augment.json without its samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// Settings of the samples.
    pub made_with: MadeWith,
    /// Number of the twin's version. An equal version may have another number after a rollback.
    pub version: u64,
    /// Offsets of this round, in metres, positive to the left of the drive.
    pub offsets_m: Vec<f64>,
    /// From the axes of the twin's capture to those of the twin, as eight numbers of
    /// `wildcity twin align`; `None` if it is unknown.
    pub world_from_capture: Option<String>,
}

/// An image of the data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// Its path below `images/`, `rendered/`, `masks/` and `depth/`.
    pub name: String,
    pub trajectory: String,
    /// Along the drive, in metres.
    pub station_m: f64,
    /// To the left of the drive, in metres.
    pub offset_m: f64,
    pub camera: String,
    /// Pose of the camera in the twin's axes.
    pub world_from_camera: Pose,
    /// Trust of the image, 0 to 1.
    pub trust: f64,
    /// Factor of the image's loss in a training, as [`weight`] gives it.
    pub weight: f64,
    /// Share of the pixels that count.
    pub counted: f64,
    /// Result of the repair; `None` without a model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub repair: Option<SampleRepair>,
    /// SHA-256 of its files, by their path.
    pub files: BTreeMap<String, String>,
}

/// Result of a model for an image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SampleRepair {
    /// `repaired`, or `kept` where the trust is too low.
    pub status: String,
    /// Names of the recorded images that the model got.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub references: Vec<String>,
}

/// The encoded files of a sample, each a PNG.
#[derive(Clone, Debug, Default)]
pub struct SampleFiles {
    pub image: Vec<u8>,
    /// Before the repair; `None` without a model.
    pub rendered: Option<Vec<u8>>,
    /// 255 where pixels count.
    pub mask: Vec<u8>,
    /// Distance along the camera's axis in millimetres, 16 bits a pixel.
    pub depth: Vec<u8>,
}

impl SampleFiles {
    /// The files with their paths.
    pub(crate) fn named(&self, name: &str) -> Vec<(String, &[u8])> {
        let rendered = self.rendered.as_deref();
        let files = [
            ("images", Some(&*self.image)),
            ("rendered", rendered),
            ("masks", Some(&*self.mask)),
            ("depth", Some(&*self.depth)),
        ];
        let named = files.into_iter().filter_map(|(folder, bytes)| Some((folder, bytes?)));
        named.map(|(folder, bytes)| (format!("{folder}/{name}"), bytes)).collect()
    }
}

/// The factor of an image's loss: 0.3 x trust. A recorded image has 1.
pub fn weight(trust: f64) -> f64 {
    WEIGHT * trust
}

/// The first field that differs, with both values as JSON: `options.every_m`, 2.0, 4.0.
pub(crate) fn difference(there: &MadeWith, here: &MadeWith) -> Option<[String; 3]> {
    let json = |made: &MadeWith| serde_json::to_value(made).unwrap_or_default();
    leaf("", &json(there), &json(here))
}

fn leaf(path: &str, there: &Value, here: &Value) -> Option<[String; 3]> {
    match (there, here) {
        // Objects with other fields differ as a whole: a model against none.
        (Value::Object(a), Value::Object(b)) if a.keys().eq(b.keys()) => {
            a.iter().find_map(|(key, value)| {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                leaf(&path, value, &b[key])
            })
        }
        // If only one of the two has a model, its name is enough.
        _ if there != here => Some([path.to_owned(), short(there), short(here)]),
        _ => None,
    }
}

fn short(value: &Value) -> String {
    match value {
        Value::Null => "none".to_owned(),
        // A repair is named by its model.
        Value::Object(fields) => fields.get("model").unwrap_or(value).to_string(),
        other => other.to_string(),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn header() -> Header {
        let options = Options {
            round: 1,
            wanted_offsets_m: vec![1.0],
            every_m: 2.0,
            cameras: vec!["front".to_owned()],
            side_px: None,
            lenses: false,
            points: 10,
            seed: 1,
            colmap: "txt".to_owned(),
        };
        let made_with = MadeWith {
            twin: "street".to_owned(),
            version_hash: "ab".repeat(32),
            backend: "cpu".to_owned(),
            repair: None,
            options,
        };
        let offsets_m = vec![0.5, -0.5];
        Header { made_with, version: 1, offsets_m, world_from_capture: None }
    }

    pub(crate) fn model() -> RepairedWith {
        RepairedWith {
            model: "net".to_owned(),
            version: "1".to_owned(),
            repair_hash: "cd".repeat(32),
            provider: "cpu".to_owned(),
            at_least: 0.1,
            references: Some("recorded".to_owned()),
        }
    }

    #[test]
    fn what_differs_is_named_with_both_values() {
        let there = header().made_with;
        assert_eq!(difference(&there, &there), None);
        let mut here = there.clone();
        here.options.every_m = 4.0;
        let named = |a: &MadeWith, b: &MadeWith| difference(a, b).unwrap().join("|");
        assert_eq!(named(&there, &here), "options.every_m|2.0|4.0");
        here = there.clone();
        here.repair = Some(model());
        assert_eq!(named(&there, &here), "repair|none|\"net\"");
        let mut other = here.clone();
        other.repair.as_mut().unwrap().repair_hash = "ef".to_owned();
        assert!(named(&here, &other).starts_with("repair.repair_hash|\"cdcd"));
    }
}
