//! The render profile: constants of the image formation that a twin's trainer used and that every
//! backend must reproduce.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// How a Gaussian is evaluated at a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rays {
    /// Each Gaussian is projected once, to a 2D ellipse (a splat). All backends.
    #[default]
    Splats,
    /// Each pixel's ray is evaluated against the 3D Gaussian at its point of closest approach. This
    /// defines the correct image and is slow; only the reference backend supports it. Lenses,
    /// windshields and shutters are tested against it.
    Exact,
}

/// How an image is drawn whose sides are at most 0.45 of those of the camera's native image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Shrink {
    /// Each pixel is the mean of 2 x 2 samples: 8 to 14 dB nearer to the native image shrunk.
    #[default]
    Samples,
    /// Each pixel is one sample, with splats as wide as the pixel.
    Filter,
}

impl Shrink {
    fn is_samples(&self) -> bool {
        *self == Self::Samples
    }
}

fn is_default_lens_error(lens_error_px: &f64) -> bool {
    *lens_error_px == RenderProfile::DEFAULT.lens_error_px
}

impl Rays {
    fn is_splats(&self) -> bool {
        *self == Self::Splats
    }
}

/// Constants of the image formation that differ between trainers (gsplat, INRIA, brush, ...).
///
/// The defaults are those of gsplat 1.6 in its "classic" mode. The fields follow the rendering
/// semantics of gsplat and of the reference code of Kerbl et al. 2023.
///
/// ```
/// use wildcity_scene::RenderProfile;
///
/// let mut profile = RenderProfile::default();
/// profile.set("near=0.2")?;
/// assert_eq!(profile.near, 0.2);
/// assert!(profile.set("alpha_cap=1").is_err());
/// # Ok::<(), wildcity_scene::profile::ProfileError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderProfile {
    /// A Gaussian is culled if the camera-space z of its mean is below this, in metres. INRIA: 0.2.
    pub near: f64,
    /// A Gaussian is culled if the camera-space z of its mean is above this, in metres.
    pub far: f64,
    /// Variance added to both axes of the screen covariance, in px². Mip-splatting: 0.1.
    pub blur: f64,
    /// Whether opacity is scaled by `sqrt(max(0.005², det before blur / det after))`.
    pub antialiased: bool,
    /// Largest alpha of one Gaussian at one pixel. gsplat before 2026-02 and brush: 0.999.
    pub alpha_cap: f64,
    /// Smallest alpha that is blended; with a smaller one a Gaussian does not contribute to the
    /// pixel.
    pub alpha_cut: f64,
    /// Blending of a pixel stops before the Gaussian that would reduce the transmittance to this
    /// value or below; that Gaussian is not blended.
    pub stop: f64,
    /// Largest error of a level of detail on the screen, in pixels: each block of 16 m is drawn at
    /// the coarsest level whose error stays below it. 0 draws full detail everywhere.
    pub tau_px: f64,
    /// Blocks farther than this from the camera are not drawn, in metres. `None` draws all.
    pub reach_m: Option<f64>,
    /// How Gaussians are evaluated. Serialized only if it is not the default.
    #[serde(skip_serializing_if = "Rays::is_splats")]
    pub rays: Rays,
    /// How images of at most 0.45 of their native sides are drawn. Larger images do not depend on
    /// it. Serialized only if it is not the default.
    #[serde(skip_serializing_if = "Shrink::is_samples")]
    pub shrink: Shrink,
    /// Largest difference between the expansion of a lens or a rolling shutter around the centre of
    /// a Gaussian, and the six points that define its splat, in pixels. Gaussians with a larger one
    /// are projected by six points; with 0 all are. Pinholes at rest have neither. Serialized only
    /// if it is not the default.
    #[serde(skip_serializing_if = "is_default_lens_error")]
    pub lens_error_px: f64,
    /// Largest error of a baked sky in any direction, as a colour from 0 to 1; 0 evaluates the sky
    /// network for every pixel. At 0.025 the edge of a cloud may be wrong by six steps of 8 bits,
    /// but 99 of 100 directions of the demo's sky are wrong by less than one step. Ignored by twins
    /// without a sky.
    pub sky_error: f64,
    /// Background colour of twins without a sky: linear red, green, blue.
    pub background: [f64; 3],
}

impl Default for RenderProfile {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// Values for some fields of a profile, by field name. JSON: `{"tau_px": 2.0}`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ProfileOverrides(Map<String, Value>);

/// Why a profile was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ProfileError {
    /// A field is outside the range that the render stages support.
    #[error("profile field {field} is {value:?}; {must}")]
    Value {
        field: &'static str,
        value: f64,
        /// The values that are accepted.
        must: &'static str,
    },
    /// An override has an unknown field or a value of the wrong type.
    #[error("cannot read profile field {field}: {reason}; the fields are {}", RenderProfile::KEYS.join(", "))]
    Change {
        field: String,
        /// Why it was refused.
        reason: String,
    },
    /// `key=value` did not parse.
    #[error("cannot read profile setting {setting:?}: {reason}; the keys are {}", RenderProfile::KEYS.join(", "))]
    Setting {
        setting: String,
        /// Why it was refused.
        reason: String,
    },
}

