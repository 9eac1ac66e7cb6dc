//! The render profile: how the twin's trainer rendered, which every backend must repeat.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// How a Gaussian becomes pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rays {
    /// It is projected once, as an ellipse.
    #[default]
    Splats,
    /// Every pixel's own ray meets it: by definition, and as slow. The reference backend alone does.
    Exact,
}

impl Rays {
    fn is_splats(&self) -> bool {
        *self == Self::Splats
    }
}

/// Constants of the image formation that differ between trainers (gsplat, INRIA, brush, ...).
///
/// The defaults are gsplat 1.6's "classic" mode. Sources per field: rendering semantics of gsplat
/// and of Kerbl et al. 2023's reference code.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderProfile {
    /// Nearest camera-space z of a centre that is drawn, in metres. INRIA: 0.2.
    pub near: f64,
    /// Farthest camera-space z of a centre that is drawn, in metres.
    pub far: f64,
    /// Variance added to both axes of the screen covariance, in px². Mip-splatting: 0.1.
    pub blur: f64,
    /// Whether opacity is scaled by `sqrt(max(0.005², det before blur / det after))`.
    pub antialiased: bool,
    /// Largest alpha of one Gaussian at one pixel. gsplat before 2026-02 and brush: 0.999.
    pub alpha_cap: f64,
    /// Smallest alpha that is blended; below it a Gaussian does not touch the pixel.
    pub alpha_cut: f64,
    /// A Gaussian that would bring the transmittance to this or below ends its pixel, unblended.
    pub stop: f64,
    /// Largest error of a level of detail on the screen, in pixels: a block of 16 m is drawn at the
    /// coarsest level that keeps below it. 0 is full detail everywhere.
    pub tau_px: f64,
    /// Distance from the nearest camera beyond which a block is not drawn, in metres; none, and
    /// everything is.
    pub reach_m: Option<f64>,
    /// How Gaussians become pixels. Not written unless it is said.
    #[serde(skip_serializing_if = "Rays::is_splats")]
    pub rays: Rays,
    /// Largest error of a baked sky anywhere, in colour from 0 to 1; 0 evaluates the sky for every pixel.
    /// At 0.025 the edge of a cloud may be off by six steps of 8 bits, and 99 of 100 directions of the
    /// demo's sky are by less than one. No matter to twins without a sky.
    pub sky_error: f64,
    /// What is behind everything in twins without a sky: linear red, green, blue.
    pub background: [f64; 3],
}

impl Default for RenderProfile {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// Fields of a profile that somebody wants otherwise, by their names: JSON as `{"tau_px": 2.0}`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ProfileOverrides(Map<String, Value>);

/// Why a profile was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ProfileError {
    /// A field is outside what the stages can compute with.
    #[error("profile field {field} is {value:?}; {must}")]
    Value {
        /// The field.
        field: &'static str,
        /// The refused value.
        value: f64,
        /// What must hold instead.
        must: &'static str,
    },
    /// Changes are not what they should be.
    #[error("cannot read profile field {field}: {reason}; the fields are {}", RenderProfile::KEYS.join(", "))]
    Change {
        /// The field.
        field: String,
        /// What is wrong with it.
        reason: String,
    },
    /// `key=value` did not parse.
    #[error("cannot read profile setting {setting:?}: {reason}; the keys are {}", RenderProfile::KEYS.join(", "))]
    Setting {
        /// The text given.
        setting: String,
        /// What is wrong with it.
        reason: String,
    },
}

impl RenderProfile {
    /// As gsplat 1.6 renders in its classic mode.
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
        sky_error: 0.025,
        background: [0.0; 3],
    };

    /// Names of the fields, as `--profile` and manifests spell them.
    pub const KEYS: [&'static str; 12] = [
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
        "sky_error",
        "background",
    ];

    /// # Errors
    /// Names the first field out of range. The bounds keep every stage's f32 arithmetic finite.
    pub fn check(&self) -> Result<(), ProfileError> {
        let holds = [
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
                self.reach_m.unwrap_or(f64::INFINITY),
                self.reach_m.is_none_or(|reach_m| (0.0..=1e9).contains(&reach_m)),
                "reach_m is from 0 to 1e9 m, or none",
            ),
            (
                "sky_error",
                self.sky_error,
                self.sky_error == 0.0 || (1e-4..=1.0).contains(&self.sky_error),
                "sky_error is 0 (exact) or from 1e-4 to 1",
            ),
            (
                "background",
                self.background.into_iter().find(|c| !(0.0..=1.0).contains(c)).unwrap_or(0.0),
                self.background.iter().all(|c| (0.0..=1.0).contains(c)),
                "each of its colours is from 0 to 1",
            ),
        ];
        match holds.into_iter().find(|(_, _, holds, _)| !holds) {
            Some((field, value, _, must)) => Err(ProfileError::Value { field, value, must }),
            None => Ok(()),
        }
    }

    /// Applies one `key=value` of the command line.
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
            "sky_error" => self.sky_error = number()?,
            "background" => {
                let colours: Result<Vec<f64>, _> = value.split(',').map(str::parse).collect();
                self.background = colours
                    .ok()
                    .and_then(|colours| colours.try_into().ok())
                    .ok_or_else(|| bad("expected red,green,blue as 0.5,0.6,0.8".into()))?;
            }
            _ => return Err(bad(format!("there is no field {key:?}"))),
        }
        self.check()
    }
}

impl ProfileOverrides {
    /// What a JSON object says, which need not fit a profile yet.
    pub fn new(fields: Map<String, Value>) -> Self {
        Self(fields)
    }

    /// A profile with the changes.
    ///
    /// # Errors
    /// Names the field that does not exist, does not parse, or is out of range.
    pub fn apply(&self, profile: RenderProfile) -> Result<RenderProfile, ProfileError> {
        let mut changed = profile;
        for (field, value) in &self.0 {
            let bad = |reason: String| ProfileError::Change { field: field.clone(), reason };
            let whole = serde_json::to_value(changed).map_err(|e| bad(e.to_string()))?;
            let Value::Object(mut fields) = whole else {
                return Err(bad("the profile is no object".to_owned()));
            };
            fields.insert(field.clone(), value.clone());
            let whole = serde_json::from_value(Value::Object(fields));
            changed = whole.map_err(|e| bad(e.to_string()))?;
        }
        changed.check()?;
        Ok(changed)
    }

    /// These, and what else others want.
    pub fn or(&self, others: &Self) -> Self {
        let mut fields = others.0.clone();
        fields.extend(self.0.clone());
        Self(fields)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_of_named_fields_and_are_checked() {
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
            "sky_error=1e-9",
            "background=1,1",
            "background=1,1,2",
        ] {
            assert!(profile.clone().set(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn the_keys_are_the_fields() {
        let json = serde_json::to_value(RenderProfile { rays: Rays::Exact, ..Default::default() });
        let json = json.unwrap();
        let mut fields: Vec<_> = json.as_object().unwrap().keys().map(String::as_str).collect();
        let mut keys = RenderProfile::KEYS.to_vec();
        fields.sort_unstable();
        keys.sort_unstable();
        assert_eq!(fields, keys);
    }
}
