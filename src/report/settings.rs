//! The settings that are compared, each a change of one thing, and combinations that a profile can
//! have.
//!
//! **Settings that cannot affect this twin are skipped**, and the page names them: `sky_error`
//! without a sky, exact rays without a lens, `tau_px` without levels of detail. The tile size is
//! not a setting either: see `TILE_SIZE_REASON`. BENCHMARKS.md has its measurements (rows or blocks
//! of pixels, one level of tiles or two).
//!
//! **Small images are compared with the reference's image shrunk** to their size, because they
//! replace that image. "shrink=filter" is the same image with one sample a pixel, where it has
//! several otherwise. "Own blur" is the same image with the profile's blur in its own pixels, as a
//! camera of that size without a native size renders it.
//!
//! **Non-pinhole cameras have two references.** All settings are compared with splats, so that
//! their own errors show. One more row compares the twin as it is served with a ray for every
//! pixel.

use serde::Serialize;

use super::setting::{Family, ImageEncoding, Setting};
use wildcity_render::View;
use wildcity_scene::sky::{Sky, SkyModel};
use wildcity_scene::{Manifest, Rays, RecordFormat, RenderProfile, Shrink};

/// Properties of a twin and its cameras that decide which settings can affect it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TwinFeatures {
    /// The twin's render profile.
    pub profile: RenderProfile,
    /// Record format in which its Gaussians are stored.
    pub record: RecordFormat,
    /// Whether it has levels of detail.
    pub has_levels: bool,
    /// Its background, behind the Gaussians.
    pub background: BackgroundKind,
    /// Whether a camera has a lens, a windshield, or a rolling shutter while it moves.
    pub has_non_pinhole: bool,
}

/// The background of a twin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BackgroundKind {
    /// No sky: black, or one colour.
    Plain,
    /// A sky network, which is evaluated or baked into a map.
    Network,
    /// A sky of images, which are a map already.
    Images,
}

/// The settings to compare, and those that are skipped.
#[derive(Clone, Debug, PartialEq)]
pub struct SettingList {
    /// The twin as it is served is the first. Names are unique.
    pub settings: Vec<Setting>,
    /// Settings that cannot affect this twin, or that this build or machine does not have.
    pub skipped: Vec<Skipped>,
}

/// A setting that is not compared.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Skipped {
    /// The setting or family.
    pub what: String,
    #[serde(rename = "why")]
    pub reason: String,
}

impl Skipped {
    /// A setting that is not compared, and the reason.
    pub fn new(what: impl Into<String>, reason: impl Into<String>) -> Self {
        Self { what: what.into(), reason: reason.into() }
    }
}

/// Values of `tau_px`: largest error of a level of detail on the screen, in pixels.
const TAUS_PX: [f64; 5] = [0.0, 0.5, 1.0, 2.0, 4.0];
/// Values of `alpha_cut`, in addition to the default 1/255.
const ALPHA_CUTS: [f64; 3] = [0.008, 0.016, 0.032];
/// Values of `stop`, the transmittance that ends a pixel, in addition to the default 1e-4.
const STOPS: [f64; 3] = [1e-3, 4e-3, 1.6e-2];
/// Values of `sky_error`: colour error of the baked sky; 0 evaluates it for every pixel.
const SKY_ERRORS: [f64; 4] = [0.0, 0.01, 0.05, 0.1];
/// Scales of the image's sides. An agent that reads 576 x 320 px of a camera of 1920 x 1080 px has
/// 0.3.
const SCALES: [f64; 3] = [0.5, 1.0 / 3.0, 0.25];
/// Values of `lens_error_px`; 0 projects six points of every Gaussian.
const LENS_ERRORS_PX: [f64; 5] = [0.0, 1.0 / 256.0, 1.0 / 64.0, 1.0 / 16.0, 0.25];
/// JPEG qualities; 90 is the server's default.
const JPEG_QUALITIES: [u8; 4] = [50, 75, 90, 98];
/// `tau_px` and `alpha_cut` of the combined settings, from cautious to coarse.
const COMBINED: [Combination; 4] = [
    Combination { tau_px: 2.0, alpha_cut: ALPHA_CUTS[0] },
    Combination { tau_px: 2.0, alpha_cut: ALPHA_CUTS[1] },
    Combination { tau_px: 4.0, alpha_cut: ALPHA_CUTS[1] },
    Combination { tau_px: 4.0, alpha_cut: ALPHA_CUTS[2] },
];
/// `stop` of the combined settings.
const COMBINED_STOP: f64 = STOPS[1];

struct Combination {
    tau_px: f64,
    alpha_cut: f64,
}

