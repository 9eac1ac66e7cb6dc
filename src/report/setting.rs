//! One way to render a twin.

use serde::Serialize;

use wildcity_scene::profile::ProfileError;
use wildcity_scene::{Rays, RecordFormat, RenderProfile};

/// One way to render a twin.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Setting {
    /// For example `tau_px=2`; unique within a report.
    pub name: String,
    /// The part of the rendering that the setting changes.
    pub family: Family,
    /// Index of the backend among those of the report.
    pub backend: usize,
    /// Record format of the Gaussians. None leaves the twin's own.
    pub record: Option<RecordFormat>,
    /// Changes of the twin's render profile, as `field=value`.
    pub profile: Vec<String>,
    /// Width and height of the images, as a share of the cameras'.
    pub scale: f64,
    /// Whether images of another size are drawn with the blur of their own pixels, and not as the
    /// native images shrunk.
    pub own_blur: bool,
    /// Encoding of the images. None compares values before they are rounded to 8 bits, and times no
    /// encoding.
    #[serde(rename = "sent")]
    pub encoding: Option<ImageEncoding>,
    /// The reference that the setting is compared with: splats, except in [`Family::Rays`].
    #[serde(rename = "against")]
    pub reference_rays: Rays,
}

impl Setting {
    /// The twin's profile with the changes of this setting.
    ///
    /// # Errors
    /// Names the change that cannot be made.
    pub fn apply(&self, mut profile: RenderProfile) -> Result<RenderProfile, ProfileError> {
        // In order: a later change of the same field wins.
        self.profile.iter().try_for_each(|change| profile.set(change))?;
        Ok(profile)
    }

    /// Whether `wildcity serve` can use the setting without the twin being stored again: only its
    /// profile and backend differ.
    pub fn can_be_served(&self) -> bool {
        self.record.is_none()
            && self.scale == 1.0
            && self.encoding.is_none()
            && self.reference_rays == Rays::Splats
    }
}

/// How an image is encoded for the agent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ImageEncoding {
    /// 8 bits per channel, not compressed.
    Raw,
    /// JPEG of a quality from 1 to 100.
    Jpeg(u8),
}

/// The parts of the rendering that settings change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// No change: the twin as it is served.
    AsServed,
    Backend,
    Detail,
    #[serde(rename = "reach")]
    DrawDistance,
    /// Record format of the Gaussians.
    Record,
    /// Whether the opacity of small splats is compensated.
    Antialiasing,
    /// The smallest alpha that is blended.
    AlphaCut,
    /// The transmittance at which a pixel ends.
    Stop,
    /// How exactly the sky is looked up.
    Sky,
    /// How exactly Gaussians are projected by lenses and rolling shutters.
    Lens,
    /// Splats of non-pinhole cameras, compared with a ray for every pixel.
    Rays,
    /// Size of the images.
    Scale,
    /// Encoding of the images.
    #[serde(rename = "sent")]
    Encoding,
    /// Several at once, as a profile can have them.
    Combined,
}

impl Family {
    /// The name in CSV files.
    pub fn name(self) -> &'static str {
        match self {
            Self::AsServed => "as served",
            Self::Backend => "backend",
            Self::Detail => "levels of detail",
            Self::DrawDistance => "reach",
            Self::Record => "record",
            Self::Antialiasing => "antialiasing",
            Self::AlphaCut => "alpha cut",
            Self::Stop => "stop",
            Self::Sky => "sky",
            Self::Lens => "lens",
            Self::Rays => "rays",
            Self::Scale => "image scale",
            Self::Encoding => "as sent",
            Self::Combined => "combined",
        }
    }

    /// The name for a reader of the page: what the setting changes.
    pub fn label(self) -> &'static str {
        match self {
            Self::AsServed => "nothing",
            Self::DrawDistance => "draw distance",
            Self::Record => "record format",
            Self::AlphaCut => "smallest alpha",
            Self::Stop => "stop transmittance",
            Self::Sky => "sky map",
            Self::Lens => "six points or expansion",
            Self::Rays => "reference: exact rays",
            Self::Encoding => "encoding",
            Self::Combined => "several",
            Self::Backend | Self::Detail | Self::Antialiasing | Self::Scale => self.name(),
        }
    }
}
