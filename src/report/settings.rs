//! The settings that are compared, one changed at a time, and those that a profile can be made of.

use serde::Serialize;

use wildcity_render::View;
use wildcity_scene::geometry::CameraError;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::sky::{Sky, SkyModel};
use wildcity_scene::{Manifest, Rays, RecordFormat, RenderProfile};

/// One way to draw a twin.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Setting {
    /// As `tau_px=2`, unique within a report.
    pub name: String,
    /// What it is a step of.
    pub family: Family,
    /// Index of the backend among those of the report.
    pub backend: usize,
    /// What Gaussians are stored in; as they are, if absent.
    pub record: Option<RecordFormat>,
    /// Changes of the twin's own render profile, `key=value`.
    pub profile: Vec<String>,
    /// Sides of the images, as a share of the cameras'.
    pub scale: f64,
    /// How images are sent; if absent, values are compared before they are rounded to 8 bits, and no
    /// encoding is timed.
    pub sent: Option<Sent>,
    /// What it is compared with: all but those of [`Family::Rays`] with splats, as they are.
    pub against: Rays,
}

/// What a ladder is of: what decides which settings can be felt.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TwinFeatures {
    /// How the twin is drawn.
    pub profile: RenderProfile,
    /// How it is stored.
    pub stored: RecordFormat,
    /// Whether it has levels of detail.
    pub levels: bool,
    /// What is behind it.
    pub behind: BackgroundKind,
    /// Whether some camera has a lens, a windshield or a rolling shutter while it moves.
    pub bent: bool,
}

/// What is behind a twin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BackgroundKind {
    /// Nothing, or a background of one colour.
    Nothing,
    /// A network, which is evaluated or baked.
    Network,
    /// Images, which are their own map.
    Images,
}

/// Settings to compare, and what is not among them.
#[derive(Clone, Debug, PartialEq)]
pub struct SettingList {
    /// The twin as it is served first; names are unique.
    pub settings: Vec<Setting>,
    /// What this twin, or this build, cannot feel.
    pub skipped: Vec<Skipped>,
}

/// What is not compared.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Skipped {
    /// The setting or family.
    pub what: String,
    /// Why.
    pub why: String,
}

impl Skipped {
    /// Something that is not compared, and why.
    pub fn new(what: impl Into<String>, why: impl Into<String>) -> Self {
        Self { what: what.into(), why: why.into() }
    }
}

/// How an image is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Sent {
    /// In 8 bits.
    Raw,
    /// As a JPEG of a quality.
    Jpeg(u8),
}

/// What a setting is a step of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// The twin as it is served.
    AsServed,
    /// Who renders.
    Backend,
    /// Levels of detail.
    Detail,
    /// How far blocks are drawn.
    Reach,
    /// How Gaussians are stored.
    Record,
    /// What a small splat's opacity is.
    Antialiasing,
    /// The smallest alpha that is blended.
    AlphaCut,
    /// Where a pixel ends.
    Stop,
    /// How exactly a sky is looked up.
    Sky,
    /// Splats of bent cameras, against every pixel's own ray.
    Rays,
    /// The size of the images.
    Scale,
    /// How images are sent.
    Sent,
    /// Several at once: what a profile may be made of.
    Combined,
}

impl Family {
    /// All of them, in the order of the report.
    pub const ALL: [Self; 13] = [
        Self::AsServed,
        Self::Backend,
        Self::Detail,
        Self::Reach,
        Self::Record,
        Self::Antialiasing,
        Self::AlphaCut,
        Self::Stop,
        Self::Sky,
        Self::Rays,
        Self::Scale,
        Self::Sent,
        Self::Combined,
    ];

    /// What people call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::AsServed => "as served",
            Self::Backend => "backend",
            Self::Detail => "levels of detail",
            Self::Reach => "reach",
            Self::Record => "record",
            Self::Antialiasing => "antialiasing",
            Self::AlphaCut => "alpha cut",
            Self::Stop => "stop",
            Self::Sky => "sky",
            Self::Rays => "rays",
            Self::Scale => "image scale",
            Self::Sent => "as sent",
            Self::Combined => "combined",
        }
    }
}

/// Errors on the screen, in pixels.
const TAUS_PX: [f64; 5] = [0.0, 0.5, 1.0, 2.0, 4.0];
/// Alphas below which nothing is blended, beside the profile's own 1/255.
const CUTS: [f64; 3] = [0.008, 0.016, 0.032];
/// Transmittances that end a pixel, beside the profile's own 1e-4.
const STOPS: [f64; 3] = [1e-3, 4e-3, 1.6e-2];
/// Errors of a baked sky; 0 evaluates it for every pixel.
const SKY_ERRORS: [f64; 4] = [0.0, 0.01, 0.05, 0.1];
/// Sides of the images.
const SCALES: [f64; 2] = [0.5, 0.25];
/// Qualities of JPEG; 90 is the server's.
const QUALITIES: [u8; 4] = [50, 75, 90, 98];

/// Tiles are no rung: why.
const TILE: &str = "16 x 16 px by construction: sixteen vectors of 4 x 4 on the cpu, the pixels of a workgroup on \
                    the gpu; a macro tile has 8 x 4 of them, the bits of a word. The image is the same with any";