/// Why there is no setting for the tile size.
const TILE_SIZE_REASON: &str = "16 x 16 px is part of the kernels' design: sixteen vectors of 4 x 4 px on \
                                the cpu backend, four pixels for each thread of a workgroup on the gpu \
                                backend. A macro tile has 8 x 4 tiles, one for each bit of a word. Another \
                                size is another kernel, and the image would be the same";

/// Every setting that can affect the twin. `backends` are names; the first backend renders all
/// settings. Only record formats coarser than the twin's own are compared with it.
pub fn settings_to_compare(twin: &TwinFeatures, backends: &[&str]) -> SettingList {
    let mut list = ListBuilder::new(twin);
    list.add_backends(backends);
    list.add_levels_of_detail();
    list.add_draw_distance();
    list.add_records();
    list.add_blending();
    list.add_sky();
    list.add_lens_errors();
    list.add_exact_rays();
    list.add_scales();
    list.add_encodings();
    list.add_combinations();
    SettingList { settings: list.settings, skipped: list.skipped }
}

/// Collects settings, family by family, in the order of the report.
struct ListBuilder<'a> {
    twin: &'a TwinFeatures,
    as_served: Setting,
    settings: Vec<Setting>,
    skipped: Vec<Skipped>,
}

impl<'a> ListBuilder<'a> {
    fn new(twin: &'a TwinFeatures) -> Self {
        let as_served = Setting {
            name: "as served".to_owned(),
            family: Family::AsServed,
            backend: 0,
            record: None,
            profile: Vec::new(),
            scale: 1.0,
            own_blur: false,
            encoding: None,
            reference_rays: Rays::Splats,
        };
        Self {
            twin,
            settings: vec![as_served.clone()],
            // Kept as the base of all others, each of which changes one thing of it.
            as_served,
            skipped: vec![Skipped::new("tile size", TILE_SIZE_REASON)],
        }
    }

    /// A setting that changes fields of the profile.
    fn profile_setting(&self, family: Family, changes: Vec<String>) -> Setting {
        Setting { name: changes.join(" "), family, profile: changes, ..self.as_served.clone() }
    }

    fn add_profile_change(&mut self, family: Family, change: String) {
        let setting = self.profile_setting(family, vec![change]);
        self.settings.push(setting);
    }

    fn skip(&mut self, what: &str, reason: &str) {
        self.skipped.push(Skipped::new(what, reason));
    }

    fn add_backends(&mut self, backends: &[&str]) {
        // The first backend is that of "as served".
        for (backend, name) in backends.iter().enumerate().skip(1) {
            let name = (*name).to_owned();
            let family = Family::Backend;
            self.settings.push(Setting { name, family, backend, ..self.as_served.clone() });
        }
    }

    fn add_levels_of_detail(&mut self) {
        if !self.twin.has_levels {
            self.skip("tau_px", "the twin has no levels of detail");
            return;
        }
        // The twin's own value is "as served" already.
        for tau_px in TAUS_PX.into_iter().filter(|tau_px| *tau_px != self.twin.profile.tau_px) {
            self.add_profile_change(Family::Detail, tau_change(tau_px));
        }
    }

    fn add_draw_distance(&mut self) {
        match self.twin.profile.reach_m {
            None => self.skip("reach_m", "the profile does not limit the draw distance"),
            Some(_) => {
                // Compared with no limit at all.
                self.add_profile_change(Family::DrawDistance, "reach_m=none".to_owned());
            }
        }
    }

    fn add_records(&mut self) {
        // Records are listed from exact to coarse.
        let own = self.twin.record;
        let from_own = RecordFormat::ALL.into_iter().skip_while(|record| *record != own);
        let coarser: Vec<RecordFormat> = from_own.skip(1).collect();
        if coarser.is_empty() {
            self.skip("record", "the twin is stored in the coarsest record format");
        }
        for record in coarser {
            self.settings.push(Setting {
                name: format!("record {record}"),
                family: Family::Record,
                record: Some(record),
                ..self.as_served.clone()
            });
        }
    }

    /// Antialiasing, the smallest alpha, and the transmittance that ends a pixel.
    fn add_blending(&mut self) {
        let profile = self.twin.profile;
        let antialiased = format!("antialiased={}", !profile.antialiased);
        self.add_profile_change(Family::Antialiasing, antialiased);
        // Only coarser values: finer ones cost time, and the reference has the twin's own.
        for alpha_cut in ALPHA_CUTS.into_iter().filter(|cut| *cut > profile.alpha_cut) {
            self.add_profile_change(Family::AlphaCut, alpha_cut_change(alpha_cut));
        }
        for stop in STOPS.into_iter().filter(|stop| *stop > profile.stop) {
            self.add_profile_change(Family::Stop, stop_change(stop));
        }
    }

