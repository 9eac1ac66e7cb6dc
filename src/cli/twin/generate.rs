//! `wildcity twin generate`.

use std::io::Write;
use std::path::Path;
use std::time::Instant;

use anyhow::Context;

use crate::cli::directories::Twins;
use crate::cli::progress;
use wildcity_generate::CitySettings;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{RenderProfile, Rig};
use wildcity_twin::store::{CommitKind, StorageOptions, VersionSettings};

/// Make a twin of a procedural city: a route of any length between houses, cars and trees.
///
/// The route runs east, bending, through streets that each have a crossing and things of their own;
/// its trajectory `log` has a keyframe every 0.5 m. The same options give the same bytes. Cells are
/// written as soon as nothing further can touch them, so a long route needs no more memory than a
/// short one.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Generate {
    /// Name of the twin, of a-z 0-9 . _ -; an existing one gets a new version.
    #[arg(long, value_name = "NAME")]
    twin: String,

    /// Length of the route, in km: 0.1 to 100, to the metre.
    #[arg(long, value_name = "KM")]
    length_km: f64,

    /// Millions of Gaussians per km, about: 1 to 15. A captured street has 12.
    #[arg(long, value_name = "MILLIONS", default_value_t = 5.0)]
    density: f64,

    /// Seed of everything that is random.
    #[arg(long, default_value_t = 1)]
    seed: u32,

    /// Speed of the recorded drive, in m/s.
    #[arg(long, value_name = "M_PER_S", default_value_t = 10.0)]
    speed_m_s: f64,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
A twin has about LENGTH x DENSITY million Gaussians, which take 48 (at 2) to 36 (at 12) bytes of disk
each, levels of detail included:
   1 km at  5    5 million Gaussians    0.2 GiB
  20 km at  5  100 million Gaussians    3.9 GiB
  20 km at 12  240 million Gaussians    8.0 GiB

Examples:
  wildcity twin generate --twin town --length-km 1
  wildcity twin generate --twin city --length-km 20 --density 5
  wildcity render --twin town --out pictures --cameras views.json";

/// Bytes on disk per Gaussian, levels of detail included, of a thin city; of a dense one they are
/// fewer.
const STORED_BYTES: u64 = 48;

/// Farthest block that is drawn, in metres: the street's bends hide what is farther. At four places of
/// a kilometre the picture is, to the bit, the one without a limit; 300 m are 1/255 off in one.
const REACH_M: f64 = 600.0;

impl Generate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let settings = CitySettings {
            seed: self.seed.into(),
            length_m: (1e3 * self.length_km).round(),
            millions_per_km: self.density,
            speed_m_s: self.speed_m_s,
        };
        let city = wildcity_generate::city(&settings)?;
        let catalog = self.twins.catalog()?;
        let gaussians = settings.gaussians();
        let in_directory = catalog.traffic().is_none();
        if in_directory {
            check_room(catalog.dir(), gaussians)?;
        }

        let begun = Instant::now();
        let mut commit =
            catalog.begin(&self.twin, CommitKind::Import, StorageOptions::default())?;
        let bar = progress::count("building");
        bar.set_length(gaussians);
        for cell in city {
            commit.put(&cell.gaussians, None, &mut |_, _| {})?;
            bar.inc(cell.gaussians.len() as u64);
        }
        let parts = VersionSettings {
            profile: RenderProfile { reach_m: Some(REACH_M), ..RenderProfile::default() },
            rig: Rig::preset("vehicle6"),
            trajectories: vec![wildcity_generate::city_drive(&settings)?],
            sky: None,
            provenance: Provenance::of(format!(
                "city {}: {}",
                wildcity_generate::REVISION,
                serde_json::to_string(&settings)?
            )),
        };
        let version = commit.replace(None, parts)?;
        bar.finish_and_clear();

        let (manifest, seconds) = (&version.manifest, begun.elapsed().as_secs_f64());
        let (count, stored_bytes) = (manifest.gaussians(), manifest.stored_bytes());
        writeln!(
            std::io::stdout().lock(),
            "twin {} version {}: {count} Gaussians in {} chunks, {:.2} GiB, {:.1} bytes each; \
             {seconds:.0} s, {:.0} Gaussians/s\nblake3 {}",
            self.twin,
            version.number,
            manifest.chunks.len(),
            stored_bytes as f64 / f64::from(1 << 30),
            stored_bytes as f64 / count as f64,
            count as f64 / seconds,
            version.hash,
        )?;
        Ok(())
    }
}

/// Whether the disk has room for so many Gaussians.
fn check_room(dir: &Path, gaussians: u64) -> anyhow::Result<()> {
    // The directory is made with the first twin.
    let there = dir.ancestors().find(|dir| dir.is_dir()).unwrap_or(Path::new("."));
    let disk = rustix::fs::statvfs(there);
    let disk = disk.with_context(|| format!("cannot ask how much room is in {}", dir.display()))?;
    let free_bytes = disk.f_bavail.saturating_mul(disk.f_frsize);
    let needed_bytes = gaussians.saturating_mul(STORED_BYTES);
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    anyhow::ensure!(
        needed_bytes <= free_bytes,
        "{} has {:.1} GiB free, and {:.1} million Gaussians need about {:.1} GiB: give a smaller \
         --length-km or --density, or --twins on another disk",
        dir.display(),
        gib(free_bytes),
        gaussians as f64 / 1e6,
        gib(needed_bytes),
    );
    Ok(())
}
