//! The settings that are compared, one changed at a time, and those that a profile can be made of.

use serde::Serialize;

use crate::geometry::Camera;
use crate::geometry::camera::Pinhole;
use crate::render::View;
use crate::scene::profile::ProfileError;
use crate::scene::{Record, RenderProfile};

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
    pub record: Option<Record>,
    /// Changes of the twin's own render profile, `key=value`.
    pub profile: Vec<String>,
    /// Sides of the images, as a share of the cameras'.
    pub scale: f64,
    /// How images are sent; if absent, values are compared before they are rounded to 8 bits.
    pub sent: Option<Sent>,
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
    /// How Gaussians are stored.
    Record,
    /// What a small splat's opacity is.
    Antialiasing,
    /// The smallest alpha that is blended.
    AlphaCut,
    /// Where a pixel ends.
    Stop,
    /// The size of the images.
    Scale,
    /// How images are sent.
    Sent,
    /// Several at once: what a profile may be made of.
    Combined,
}

impl Family {
    /// All of them, in the order of the report.
    pub const ALL: [Self; 10] = [
        Self::AsServed,
        Self::Backend,
        Self::Detail,
        Self::Record,
        Self::Antialiasing,
        Self::AlphaCut,
        Self::Stop,
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
            Self::Record => "record",
            Self::Antialiasing => "antialiasing",
            Self::AlphaCut => "alpha cut",
            Self::Stop => "stop",
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
/// Sides of the images.
const SCALES: [f64; 2] = [0.5, 0.25];
/// Qualities of JPEG; 90 is the server's.
const QUALITIES: [u8; 4] = [50, 75, 90, 98];

/// Every setting, the twin as it is served first: `backends` many backends, of which the first draws all;
/// `stored` is the twin's record, and only coarser ones are compared with it.
pub fn ladder(profile: &RenderProfile, stored: Record, backends: &[&str]) -> Vec<Setting> {
    let served = Setting {
        name: "as served".to_owned(),
        family: Family::AsServed,
        backend: 0,
        record: None,
        profile: Vec::new(),
        scale: 1.0,
        sent: None,
    };
    let changed = |family, changes: &[String]| Setting {
        name: changes.join(" "),
        family,
        profile: changes.to_vec(),
        ..served.clone()
    };
    let mut all = vec![served.clone()];
    for (backend, name) in backends.iter().enumerate().skip(1) {
        let (name, family) = ((*name).to_owned(), Family::Backend);
        all.push(Setting { name, family, backend, ..served.clone() });
    }
    let tau = |tau_px: f64| format!("tau_px={tau_px}");
    let taus = TAUS_PX.into_iter().filter(|tau_px| *tau_px != profile.tau_px);
    all.extend(taus.map(|tau_px| changed(Family::Detail, &[tau(tau_px)])));
    let coarser = Record::ALL.into_iter().skip_while(|record| *record != stored).skip(1);
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
        all.push(changed(Family::Combined, &[tau(tau_px), cut(alpha), stop(STOPS[1])]));
    }
    all
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
        self.record.is_none() && self.scale == 1.0 && self.sent.is_none()
    }
}

/// A view with sides and intrinsics scaled.
pub(super) fn scaled(view: View, scale: f64) -> View {
    let side = |px: u32| ((f64::from(px) * scale).round() as u32).max(1);
    let (width_px, height_px) = (side(view.camera.width_px), side(view.camera.height_px));
    let [x, y] = [
        f64::from(width_px) / f64::from(view.camera.width_px),
        f64::from(height_px) / f64::from(view.camera.height_px),
    ];
    let p = view.camera.pinhole;
    let pinhole = Pinhole { fx: x * p.fx, fy: y * p.fy, cx: x * p.cx, cy: y * p.cy };
    View { camera: Camera { width_px, height_px, pinhole }, ..view }
}
