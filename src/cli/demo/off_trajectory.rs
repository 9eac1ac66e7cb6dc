//! `wildcity demo --off-trajectory`: views off the drive from a degraded copy of the street, as
//! rendered and repaired.

use std::io::Write;
use std::path::Path;

use wildcity_eval::BesideViews;
use wildcity_repair::{LoadOptions, Models};

use crate::cli::output;

/// The model that comes with the program, and its manifest.
const MODEL: [(&str, &[u8]); 2] = [
    ("repair.json", include_bytes!("../../../scenes/repair.json")),
    ("repair.onnx", include_bytes!("../../../scenes/repair.onnx")),
];
/// Name of the model in its manifest.
pub(super) const MODEL_NAME: &str = "street-repair";

/// Writes the files of the model to a directory, and reads its manifest. Loads nothing.
pub(super) fn model(dir: &Path, options: LoadOptions) -> anyhow::Result<Models> {
    output::create_dir(dir)?;
    for (name, bytes) in MODEL {
        output::write(&dir.join(name), bytes)?;
    }
    Ok(Models::read(&[dir.join(MODEL[0].0)], options)?)
}

/// Writes a picture for each station, and prints a table.
pub(super) fn show(views: &BesideViews, dir: &Path) -> anyhow::Result<()> {
    let mut table = output::stdout();
    let names = views.cameras.map(|name| format!("{name:>12}")).join("");
    writeln!(table, "{:<10} {names}", "PSNR in dB")?;
    for (kind, psnr_db) in &views.psnr_db {
        writeln!(table, "{kind:<10} {}", psnr_db.map(|db| format!("{db:>12.2}")).join(""))?;
    }
    let kinds: Vec<&str> = views.psnr_db.iter().map(|(kind, _)| *kind).collect();
    writeln!(table, "rows of the pictures: {}, true", kinds.join(", "))?;
    for (station_m, picture) in &views.pictures {
        let path = dir.join(format!("beside_{station_m:03.0}.png"));
        let png = wildcity_session::png(picture, picture.width(), picture.height());
        output::write(&path, &png.map_err(anyhow::Error::msg)?)?;
        writeln!(table, "look at    {}", path.display())?;
    }
    Ok(())
}
