//! `wildcity twin generate`.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;

use crate::cli::directories::Twins;
use crate::cli::{output, progress};
use wildcity_generate::{CitySettings, Spoil};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{RenderProfile, Rig};
use wildcity_twin::store::{CommitKind, StorageOptions, VersionSettings};

/// Generate a twin of a procedural city: a route between houses, cars and trees.
///
/// The route winds eastwards through streets that each have a crossing and different objects. Its
/// trajectory `log` has a keyframe every 0.5 m. The same options give the same bytes. Each cell is
/// written as soon as it is complete, so a long route needs no more memory than a short one.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Generate {
    /// Name of the twin, made of a-z 0-9 . _ -; an existing twin gets a new version.
    #[arg(long, value_name = "NAME")]
    twin: String,

    /// Length of the route, in km: 0.1 to 100, rounded to the metre.
    #[arg(long, value_name = "KM")]
    length_km: f64,

    /// Approximate density, in millions of Gaussians per km: 1 to 15. A captured street has 12.
    #[arg(long, value_name = "MILLIONS", default_value_t = 5.0)]
    density: f64,

    /// Seed of the random numbers.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u32,

    /// Speed of the recorded drive, in m/s.
    #[arg(long, value_name = "M_PER_S", default_value_t = 10.0)]
    speed_m_s: f64,

    /// Add reconstruction errors like those of real captures, from 0 (none) to 1: small on the
    /// recorded drive, large off it. Colours change with the viewing direction, there are
    /// sheet-shaped floaters, and some Gaussians are displaced, missing or needle-shaped.
    #[arg(long, value_name = "AMOUNT")]
    spoil: Option<f64>,

    /// Also write a map of the city to this file: lanes, crosswalks, intersections.
    #[arg(long, value_name = "FILE")]
    map: Option<PathBuf>,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
A twin has about LENGTH x DENSITY million Gaussians. Each takes 48 (density 2) to 36 (density 12) bytes
on disk, including levels of detail:
   1 km at density  5    5 million Gaussians    0.2 GiB
  20 km at density  5  100 million Gaussians    3.9 GiB
  20 km at density 12  240 million Gaussians    8.0 GiB

Examples:
  wildcity twin generate --twin town --length-km 1 --map town.map.json
  wildcity twin generate --twin city --length-km 20 --density 5
  wildcity twin generate --twin worn --length-km 0.2 --density 2 --spoil 0.5
  wildcity render town --cameras views.json --out images";

/// Bytes on disk per Gaussian of a city of low density, including levels of detail. Dense cities
/// take fewer.
const STORED_BYTES: u64 = 48;

/// Draw distance, in metres: the bends of the street hide everything beyond. At four places of a
/// kilometre the image is bit-identical to the one without a limit; with 300 m, one of the four is
/// off by 1/255.
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
        let drive = wildcity_generate::city_drive(&settings)?;
        let spoil = self.spoil.map(|amount| Spoil::new(amount, settings.seed, &drive));
        // Mistakes in the options are found before gigabytes are written.
        let spoil = spoil.transpose()?;
        let catalog = self.twins.catalog()?;
        let gaussians = settings.gaussians();
        // An object store has no free space that could be asked for.
        let is_on_disk = catalog.traffic().is_none();
        if is_on_disk {
            check_free_space(catalog.dir(), gaussians)?;
        }

        let begun = Instant::now();
        let mut commit =
            catalog.begin(&self.twin, CommitKind::Import, StorageOptions::default())?;
        let bar = progress::count("building");
        bar.set_length(gaussians);
        // Cell by cell: a city of kilometres does not fit into memory.
        for cell in city {
            let spoiled = spoil.as_ref().map(|spoil| spoil.apply(&cell.gaussians));
            commit.put(spoiled.as_ref().unwrap_or(&cell.gaussians), None, &mut |_, _| {})?;
            bar.inc(cell.gaussians.len() as u64);
        }
        let parts = VersionSettings {
            profile: RenderProfile { reach_m: Some(REACH_M), ..RenderProfile::default() },
            rig: Rig::preset("vehicle6"),
            trajectories: vec![drive],
            sky: None,
            geo: None,
            twin_from_capture: None,
            provenance: Provenance::new(format!(
                "city {}: {}{}",
                wildcity_generate::REVISION,
                serde_json::to_string(&settings)?,
                self.spoil.map_or(String::new(), |amount| format!(", spoiled by {amount}"))
            )),
        };
        let version = commit.replace(None, parts)?;
        if let Some(path) = &self.map {
            output::write(path, wildcity_generate::city_map(&settings)?.to_json().as_bytes())?;
        }
        bar.finish_and_clear();

        let seconds = begun.elapsed().as_secs_f64();
        let manifest = &version.manifest;
        let count = manifest.gaussians();
        let stored_bytes = manifest.stored_bytes();
        writeln!(
            output::stdout(),
            "twin {} version {}: {count} Gaussians in {}, {:.2} GiB, {:.1} bytes each; \
             {seconds:.0} s, {:.0} Gaussians/s\nblake3 {}",
            self.twin,
            version.number,
            output::counted(manifest.chunks.len(), "chunk"),
            stored_bytes as f64 / f64::from(1 << 30),
            stored_bytes as f64 / count as f64,
            count as f64 / seconds,
            version.hash,
        )?;
        Ok(())
    }
}

/// Checks that the disk has space for this number of Gaussians.
fn check_free_space(dir: &Path, gaussians: u64) -> anyhow::Result<()> {
    // The directory may not exist yet; then its nearest parent is on the same disk.
    let existing = dir.ancestors().find(|dir| dir.is_dir()).unwrap_or(Path::new("."));
    let disk = rustix::fs::statvfs(existing)
        .with_context(|| format!("cannot read the free space of {}", dir.display()))?;
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
