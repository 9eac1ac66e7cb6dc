//! What a scene file says besides its Gaussians, as the commands print it; and `--drop-bad`.

use std::io::{self, Write};
use std::path::Path;

use wildcity_twin::ingest::{Antialiasing, FileNotes, IngestError};

use super::output::counted;

/// `--drop-bad`, for every command that reads scene files.
#[derive(Clone, Copy, Debug, clap::Args)]
pub(super) struct DropBad {
    /// Leave out Gaussians that cannot be drawn, such as those with NaN or a quaternion of zeros,
    /// and say how many. Without this option the file is refused.
    #[arg(long)]
    pub(super) drop_bad: bool,
}

/// Prints the warnings of a file to standard error.
pub(super) fn print_warnings(file: &Path, warnings: &[String]) -> io::Result<()> {
    let mut out = io::stderr().lock();
    let file = file.display();
    for warning in warnings {
        writeln!(out, "warning: {file}: {warning}")?;
    }
    Ok(())
}

/// Prints the notes of a file to standard error.
pub(super) fn print(file: &Path, notes: &FileNotes) -> io::Result<()> {
    print_warnings(file, &notes.warnings)?;
    let mut out = io::stderr().lock();
    let file = file.display();
    for assumed in &notes.assumed {
        writeln!(out, "note: {file}: {assumed}")?;
    }
    if notes.dropped > 0 {
        let count = notes.dropped as usize;
        writeln!(
            out,
            "warning: {file}: {} left out, which cannot be drawn",
            counted(count, "Gaussian")
        )?;
    }
    if let Some(Antialiasing { blur_px2: Some(blur_px2), said_by }) = &notes.antialiasing {
        writeln!(
            out,
            "note: {file}: {said_by}: the render profile has antialiased=true and blur={blur_px2}, unless --set changes it"
        )?;
    }
    Ok(())
}

/// The error of a scene file, with the option that accepts it.
pub(super) fn explained<T>(read: Result<T, IngestError>) -> anyhow::Result<T> {
    match read {
        Err(IngestError::Values(bad)) => {
            Err(anyhow::anyhow!("{bad}; --drop-bad leaves such Gaussians out"))
        }
        read => read.map_err(anyhow::Error::from),
    }
}
