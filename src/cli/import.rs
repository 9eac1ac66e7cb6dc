//! `wildcity import`.

use std::borrow::Cow;
use std::fmt;
use std::io::Write;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context;

#[cfg(feature = "log")]
use wildcity_log::Log;
use wildcity_push::{SourceAxes, SourceScene, provenance, read_scene};
use wildcity_scene::geo::GeoAnchor;
use wildcity_scene::rig::is_name;
use wildcity_scene::{RecordFormat, RenderProfile, Rig, Trajectory};
use wildcity_twin::ingest::ReadLimits;
use wildcity_twin::store::{Catalog, NewSky, NewVersion, StorageOptions, StoreError, Version};

use super::directories::Twins;
use super::file_notes::{self, DropBad};
use super::input_files::read_trajectories;
use super::output;
use super::packed_folder::scene_file;
use super::profile_options::ProfileOptions;
use super::progress;
use super::sky_source::SkySource;
#[cfg(feature = "log")]
use super::twin::views::Views;
use super::twin::{blind, find_rig};

/// Make a twin from a trained scene, or a new version of an existing twin.
///
/// The format of SRC is detected from its content, not from its extension; the formats are listed
/// below. Every Gaussian is checked before anything is written. An import that fails leaves nothing
/// behind.
///
/// A new version of an existing twin has only the Gaussians of SRC. Earlier pushes to the twin
/// remain in its earlier versions (`wildcity twin log`).
///
/// Prints how long each phase took: reading and checking the file, sorting Gaussians into cells,
/// packing cells with their levels of detail, and publishing.
///
/// Memory: twice the uncompressed scene (56 bytes per Gaussian without SH, 236 with SH degree 3),
/// three times if most of it lies within 64 m, and in addition the contents of an archive, a glTF
/// buffer, or a NuRec payload.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Import {
    /// The scene file; for a scene in a folder, the folder of a SOG, or the .gltf file.
    #[arg(value_name = "SRC")]
    source: PathBuf,

    /// Name of the twin, made of a-z 0-9 . _ -; an existing twin gets a new version.
    #[arg(long, value_name = "NAME")]
    twin: String,

    #[command(flatten)]
    twins: Twins,

    /// Directions of the file's axes. Few files record them. Give a preset, or the 9 numbers of the
    /// matrix from the file's axes to the twin's (x east, y north, z up), row by row.
    ///
    /// identity: z is up already.
    /// y-down-z-forward: OpenCV, COLMAP; most captures.
    /// y-up-z-back: OpenGL, SPZ.
    /// y-up-z-forward: Unity, left-handed.
    ///
    /// Default: the axes that the file records, as an SPZ may; else those of the twin's latest
    /// version; else those of the format's specification (SPZ); else identity.
    #[arg(long, value_name = "AXES", allow_hyphen_values = true, verbatim_doc_comment)]
    axes: Option<String>,

    /// Metres per unit of the file, applied after --axes [default: that of the twin's latest
    /// version, or 1]
    #[arg(long, allow_negative_numbers = true)]
    scale: Option<f64>,

    /// The vehicle's cameras: a preset (see `wildcity twin rig show`) or a JSON file (see below).
    /// They become the twin's default rig. A version that is imported without this option has no
    /// default rig, even if the previous version has one.
    #[arg(long, value_name = "RIG")]
    rig: Option<String>,

    /// JSON file of a recorded drive (see below), in the twin's axes and metres. May be given
    /// again. A version has only the drives that its own import names.
    #[arg(long, value_name = "FILE")]
    trajectory: Vec<PathBuf>,

    /// Where the origin of the twin lies on the earth, so that observations have latitude,
    /// longitude and heading: LATITUDE,LONGITUDE[,ALTITUDE] in degrees (x is east there, y north),
    /// or EPSG:CODE,EASTING,NORTHING[,ALTITUDE] for a twin in a UTM zone. Altitudes are above the
    /// WGS84 ellipsoid.
    #[arg(long, value_name = "ANCHOR", allow_hyphen_values = true)]
    geo: Option<GeoAnchor>,

    /// Also take from a log (docs/logs.md) what a twin can have of it: its poses as a drive, its
    /// rig, its place on the earth, and an image of each camera every 2 m as recorded images, which
    /// make a second version. The scene must be in the axes of the log, and the log's map goes to
    /// scenarios: see `wildcity scenario from-log`.
    #[cfg(feature = "log")]
    #[arg(long, value_name = "LOG")]
    log: Option<PathBuf>,

    #[command(flatten)]
    sky: SkySource,

    #[command(flatten)]
    profile: ProfileOptions,

    #[command(flatten)]
    bad: DropBad,

    /// Level of detail of a streamed SOG to read: 0 is the finest, and each further one has
    /// fewer Gaussians. A block without that level gives its next coarser one, or else its
    /// coarsest. The version records it [default: 0]
    #[arg(long, value_name = "N")]
    level: Option<u32>,

    /// Record format in which Gaussians are stored: f32 (exact), h52, q32 or q24. For the last
    /// three the number is the bytes per Gaussian at SH degree 1, before compression.
    #[arg(long, value_name = "FORMAT", default_value_t)]
    record: RecordFormat,

    /// Make no levels of detail: everything is rendered at full detail, at any distance.
    #[arg(long)]
    no_lod: bool,
}

