//! `wildcity log generate`.

mod actors;
mod recorder;
mod sensors;

use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, ensure};

use wildcity_log::{Header, LidarMount, LogWriter, Source};
use wildcity_scene::Rig;
use wildcity_scene::geo::GeoAnchor;
use wildcity_scene::geometry::Pose;
use wildcity_scene::route::Route;
use wildcity_sim::map::MapFile;
use wildcity_twin::ingest;
use wildcity_twin::residency::Cache;

use self::recorder::Recorder;
use crate::cli::backend_options::BackendOptions;
use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::output::{self, counted};
use crate::cli::progress;

/// Record a log of a twin: a vehicle repeats the twin's first drive among three moving objects.
///
/// The log has images of the twin's rig at 10 Hz, each camera at times of its own; a LiDAR at 10 Hz
/// that turns in eight steps; poses and an inertial unit at 100 Hz, satellite fixes at 10 Hz, and
/// the boxes of the objects. Images and points are rendered, so that everything about the log is
/// known: it is for examples and tests.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity log generate demo --out log --length-m 30
  wildcity log generate demo --out late --length-m 30 --lidar-late-ms 40")]
pub(super) struct Generate {
    /// The twin: NAME, or NAME@NUMBER for an older version. It needs a drive.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    /// Folder of the log, which must not exist yet.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Length of the drive, in metres from its start; at most all of it is recorded.
    #[arg(long, value_name = "M", default_value_t = 50.0)]
    length_m: f64,

    /// Width of the images, in pixels; the height follows from the camera.
    #[arg(long, value_name = "PX", default_value_t = 320, value_parser = clap::value_parser!(u32).range(16..=8192))]
    width: u32,

    /// Record only these cameras of the rig [default: all]
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    cameras: Vec<String>,

    /// Leave out every Nth image, as a recorder that was too slow does; 0 leaves out none.
    #[arg(long, value_name = "N", default_value_t = 0)]
    drop_every: u32,

    /// Add this to the times of the LiDAR, in milliseconds, as a wrong clock does.
    #[arg(long, value_name = "MS", default_value_t = 0, allow_negative_numbers = true, value_parser = clap::value_parser!(i64).range(-500..=500))]
    lidar_late_ms: i64,

    /// Place of the twin's origin, as for `wildcity twin geo` [default: that of the twin, or else
    /// one in Berlin]
    #[arg(long, value_name = "ANCHOR", allow_hyphen_values = true)]
    geo: Option<GeoAnchor>,

    /// A map of the twin, which becomes that of the log.
    #[arg(long, value_name = "FILE")]
    map: Option<PathBuf>,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    backend: BackendOptions,
}

/// Where a twin is that has no place on the earth.
const BERLIN: &str = "52.5162,13.3777,34";

impl Generate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let cache = Cache::new(self.twins.catalog()?);
        let TwinVersion { name, number } = &self.twin;
        let resident = cache.open(name, *number)?;
        let manifest = &resident.version.manifest;
        let drive = manifest.trajectories.first().with_context(|| {
            format!("twin {name} has no drive to repeat: `wildcity twin drive` adds one")
        })?;
        let rig = self.rig(manifest.rig.as_ref())?;
        let geo = match self.geo.as_ref().or(manifest.geo.as_ref()) {
            Some(geo) => geo.clone(),
            None => BERLIN.parse()?,
        };
        let header = self.header(&drive.name, geo.clone());
        // Read before the log is begun, so that a bad map leaves nothing behind.
        let map = self.map()?;
        let mut log = LogWriter::create(&self.out, &header, &rig)?;
        map.map_or(Ok(()), |map| log.put_map(&map))?;
        let recorder = Recorder {
            resident: resident.clone(),
            backend: self.backend.backend()?,
            route: Route::new(drive)?,
            rig,
            lidar: Arc::new(sensors::lidar(recorder::PERIOD_US)?),
            rig_from_lidar: header.lidars[0].rig_from_lidar,
            lidar_late_us: 1000 * self.lidar_late_ms,
            drop_every: self.drop_every as usize,
            actors: actors::models(),
            geo,
        };
        let bar = progress::count("recording");
        let images = recorder.record(self.length_m, &mut log, &bar)?;
        log.finish()?;
        bar.finish_and_clear();
        let out = self.out.display();
        writeln!(
            output::stdout(),
            "{out}: {}; next: wildcity log check {out}",
            counted(images, "image")
        )?;
        Ok(())
    }

    /// The cameras that are recorded, at the size of the images.
    fn rig(&self, own: Option<&Rig>) -> anyhow::Result<Rig> {
        let found = own.cloned().or_else(|| Rig::preset("vehicle6"));
        let mut rig = found.context("there is no rig: `wildcity twin drive --rig` adds one")?;
        let known: Vec<String> = rig.cameras.iter().map(|camera| camera.name.clone()).collect();
        let unknown = self.cameras.iter().find(|name| !known.contains(name));
        ensure!(
            unknown.is_none(),
            "--cameras {}: the rig has {}",
            self.cameras.join(","),
            known.join(", ")
        );
        // The log has a LiDAR of its own.
        rig.lidars.clear();
        rig.cameras.retain(|camera| self.cameras.is_empty() || self.cameras.contains(&camera.name));
        for camera in &mut rig.cameras {
            let [width, height] = [camera.camera.width_px, camera.camera.height_px].map(f64::from);
            let small = (height / width * f64::from(self.width)).round().max(1.0);
            *camera = camera.scaled(self.width.into(), small as u64)?;
            // The images of the log are as its cameras took them.
            camera.camera.native_size_px = None;
        }
        Ok(rig)
    }

    fn header(&self, drive: &str, geo: GeoAnchor) -> Header {
        let source = Source {
            kind: "wildcity".to_owned(),
            id: self.twin.name.clone(),
            licence: "that of the twin".to_owned(),
            converter: format!("wildcity log generate {}", env!("CARGO_PKG_VERSION")),
        };
        // On the roof, a metre ahead of the rig's origin and two metres above the ground.
        let position_m = glam::DVec3::new(1.0, 0.0, 2.0);
        let rig_from_lidar = Pose { position_m, ..Pose::IDENTITY };
        let mut header = Header::new(drive, source);
        header.lidars = vec![LidarMount { name: sensors::LIDAR.to_owned(), rig_from_lidar }];
        header.world.geo = Some(geo);
        header
    }

    fn map(&self) -> anyhow::Result<Option<MapFile>> {
        let Some(path) = &self.map else { return Ok(None) };
        let about = || format!("--map {}", path.display());
        let bytes = ingest::read_whole(path, wildcity_sim::limits::MAP_BYTES as u64);
        Ok(Some(MapFile::parse(&bytes.with_context(about)?).with_context(about)?))
    }
}