    fn add_sky(&mut self) {
        match self.twin.background {
            BackgroundKind::Plain => self.skip("sky_error", "the twin has no sky"),
            BackgroundKind::Images => {
                self.skip("sky_error", "the sky is made of images, which need no baking");
            }
            BackgroundKind::Network => {
                let own = self.twin.profile.sky_error;
                // 0 is among them: the sky evaluated for every pixel.
                for error in SKY_ERRORS.into_iter().filter(|error| *error != own) {
                    self.add_profile_change(Family::Sky, format!("sky_error={error}"));
                }
            }
        }
    }

    fn add_lens_errors(&mut self) {
        if !self.twin.has_non_pinhole {
            self.skip(
                "lens_error_px",
                "every camera is a pinhole at rest, for which nothing is approximated",
            );
            return;
        }
        let own = self.twin.profile.lens_error_px;
        for error_px in LENS_ERRORS_PX.into_iter().filter(|error_px| *error_px != own) {
            self.add_profile_change(Family::Lens, format!("lens_error_px={error_px}"));
        }
    }

    fn add_exact_rays(&mut self) {
        if !self.twin.has_non_pinhole {
            self.skip(
                "rays",
                "every camera is a pinhole at rest, for which splats need no correction",
            );
            return;
        }
        self.settings.push(Setting {
            name: "against every pixel's own ray".to_owned(),
            family: Family::Rays,
            reference_rays: Rays::Exact,
            ..self.as_served.clone()
        });
    }

    fn add_scales(&mut self) {
        for scale in SCALES {
            let scaled = Setting {
                // Three decimals: 1/3 is "0.333".
                name: format!("scale {}", (scale * 1e3).round() / 1e3),
                family: Family::Scale,
                scale,
                ..self.as_served.clone()
            };
            // Names have to be unique within a report.
            let name = format!("{} with its own blur", scaled.name);
            self.settings.push(scaled.clone());
            // Larger images have one sample a pixel with either.
            if scale <= 0.45 && self.twin.profile.shrink == Shrink::Samples {
                let change = "shrink=filter".to_owned();
                let name = format!("{} {change}", scaled.name);
                self.settings.push(Setting { name, profile: vec![change], ..scaled.clone() });
            }
            self.settings.push(Setting { name, own_blur: true, ..scaled });
        }
    }

    fn add_encodings(&mut self) {
        let encoded = |name: String, encoding: ImageEncoding| Setting {
            name,
            family: Family::Encoding,
            encoding: Some(encoding),
            ..self.as_served.clone()
        };
        let raw = encoded("8 bits".to_owned(), ImageEncoding::Raw);
        let jpegs = JPEG_QUALITIES
            .map(|quality| encoded(format!("jpeg {quality}"), ImageEncoding::Jpeg(quality)));
        self.settings.push(raw);
        self.settings.extend(jpegs);
    }

    fn add_combinations(&mut self) {
        for Combination { tau_px, alpha_cut } in COMBINED {
            // In the order in which a reader looks for them: the detail first.
            let mut changes = vec![alpha_cut_change(alpha_cut), stop_change(COMBINED_STOP)];
            if self.twin.has_levels {
                changes.insert(0, tau_change(tau_px));
            }
            let combined = self.profile_setting(Family::Combined, changes);
            // Without levels of detail, two combinations are equal.
            if self.settings.iter().all(|other| other.name != combined.name) {
                self.settings.push(combined);
            }
        }
    }
}

fn tau_change(tau_px: f64) -> String {
    format!("tau_px={tau_px}")
}

fn alpha_cut_change(alpha_cut: f64) -> String {
    format!("alpha_cut={alpha_cut}")
}

fn stop_change(stop: f64) -> String {
    format!("stop={stop}")
}

impl TwinFeatures {
    /// The features of a version of a twin, with its sky and with the cameras of the report.
    pub fn new(manifest: &Manifest, sky: Option<&Sky>, views: &[View]) -> Self {
        Self {
            profile: manifest.profile,
            record: manifest.record,
            has_levels: manifest.has_levels(),
            background: match sky.map(Sky::model) {
                None => BackgroundKind::Plain,
                Some(SkyModel::Network(..)) => BackgroundKind::Network,
                Some(SkyModel::Cube(_)) => BackgroundKind::Images,
            },
            has_non_pinhole: views.iter().any(|view| !view.is_static_pinhole()),
        }
    }
}