/// Every setting that the twin can feel: `backends` many backends, of which the first draws all; only
/// coarser records than the twin's own are compared with it.
pub fn settings_to_compare(twin: &TwinFeatures, backends: &[&str]) -> SettingList {
    let profile = &twin.profile;
    let served = Setting {
        name: "as served".to_owned(),
        family: Family::AsServed,
        backend: 0,
        record: None,
        profile: Vec::new(),
        scale: 1.0,
        sent: None,
        against: Rays::Splats,
    };
    let changed = |family, changes: &[String]| Setting {
        name: changes.join(" "),
        family,
        profile: changes.to_vec(),
        ..served.clone()
    };
    let mut all = vec![served.clone()];
    let mut skipped = vec![Skipped::new("tile size", TILE)];
    for (backend, name) in backends.iter().enumerate().skip(1) {
        let (name, family) = ((*name).to_owned(), Family::Backend);
        all.push(Setting { name, family, backend, ..served.clone() });
    }
    let tau = |tau_px: f64| format!("tau_px={tau_px}");
    if twin.levels {
        let taus = TAUS_PX.into_iter().filter(|tau_px| *tau_px != profile.tau_px);
        all.extend(taus.map(|tau_px| changed(Family::Detail, &[tau(tau_px)])));
    } else {
        skipped.push(Skipped::new("tau_px", "the twin has no levels of detail"));
    }
    match profile.reach_m {
        None => skipped.push(Skipped::new("reach_m", "the twin is drawn however far it goes")),
        Some(_) => all.push(changed(Family::Reach, &["reach_m=none".to_owned()])),
    }
    let mut coarser = RecordFormat::ALL
        .into_iter()
        .skip_while(|record| *record != twin.stored)
        .skip(1)
        .peekable();
    if coarser.peek().is_none() {
        skipped.push(Skipped::new("record", "the twin's own is the coarsest"));
    }
    all.extend(coarser.map(|record| Setting {
        name: format!("record {record}"),
        family: Family::Record,
        record: Some(record),
        ..served.clone()
    }));
    let other = format!("antialiased={}", !profile.antialiased);
    all.push(changed(Family::Antialiasing, &[other]));
    let cut = |cut: f64| format!("alpha_cut={cut}");
    let cuts = || CUTS.into_iter().filter(|cut| *cut > profile.alpha_cut);
    all.extend(cuts().map(|alpha| changed(Family::AlphaCut, &[cut(alpha)])));
    let stop = |stop: f64| format!("stop={stop}");
    let stops = STOPS.into_iter().filter(|stop| *stop > profile.stop);
    all.extend(stops.map(|left| changed(Family::Stop, &[stop(left)])));
    match twin.behind {
        BackgroundKind::Nothing => skipped.push(Skipped::new("sky_error", "the twin has no sky")),
        BackgroundKind::Images => {
            skipped.push(Skipped::new("sky_error", "the sky is images: they are their own map"));
        }
        BackgroundKind::Network => {
            let others = SKY_ERRORS.into_iter().filter(|error| *error != profile.sky_error);
            all.extend(others.map(|e| changed(Family::Sky, &[format!("sky_error={e}")])));
        }
    }
    match twin.bent {
        false => skipped.push(Skipped::new("rays", "every camera is a pinhole at rest")),
        true => all.push(Setting {
            name: "against every pixel's own ray".to_owned(),
            family: Family::Rays,
            against: Rays::Exact,
            ..served.clone()
        }),
    }
    all.extend(SCALES.map(|scale| Setting {
        name: format!("scale {scale}"),
        family: Family::Scale,
        scale,
        ..served.clone()
    }));
    let sent =
        |sent, name| Setting { name, family: Family::Sent, sent: Some(sent), ..served.clone() };
    all.push(sent(Sent::Raw, "8 bits".to_owned()));
    all.extend(QUALITIES.map(|quality| sent(Sent::Jpeg(quality), format!("jpeg {quality}"))));
    for (tau_px, alpha) in [(2.0, CUTS[0]), (2.0, CUTS[1]), (4.0, CUTS[1]), (4.0, CUTS[2])] {
        let mut changes = vec![cut(alpha), stop(STOPS[1])];
        if twin.levels {
            changes.insert(0, tau(tau_px));
        }
        let combined = changed(Family::Combined, &changes);
        if all.iter().all(|other| other.name != combined.name) {
            all.push(combined);
        }
    }
    SettingList { settings: all, skipped }
}

impl TwinFeatures {
    /// Of a version of a twin, with the sky that it has, and what looks at it.
    pub fn of(manifest: &Manifest, sky: Option<&Sky>, views: &[View]) -> Self {
        let sections = manifest.chunks.iter().flat_map(|chunk| &chunk.sections);
        Self {
            profile: manifest.profile,
            stored: manifest.record,
            levels: sections.into_iter().any(|section| section.level > 0),
            behind: match sky.map(Sky::model) {
                None => BackgroundKind::Nothing,
                Some(SkyModel::Network(..)) => BackgroundKind::Network,
                Some(SkyModel::Cube(_)) => BackgroundKind::Images,
            },
            bent: views.iter().any(|view| !view.is_static_pinhole()),
        }
    }
}

impl Setting {
    /// The twin's profile with the setting's changes.
    ///
    /// # Errors
    /// Names the change that cannot be made.
    pub fn apply(&self, mut profile: RenderProfile) -> Result<RenderProfile, ProfileError> {
        self.profile.iter().try_for_each(|change| profile.set(change))?;
        Ok(profile)
    }

    /// Whether a server can be told to draw so without the twin being stored anew.
    pub fn can_be_served(&self) -> bool {
        let as_drawn = self.scale == 1.0 && self.sent.is_none() && self.against == Rays::Splats;
        self.record.is_none() && as_drawn
    }
}

/// A view with sides and intrinsics scaled.
///
/// # Errors
/// The scaled camera cannot be used.
pub(super) fn scaled(view: View, scale: f64) -> Result<View, CameraError> {
    let side = |px: u32| ((f64::from(px) * scale).round() as u64).max(1);
    let View { camera, .. } = view;
    Ok(View { camera: camera.scaled(side(camera.width_px), side(camera.height_px))?, ..view })
}
