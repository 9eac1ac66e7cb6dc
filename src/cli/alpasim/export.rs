//! `wildcity alpasim export`.

use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use crate::cli::directories::Twins;
use crate::cli::output;
use wildcity_alpasim::export::{ExportError, SceneContent, deploy, files};
use wildcity_alpasim::scene::SceneId;
use wildcity_alpasim::sensorsim::offered_cameras;
use wildcity_scene::ActorBox;
use wildcity_sim::scenario::TracksFile;
use wildcity_twin::store::Catalog;

/// Write scenes of a twin as the files that AlpaSim's runtime reads: rig, cameras, tracks and map.
///
/// Writes one file per scene, TWIN@VERSION+TRAJECTORY+START_M.usdz, and `deploy/wildcity.yaml` for
/// AlpaSim's wizard. The images come from `wildcity serve --alpasim`.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Example:
  wildcity alpasim export demo --out scenes --every-m 200")]
pub(super) struct Export {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: String,

    /// Directory for the scenes; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Where AlpaSim finds `wildcity serve --alpasim`.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:6000", value_parser = address)]
    address: String,

    /// Distance between the starts of two scenes along a drive, in metres.
    #[arg(long, value_name = "M", default_value_t = 200.0, value_parser = positive)]
    every_m: f64,

    /// Length of a scene, in seconds of the recorded drive; the last one of a drive may be shorter.
    #[arg(long, value_name = "S", default_value_t = 20.0, value_parser = positive)]
    length_s: f64,

    /// Recorded traffic, a file of format wildcity.tracks/1 on the clock of the drive. Assets are
    /// given by name or hash; a track without an asset becomes a grey box of its size.
    #[arg(long, value_name = "FILE")]
    tracks: Option<PathBuf>,

    #[command(flatten)]
    twins: Twins,
}

impl Export {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let version = catalog.version(&self.twin, None)?;
        let manifest = &version.manifest;
        anyhow::ensure!(
            !manifest.trajectories.is_empty(),
            "twin {:?} has no recorded drive: import one with --trajectory",
            self.twin
        );
        let tracks = self.tracks.as_deref().map(|path| tracks(path, &catalog)).transpose()?;
        output::create_dir(&self.out)?;
        let cameras = offered_cameras(manifest);
        let content =
            SceneContent { cameras: &cameras, tracks: tracks.as_ref(), length_s: self.length_s };
        let mut out = output::stdout();
        for drive in &manifest.trajectories {
            let starts = (drive.length_m() / self.every_m).floor() as u32;
            for start in 0..=starts {
                let id = SceneId {
                    twin: self.twin.clone(),
                    version: version.number,
                    trajectory: drive.name.clone(),
                    start_m: f64::from(start) * self.every_m,
                };
                let scene = match files(&id, manifest, &version.hash, content) {
                    // A drive may end soon after its last starts.
                    Err(ExportError::Short { .. }) if start > 0 => continue,
                    other => other?,
                };
                let path = self.out.join(format!("{id}.usdz"));
                output::write(&path, &archive(&scene)?)?;
                writeln!(out, "{}", path.display())?;
            }
        }
        // The wizard runs in a folder of its own.
        let folder = std::path::absolute(&self.out)?;
        let scenes =
            folder.to_str().with_context(|| format!("{} is not UTF-8", folder.display()))?;
        let deploy_dir = folder.join("deploy");
        output::create_dir(&deploy_dir)?;
        output::write(&deploy_dir.join("wildcity.yaml"), deploy(scenes, &self.address).as_bytes())?;
        writeln!(
            out,
            "AlpaSim: alpasim_wizard --config-dir {scenes} deploy=wildcity topology=1gpu driver=DRIVER"
        )?;
        writeln!(out, "Without the ground of the drives: +physics=disabled")?;
        Ok(())
    }
}

/// Reads recorded traffic. A track with an asset gets the asset's size, as it is drawn.
fn tracks(path: &Path, catalog: &Catalog) -> anyhow::Result<TracksFile> {
    let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
    let mut file = TracksFile::parse(&bytes).with_context(|| path.display().to_string())?;
    for track in &mut file.tracks {
        if let Some(hash) = &track.asset {
            let found =
                catalog.find_actor(hash).with_context(|| format!("track {:?}", track.id))?;
            let ActorBox { length_m, width_m, height_m } = found.description.box_;
            track.asset = Some(found.hash);
            track.size = [length_m, width_m, height_m];
        }
    }
    Ok(file)
}

/// A zip archive without compression, as USDZ is.
fn archive(files: &[(&str, String)]) -> anyhow::Result<Vec<u8>> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (name, content) in files {
        archive.start_file(*name, stored)?;
        archive.write_all(content.as_bytes())?;
    }
    Ok(archive.finish()?.into_inner())
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(number) if number > 0.0 && number.is_finite() => Ok(number),
        _ => Err("expected a positive number".to_owned()),
    }
}

/// A host and a port, as AlpaSim's configuration has them.
fn address(text: &str) -> Result<String, String> {
    let port = text.rsplit_once(':').filter(|(host, _)| !host.is_empty()).map(|(_, port)| port);
    match port.map(str::parse::<u16>) {
        Some(Ok(1..)) => Ok(text.to_owned()),
        _ => Err("expected HOST:PORT, for example 127.0.0.1:6000".to_owned()),
    }
}