const EXAMPLES: &str = "\
Formats, and their usual axes. Files of one format differ, so render the twin to check its axes:
  PLY                 INRIA's columns in any order, SH degree 0 to 3; also  y-down-z-forward
                      text, big-endian, and the columns of 2DGS,
                      mip-splatting, nerfstudio and street_gaussians
  compressed PLY      PlayCanvas, SuperSplat                                y-down-z-forward
  safetensors         gsplat's names: means, quats, scales, opacities, ..   y-down-z-forward
  checkpoint (.pt)    python -m wildcity.convert CKPT.pt OUT.safetensors    y-down-z-forward
  .splat              antimatter15                                          y-down-z-forward
  .ksplat             mkkellogg, levels 0 to 2                              y-down-z-forward
  SPZ 2, 3, 4         Niantic; by its specification right, up, back, but    y-up-z-back
                      some tools keep the axes of the PLY; those that an
                      extension records are the default
  SOG 1 and 2         PlayCanvas; a folder, or one .sog or .zip             y-down-z-forward
  streamed SOG        a folder, or one .zip; the finest level is read,      y-down-z-forward
                      unless --level says another one
  glTF, GLB           KHR_gaussian_splatting, with the transforms of its    '-1 0 0 0 0 1 0 1 0'
                      nodes; the standard has x left, y up, z to the front.
                      Also compressed as SPZ
  glTF, GLB of        triangles are covered with about 200,000 flat         the same
  ordinary meshes     Gaussians in their base colour
  NuRec (.usdz)       NVIDIA; static content only. Axes are the payload's,  y-down-z-forward
                      without the transforms of the USD layers around it

Examples:
  wildcity import skull.ply --twin skull --axes y-down-z-forward --set near=0.2
  wildcity import street.safetensors --twin street --rig car.json --trajectory log.json
  wildcity import trained.ply --twin street --log log
  wildcity import playbot --twin small --level 3       (the folder of a streamed SOG)
  wildcity import old.ply --twin old --axes '0 0 1 -1 0 0 0 -1 0' --scale 0.01

