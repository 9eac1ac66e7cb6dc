//! `wildcity twin fsck`.

use std::io::{self, Write};

use crate::cli::directories::Twins;
use crate::cli::output::{self, counted};
use crate::cli::progress;
use wildcity_twin::store::{FsckReport, RecordSetAside};

/// Check a twin: read every object of every version and compare it with its hash, and check the
/// log.
///
/// Prints damaged objects, lost versions, and objects that no version refers to. The exit code is 0
/// if everything is as it was committed, and 1 otherwise. To repair objects, import the same source
/// again with the same options. Objects without a version are not damage: `wildcity twin gc`
/// removes them.
#[derive(Debug, clap::Args)]
#[command(
    after_long_help = "Examples:\n  wildcity twin fsck street && wildcity serve\n  wildcity twin fsck street --repair"
)]
pub(super) struct Fsck {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: String,

    #[command(flatten)]
    twins: Twins,

    /// Before the check, set aside the newest log record if it cannot be read, and those before it
    /// that cannot be read. The version before them becomes the latest again.
    #[arg(long)]
    repair: bool,

    /// Print the result as one JSON object.
    #[arg(long)]
    json: bool,
}

impl Fsck {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        // Before the check, which then tells whether the rest of the log is sound.
        if self.repair {
            for RecordSetAside { number, error, path } in catalog.repair_log(&self.twin)? {
                let path = path.display();
                writeln!(
                    io::stderr(),
                    "set the record of version {number} aside as {path}: {error}"
                )?;
            }
        }
        let bar = progress::bytes("checking");
        let checked = catalog.fsck(&self.twin, &mut progress::show(&bar))?;
        bar.finish_and_clear();
        let mut out = output::stdout();
        if self.json {
            writeln!(out, "{}", json(&checked))?;
        } else {
            self.print(&mut out, &checked)?;
        }
        let damaged = checked.verified.damaged.len();
        let objects = checked.verified.objects;
        anyhow::ensure!(damaged == 0, "{damaged} of {objects} objects are damaged");
        anyhow::ensure!(checked.is_sound(), "the log of twin {} is damaged", self.twin);
        Ok(())
    }

    fn print(&self, out: &mut impl Write, checked: &FsckReport) -> io::Result<()> {
        for damage in &checked.verified.damaged {
            writeln!(out, "damaged {}: {}", damage.object, damage.error)?;
        }
        for gap in &checked.gaps {
            writeln!(out, "lost version {gap}: the log has later ones, but not it")?;
        }
        for (number, error) in &checked.records {
            writeln!(out, "lost version {number}: {error}")?;
        }
        if !checked.collected.is_empty() {
            let versions = counted(checked.collected.len(), "old version");
            writeln!(out, "removed by gc: {versions}")?;
        }
        let garbage = checked.unreferenced;
        if garbage.objects > 0 {
            let objects = counted(garbage.objects as usize, "object");
            writeln!(out, "without a version: {objects}, {} bytes", garbage.bytes)?;
        }
        if checked.staging {
            writeln!(out, "a commit is being made, or was killed: the next start cleans up")?;
        }
        if checked.is_sound() {
            let objects = counted(checked.verified.objects, "object");
            let bytes = checked.verified.bytes;
            writeln!(out, "twin {}: {objects}, {bytes} bytes of chunks, all sound", self.twin)?;
        }
        Ok(())
    }
}

fn json(checked: &FsckReport) -> serde_json::Value {
    let damaged = checked.verified.damaged.iter().map(
        |damage| serde_json::json!({ "object": damage.object, "error": damage.error.to_string() }),
    );
    let records = checked
        .records
        .iter()
        .map(|(number, error)| serde_json::json!({ "number": number, "error": error.to_string() }));
    serde_json::json!({
        "sound": checked.is_sound(),
        "objects": checked.verified.objects,
        "chunk_bytes": checked.verified.bytes,
        "damaged": damaged.collect::<Vec<_>>(),
        "gaps": checked.gaps,
        "records": records.collect::<Vec<_>>(),
        "collected": checked.collected,
        "unreferenced_objects": checked.unreferenced.objects,
        "unreferenced_bytes": checked.unreferenced.bytes,
        "staging": checked.staging,
    })
}