impl RenderProfile {
    /// The constants of gsplat 1.6 in its classic mode.
    pub const DEFAULT: Self = Self {
        near: 0.01,
        far: 1e10,
        blur: 0.3,
        antialiased: false,
        alpha_cap: 0.99,
        alpha_cut: 1.0 / 255.0,
        stop: 1e-4,
        tau_px: 1.0,
        reach_m: None,
        rays: Rays::Splats,
        shrink: Shrink::Samples,
        lens_error_px: 0.0,
        sky_error: 0.025,
        background: [0.0; 3],
    };

    /// Names of the fields in `--profile` and in manifests.
    pub const KEYS: [&'static str; 14] = [
        "near",
        "far",
        "blur",
        "antialiased",
        "alpha_cap",
        "alpha_cut",
        "stop",
        "tau_px",
        "reach_m",
        "rays",
        "shrink",
        "lens_error_px",
        "sky_error",
        "background",
    ];

    /// Checks that every field is in range. The ranges keep the f32 arithmetic of all stages
    /// finite.
    ///
    /// # Errors
    /// [`ProfileError::Value`] names the first field out of range.
    pub fn check(&self) -> Result<(), ProfileError> {
        // One row for each field: name, value for the message, whether it is in range, and the
        // range in words. All rows are computed, which is cheap; the first wrong one is reported.
        let checks = [
            ("near", self.near, (1e-4..=1e3).contains(&self.near), "near is from 1e-4 to 1e3 m"),
            (
                "far",
                self.far,
                self.far > self.near && self.far <= 1e12,
                "far is beyond near, up to 1e12 m",
            ),
            ("blur", self.blur, (1e-3..=1e2).contains(&self.blur), "blur is from 1e-3 to 1e2 px²"),
            (
                "alpha_cap",
                self.alpha_cap,
                (0.5..=0.9999).contains(&self.alpha_cap),
                "alpha_cap is from 0.5 to 0.9999",
            ),
            (
                "alpha_cut",
                self.alpha_cut,
                (1e-5..=0.1).contains(&self.alpha_cut),
                "alpha_cut is from 1e-5 to 0.1",
            ),
            ("stop", self.stop, (1e-8..=0.1).contains(&self.stop), "stop is from 1e-8 to 0.1"),
            (
                "tau_px",
                self.tau_px,
                (0.0..=1e3).contains(&self.tau_px),
                "tau_px is from 0 (full detail) to 1000 px",
            ),
            (
                "reach_m",
                // The value is only for the message; an absent reach passes the next line.
                self.reach_m.unwrap_or(f64::INFINITY),
                self.reach_m.is_none_or(|reach_m| (0.0..=1e9).contains(&reach_m)),
                "reach_m is from 0 to 1e9 m, or none",
            ),
            (
                "lens_error_px",
                self.lens_error_px,
                (0.0..=1.0).contains(&self.lens_error_px),
                "lens_error_px is from 0 (always six points) to 1 px",
            ),
            (
                "sky_error",
                self.sky_error,
                self.sky_error == 0.0 || (1e-4..=1.0).contains(&self.sky_error),
                "sky_error is 0 (exact) or from 1e-4 to 1",
            ),
            (
                "background",
                // The first colour out of range, for the message.
                self.background.into_iter().find(|c| !(0.0..=1.0).contains(c)).unwrap_or(0.0),
                self.background.iter().all(|c| (0.0..=1.0).contains(c)),
                "each of its colours is from 0 to 1",
            ),
        ];
        match checks.into_iter().find(|(_, _, in_range, _)| !in_range) {
            Some((field, value, _, must)) => Err(ProfileError::Value { field, value, must }),
            None => Ok(()),
        }
    }

    /// Sets one field from `key=value`, as given on the command line.
    ///
    /// # Errors
    /// The key is unknown, the value does not parse, or the result is out of range.
    pub fn set(&mut self, setting: &str) -> Result<(), ProfileError> {
        let bad = |reason: String| ProfileError::Setting { setting: setting.to_owned(), reason };
        let (key, value) =
            setting.split_once('=').ok_or_else(|| bad("expected key=value".into()))?;
        let number = || value.parse::<f64>().map_err(|e| bad(e.to_string()));
        match key {
            "near" => self.near = number()?,
            "far" => self.far = number()?,
            "blur" => self.blur = number()?,
            "antialiased" => {
                self.antialiased =
                    // `parse` accepts exactly `true` and `false`, as JSON does.
                    value.parse().map_err(|_| bad("expected true or false".into()))?;
            }
            "alpha_cap" => self.alpha_cap = number()?,
            "alpha_cut" => self.alpha_cut = number()?,
            "stop" => self.stop = number()?,
            "tau_px" => self.tau_px = number()?,
            "reach_m" if value == "none" => self.reach_m = None,
            "reach_m" => self.reach_m = Some(number()?),
            "rays" if value == "splats" => self.rays = Rays::Splats,
            "rays" if value == "exact" => self.rays = Rays::Exact,
            "rays" => return Err(bad("expected splats or exact".into())),
            "shrink" if value == "samples" => self.shrink = Shrink::Samples,
            "shrink" if value == "filter" => self.shrink = Shrink::Filter,
            "shrink" => return Err(bad("expected samples or filter".into())),
            "lens_error_px" => self.lens_error_px = number()?,
            "sky_error" => self.sky_error = number()?,
            "background" => {
                // Three numbers exactly: fewer or more fail the conversion to an array.
                let colours: Result<Vec<f64>, _> = value.split(',').map(str::parse).collect();
                self.background = colours
                    .ok()
                    .and_then(|colours| colours.try_into().ok())
                    .ok_or_else(|| bad("expected red,green,blue as 0.5,0.6,0.8".into()))?;
            }
            _ => return Err(bad(format!("there is no field {key:?}"))),
        }
        // A setting that makes the profile inconsistent is refused although it is in range alone.
        self.check()
    }
}

