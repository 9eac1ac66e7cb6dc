//! `wildcity twin show`.

use std::io::{self, Write};

use wildcity_scene::Manifest;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Bounds;
use wildcity_twin::store::Version;

use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::output::{self, counted};
use crate::cli::time::utc;

/// Show the contents of a twin: counts, bounds in metres, hashes, and its chunks.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Show {
    /// The twin: NAME, or NAME@NUMBER for an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    #[command(flatten)]
    twins: Twins,

    /// Print the version and its whole manifest as one JSON object.
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  wildcity twin show street
  wildcity twin show street@2 --json | jq .manifest.provenance";

impl Show {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let version = catalog.version(&self.twin.name, self.twin.number)?;
        let mut out = output::stdout();
        if self.json {
            let Version { number, hash, created_us, manifest } = &version;
            let json = serde_json::json!({
                "number": number,
                "hash": hash,
                "created_us": created_us,
                "gaussians": manifest.gaussians(),
                "manifest": manifest,
            });
            writeln!(out, "{json:#}")?;
        } else {
            summary(&mut out, &version, version.manifest.alignment()?)?;
            table(&mut out, &version.manifest)?;
        }
        Ok(())
    }
}

fn summary(
    out: &mut impl Write,
    version: &Version,
    alignment: Option<Alignment>,
) -> io::Result<()> {
    let Version { number, hash, created_us, manifest } = version;
    let stored_bytes = manifest.stored_bytes();
    writeln!(out, "twin        {} version {number}", manifest.twin)?;
    writeln!(out, "manifest    {hash}")?;
    writeln!(out, "created     {}", utc(*created_us))?;
    writeln!(out, "gaussians   {}, SH degree {}", manifest.gaussians(), manifest.sh_degree)?;
    let chunks = counted(manifest.chunks.len(), "chunk");
    writeln!(out, "objects     {chunks}, {stored_bytes} bytes")?;
    let record = manifest.record;
    let bits = record.bits(manifest.sh_degree);
    writeln!(out, "record      {record}, {bits} bits per Gaussian before compression")?;
    if manifest.has_classes() {
        let labelled = manifest.chunks.iter().filter(|chunk| chunk.classes).count();
        writeln!(out, "classes     in {labelled} of {chunks}")?;
    }
    let sections = || manifest.chunks.iter().flat_map(|chunk| &chunk.sections);
    let count = sections().count();
    // A twin without Gaussians has no section.
    let max_level = sections().map(|section| section.level).max().unwrap_or(0);
    writeln!(
        out,
        "sections    {count}, levels of detail 0 to {max_level} (see `wildcity dev lod`)"
    )?;
    if !manifest.chunks.is_empty() {
        writeln!(out, "bounds      {}", metres(&manifest.bounds()))?;
    }
    let profile = &manifest.profile;
    writeln!(
        out,
        "profile     near={} far={} blur={} antialiased={} alpha_cap={} alpha_cut={} stop={} \
         tau_px={} reach_m={} sky_error={} background={}",
        profile.near,
        profile.far,
        profile.blur,
        profile.antialiased,
        profile.alpha_cap,
        profile.alpha_cut,
        profile.stop,
        profile.tau_px,
        profile.reach_m.map_or("none".to_owned(), |reach_m| reach_m.to_string()),
        profile.sky_error,
        profile.background.map(|c| c.to_string()).join(","),
    )?;
    if let Some(sky) = &manifest.sky {
        let image = sky.image.map_or("all".to_owned(), |image| image.to_string());
        writeln!(
            out,
            "sky         {}, {} bytes, appearance of image: {image}",
            &sky.object[..16],
            sky.bytes
        )?;
    }
    if let Some(views) = &manifest.views {
        writeln!(
            out,
            "views       {}, {} bytes",
            counted(views.images as usize, "recorded image"),
            views.image_bytes
        )?;
    }
    if let Some(rig) = &manifest.rig {
        let names: Vec<_> = rig.cameras.iter().map(|camera| camera.name.as_str()).collect();
        writeln!(out, "rig         {}: {}", rig.name, names.join(", "))?;
    }
    for trajectory in &manifest.trajectories {
        let keyframes = counted(trajectory.keyframes.len(), "keyframe");
        let length_m = trajectory.length_m();
        writeln!(out, "trajectory  {}: {keyframes}, {length_m:.1} m", trajectory.name)?;
    }
    if let Some(Alignment { new_from_old, metres_per_unit }) = alignment {
        let moved = new_from_old.position_m.to_array();
        let q = new_from_old.q_wxyz();
        writeln!(
            out,
            "alignment   {metres_per_unit:.6} m per unit of the capture, after q {q:.4?} and xyz {moved:.3?}"
        )?;
    }
    let provenance = &manifest.provenance;
    writeln!(out, "source      {}", provenance.source)?;
    writeln!(out, "builder     {} {}", provenance.builder, provenance.options.join(" "))
}

fn table(out: &mut impl Write, manifest: &Manifest) -> io::Result<()> {
    writeln!(
        out,
        "\n{:>12} {:>10} {:>12}  object            3-sigma box",
        "cell", "count", "bytes"
    )?;
    for chunk in &manifest.chunks {
        let cell = format!("{},{}", chunk.cell[0], chunk.cell[1]);
        let object = &chunk.object[..16];
        let bounds = metres(&chunk.bounds);
        writeln!(out, "{cell:>12} {:>10} {:>12}  {object}  {bounds}", chunk.count, chunk.bytes)?;
    }
    Ok(())
}

/// A box as text: `x -1.50..2.25  y ...  m`.
fn metres(bounds: &Bounds) -> String {
    let low = bounds.min_m;
    let high = bounds.max_m;
    let axis = |name, low, high| format!("{name} {low:.2}..{high:.2}");
    let axes = [axis("x", low.x, high.x), axis("y", low.y, high.y), axis("z", low.z, high.z)];
    format!("{} m", axes.join("  "))
}
