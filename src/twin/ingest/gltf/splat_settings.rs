//! How the splats of a primitive are to be drawn, as KHR_gaussian_splatting says.

use serde_json::Value;

use crate::ingest::notes::Reading;

use super::document::Primitive;
use super::{EXTENSION, SPZ};

/// Keys with the values that are drawn. A key that is absent has the first value.
const DRAWN: [(&str, &[&str]); 4] = [
    ("kernel", &["ellipse"]),
    ("colorSpace", &["srgb_rec709_display"]),
    ("projection", &["perspective"]),
    // Splats are sorted by depth along the camera's axis; the two orders differ only for splats
    // that overlap off the axis, and the extension leaves sorting to the renderer.
    ("sortingMethod", &["cameraDistance", "zDepth"]),
];

/// Warns of settings that are drawn in another way, and of keys that are not read. They are no
/// errors, because the extension lets renderers fall back.
pub(super) fn check(primitive: &Primitive, reading: &mut Reading) {
    let settings = primitive.extensions.get(EXTENSION).and_then(Value::as_object);
    for (key, value) in settings.into_iter().flatten() {
        let drawn = DRAWN.iter().find(|(known, _)| known == key).map(|(_, values)| *values);
        match (drawn, value) {
            (Some(values), Value::String(text)) if values.contains(&text.as_str()) => {}
            (Some(_), Value::String(text)) if text == "lin_rec709_display" => {
                reading.warn(format!(
                    "{key} is {value}: its linear colours are drawn as if they were sRGB, so that the scene is too dark; \
                     export it as srgb_rec709_display"
                ));
            }
            (Some(values), value) => {
                reading.warn(format!("{key} is {value}; it is drawn as {}", values[0]));
            }
            (None, Value::Object(inner)) if key == "extensions" => {
                let names = inner.keys().map(String::as_str);
                let skipped: Vec<&str> =
                    names.filter(|name| *name != SPZ && !name.contains("compression")).collect();
                if !skipped.is_empty() {
                    reading.warn_skipped(&format!("extensions of {EXTENSION}"), &skipped);
                }
            }
            (None, _) if key == "extras" => {}
            (None, _) => reading.warn(format!("{EXTENSION}.{key} is not read")),
        }
    }
}