impl ProfileOverrides {
    /// The values by field name.
    pub fn into_fields(self) -> Map<String, Value> {
        self.0
    }

    /// Overrides from a JSON object. They are checked by [`ProfileOverrides::apply`].
    pub fn new(fields: Map<String, Value>) -> Self {
        Self(fields)
    }

    /// `profile` with these values in place of its own.
    ///
    /// # Errors
    /// Names the field that does not exist, does not parse, or is out of range.
    pub fn apply(&self, profile: RenderProfile) -> Result<RenderProfile, ProfileError> {
        let mut changed = profile;
        // Through JSON, because the names and types of fields are those of serde: an override needs
        // no second list of them.
        for (field, value) in &self.0 {
            let bad = |reason: String| ProfileError::Change { field: field.clone(), reason };
            let whole = serde_json::to_value(changed).map_err(|e| bad(e.to_string()))?;
            let Value::Object(mut fields) = whole else {
                return Err(bad("the profile is no object".to_owned()));
            };
            let was = fields.insert(field.clone(), value.clone());
            let whole = serde_json::from_value(Value::Object(fields));
            // The value that was there tells which type the field has.
            changed = whole.map_err(|_| {
                bad(match was {
                    _ if !RenderProfile::KEYS.contains(&field.as_str()) => {
                        "there is no such field".to_owned()
                    }
                    Some(Value::Bool(_)) => format!("{value} is not true or false"),
                    _ => format!("{value} is not a number"),
                })
            })?;
        }
        // Once, after all: two overrides may be valid only together, such as near and far.
        changed.check()?;
        Ok(changed)
    }

    /// These overrides, and those of `others` for fields that these do not set.
    pub fn or(&self, others: &Self) -> Self {
        let mut fields = others.0.clone();
        // `extend` overwrites, so that these win.
        fields.extend(self.0.clone());
        Self(fields)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overrides_name_fields_and_are_checked() {
        let changes = |json: &str| serde_json::from_str::<ProfileOverrides>(json).unwrap();
        let own = RenderProfile { near: 0.2, ..Default::default() };
        let both = changes(r#"{"tau_px": 2}"#).or(&changes(r#"{"tau_px": 4, "reach_m": 90.0}"#));
        let changed = both.apply(own).unwrap();
        assert_eq!(changed, RenderProfile { tau_px: 2.0, reach_m: Some(90.0), ..own });
        assert_eq!(changes(r#"{"reach_m": null}"#).apply(changed).unwrap().reach_m, None);
        for (bad, named) in [
            (r#"{"fov": 1}"#, "fov"),
            (r#"{"tau_px": "2"}"#, "tau_px"),
            (r#"{"tau_px": -1}"#, "tau_px"),
            (r#"{"near": 5.0, "far": 4.0}"#, "far"),
        ] {
            let said = changes(bad).apply(own).unwrap_err().to_string();
            assert!(said.contains(named), "{bad}: {said}");
        }
    }

    #[test]
    fn settings_change_one_field_and_are_checked() {
        let mut profile = RenderProfile::default();
        profile.set("near=0.2").unwrap();
        profile.set("antialiased=true").unwrap();
        assert_eq!(profile, RenderProfile { near: 0.2, antialiased: true, ..Default::default() });
        for bad in [
            "near",
            "near=x",
            "nearr=1",
            "alpha_cap=1",
            "blur=-1",
            "far=0.1",
            "near=NaN",
            "tau_px=-1",
            "reach_m=far",
            "rays=some",
            "shrink=some",
            "sky_error=1e-9",
            "lens_error_px=-1",
            "background=1,1",
            "background=1,1,2",
        ] {
            assert!(profile.clone().set(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn keys_lists_every_field() {
        // Fields that are written only if they are not the default.
        let other = RenderProfile {
            rays: Rays::Exact,
            shrink: Shrink::Filter,
            lens_error_px: 0.25,
            ..Default::default()
        };
        let json = serde_json::to_value(other).unwrap();
        let mut fields: Vec<_> = json.as_object().unwrap().keys().map(String::as_str).collect();
        let mut keys = RenderProfile::KEYS.to_vec();
        fields.sort_unstable();
        keys.sort_unstable();
        assert_eq!(fields, keys);
    }
}