Rig file: sizes and intrinsics are in pixels, camera_to_rig is in metres. Camera axes are x right,
y down, z forward; rig axes are x forward, y left, z up. q is (w, x, y, z). This camera looks ahead:
  {\"name\": \"car\", \"cameras\": [
    {\"name\": \"front\", \"width\": 1440, \"height\": 928,
     \"fx\": 1800, \"fy\": 1800, \"cx\": 720, \"cy\": 464,
     \"camera_to_rig\": {\"xyz\": [1.9, 0, 1.65], \"q\": [0.5, -0.5, 0.5, -0.5]}}]}

Trajectory file: poses of the rig in the twin's axes and metres, at rising times:
  {\"name\": \"log\", \"keyframes\": [
    {\"time_us\": 0, \"world_from_rig\": {\"xyz\": [0, 0, 0], \"q\": [1, 0, 0, 0]}},
    {\"time_us\": 100000, \"world_from_rig\": {\"xyz\": [0.8, 0, 0], \"q\": [1, 0, 0, 0]}}]}";

impl Import {
    pub(super) fn run(self) -> anyhow::Result<()> {
        // 1. Options and small files, which are quick to check.
        if !is_name(&self.twin) {
            return Err(StoreError::Name { name: self.twin }.into());
        }
        let axes = SourceAxes::given(self.axes.as_deref(), self.scale)?;
        let catalog = self.twins.catalog()?;
        let latest = self.latest(&catalog, &axes)?;
        let default_axes = match &latest {
            Some(latest) if !axes.is_complete() => SourceAxes::from_version(latest)
                .map_err(anyhow::Error::msg)
                .with_context(|| format!("twin {} version {}", self.twin, latest.number))?,
            _ => SourceAxes::default(),
        };
        let changes = self.profile.load()?;
        // Applied to the default only to find mistakes before a large file is read.
        changes.apply(RenderProfile::default())?;
        let expected = if self.axes.is_some() { &axes } else { &default_axes };
        let [expected_axes, _] = expected.options();
        let expected_axes = expected_axes.trim_start_matches("axes=");
        let sky = self.sky.read(expected_axes)?;
        let recorded = self.recorded()?;
        let rig = self.rig.as_deref().map(find_rig).transpose()?.or(recorded.rig);
        let mut trajectories = read_trajectories(&self.trajectory)?;
        trajectories.extend(recorded.drive);
        let geo = self.geo.clone().or(recorded.geo);
        let source = scene_file(self.source.clone())?;

        // 2. The scene.
        let cannot = || format!("cannot import {}", source.display());
        let mut phases = Phases::start();
        let bar = progress::bytes("reading");
        let show = &mut progress::show(&bar);
        let limits = ReadLimits {
            drop_bad: self.bad.drop_bad,
            level: self.level,
            ..ReadLimits::for_own_file()
        };
        let read = read_scene(&source, &axes, &default_axes, &limits, show);
        let SourceScene { gaussians, hash, options, notes, .. } =
            file_notes::explained(read).with_context(cannot)?;
        bar.finish_and_clear();
        phases.end("read");
        file_notes::print(&source, &notes)?;
        let own_profile = notes.profile().apply(RenderProfile::default())?;
        let profile = changes.apply(own_profile)?;
        let used_axes = options[0].trim_start_matches("axes=").to_owned();
        let used_scale = options[1].trim_start_matches("scale=").to_owned();
        let is_identity = used_axes == "identity" && !gaussians.is_empty();
        if is_identity && self.axes.is_none() && notes.axes.is_none() {
            writeln!(
                std::io::stderr(),
                "note: axes=identity; most captures need --axes y-down-z-forward, and glTF --axes '-1 0 0 0 0 1 0 1 0'"
            )?;
        }
        // A file may say its own axes, which are known only now: then the sky is turned by those.
        let sky = if used_axes == expected_axes { sky } else { self.sky.read(&used_axes)? };
        if gaussians.is_empty() {
            let source = source.display();
            writeln!(
                std::io::stderr(),
                "warning: {source} holds no Gaussians: the twin will be empty"
            )?;
        }

        // 3. The twin.
        let levels = !self.no_lod;
        let bar = progress::count("writing");
        let new = NewVersion {
            name: &self.twin,
            gaussians: Cow::Owned(gaussians),
            profile,
            rig,
            trajectories,
            sky: sky.map(NewSky::Put),
            geo,
            provenance: provenance(&[hash], self.source_options(options), levels),
            storage: StorageOptions { record: self.record, levels },
        };
        let mut show = progress::show(&bar);
        let committed = catalog.commit(new, &mut |done, total| {
            show(done, total);
            match done {
                0 => phases.end("sort"),
                done if done == total => phases.end("pack"),
                _ => {}
            }
        });
        // The file passed its checks, so a Gaussian that is refused now was changed by the options.
        let version = committed
            .map_err(|error| match error {
                StoreError::Gaussians(error) => anyhow::Error::new(error)
                    .context(format!("after --axes {used_axes:?} --scale {used_scale}")),
                error => error.into(),
            })
            .with_context(cannot)?;
        bar.finish_and_clear();
        // An alignment that cannot be read does not stay either. It is no error: the version is
        // published, and mends the twin.
        if let Some(latest) = latest
            && !matches!(latest.manifest.alignment(), Ok(None))
        {
            writeln!(
                std::io::stderr(),
                "warning: version {} of the twin was aligned, and this one is not: `wildcity twin align` aligns it",
                latest.number
            )?;
        }
        phases.end("publish");
        writeln!(std::io::stderr(), "{phases}")?;

        if version.manifest.trajectories.is_empty() {
            writeln!(
                std::io::stderr(),
                "note: there is no recorded drive, so sessions start at the origin: `wildcity twin drive` adds one"
            )?;
        }
        blind::warn(&catalog, &version)?;
        let manifest = &version.manifest;
        let stored_bytes = manifest.stored_bytes();
        writeln!(
            output::stdout(),
            "twin {} version {}: {} Gaussians of SH degree {} in {}, {:.1} MB\n\
             {}\nblake3 {}",
            self.twin,
            version.number,
            manifest.gaussians(),
            manifest.sh_degree,
            output::counted(manifest.chunks.len(), "chunk"),
            stored_bytes as f64 / 1e6,
            catalog.dir().join(&self.twin).display(),
            version.hash,
        )?;
        #[cfg(feature = "log")]
        if let Some(log) = recorded.images {
            return Views::from_log(&self.twin, log, self.twins).run();
        }
        Ok(())
    }

    /// The options of the reading that the version records.
    fn source_options(&self, axes_and_scale: [String; 2]) -> Vec<String> {
        let level = self.level.map(|level| format!("level={level}"));
        axes_and_scale.into_iter().chain(level).collect()
    }

    /// What a twin takes from a log; nothing without `--log`.
    #[cfg(feature = "log")]
    fn recorded(&self) -> anyhow::Result<Recorded> {
        let Some(folder) = &self.log else { return Ok(Recorded::default()) };
        let log = Log::open(folder)?;
        Ok(Recorded {
            drive: Some(log.poses()?.drive(log.header.name.clone())),
            images: log.images()?.map(|_| folder.clone()),
            geo: log.header.world.geo.clone(),
            rig: Some(log.rig),
        })
    }

    /// This build reads no logs.
    #[cfg(not(feature = "log"))]
    fn recorded(&self) -> anyhow::Result<Recorded> {
        Ok(Recorded::default())
    }

    /// The twin's latest version, whose axes and scale are those that are not given.
    fn latest(&self, catalog: &Catalog, given: &SourceAxes) -> anyhow::Result<Option<Version>> {
        match catalog.version(&self.twin, None) {
            Ok(latest) => Ok(Some(latest)),
            Err(StoreError::NoTwin { .. }) => Ok(None),
            // An import mends a twin whose latest version is damaged.
            Err(_) if given.is_complete() => Ok(None),
            Err(error) => Err(error.into()),
        }
    }
}

/// What a twin takes from a log.
#[derive(Default)]
struct Recorded {
    rig: Option<Rig>,
    drive: Option<Trajectory>,
    geo: Option<GeoAnchor>,
    /// The log, if it has images.
    #[cfg(feature = "log")]
    images: Option<PathBuf>,
}

/// The time of each phase of an import.
struct Phases {
    began: Instant,
    ended: Vec<(&'static str, Duration)>,
}

impl Phases {
    fn start() -> Self {
        Self { began: Instant::now(), ended: Vec::new() }
    }

    /// Ends the phase `name` and starts the next one.
    fn end(&mut self, name: &'static str) {
        let now = Instant::now();
        self.ended.push((name, now - self.began));
        self.began = now;
    }
}

impl fmt::Display for Phases {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, (name, took)) in self.ended.iter().enumerate() {
            let comma = if index == 0 { "" } else { ", " };
            write!(f, "{comma}{name} {:.1} s", took.as_secs_f64())?;
        }
        Ok(())
    }
}
