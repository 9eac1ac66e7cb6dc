//! `wildcity twin log`.

use std::collections::BTreeMap;
use std::io::{self, Write};

use crate::cli::directories::Twins;
use crate::cli::output;
use crate::cli::time::utc;
use wildcity_scene::manifest::Provenance;
use wildcity_twin::store::{LogEntry, StoreError};

/// Show all versions of a twin, oldest first: when and how each was made, from which version, and
/// the note of its push or the change of its edit.
#[derive(Debug, clap::Args)]
#[command(
    after_long_help = "Examples:\n  wildcity twin log street\n  wildcity twin log street --json | jq .created_us"
)]
pub(super) struct Log {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: String,

    #[command(flatten)]
    twins: Twins,

    /// Print one JSON object per line: number, hash, created_us, kind, parent, commit, note,
    /// change.
    #[arg(long)]
    json: bool,
}

impl Log {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = output::stdout();
        let catalog = self.twins.catalog()?;
        let mut provenances: BTreeMap<u64, Provenance> = BTreeMap::new();
        for entry in catalog.versions(&self.twin)? {
            match catalog.provenance(&self.twin, &entry) {
                Ok(provenance) => _ = provenances.insert(entry.number, provenance),
                // Its manifest was removed on purpose, and with it the note.
                Err(StoreError::GarbageCollected { .. }) => {}
                Err(error) => writeln!(io::stderr(), "version {}: no note: {error}", entry.number)?,
            }
            // Older builds, which did not show notes, gave edits the note of their base.
            let is_edit = entry.is_edit();
            let own = provenances.get(&entry.number);
            let note = own.and_then(Provenance::note).filter(|_| !is_edit);
            let base = entry.parent.and_then(|parent| provenances.get(&parent));
            let change = own
                .zip(base)
                .filter(|_| is_edit)
                .map(|(own, base)| added(own, base).join(", "))
                .unwrap_or_default();
            // A training commits as an edit does: only its options tell them apart.
            let is_training = ["blocks=", "refine="].iter().any(|how| change.starts_with(how));
            let how = if is_training { "training" } else { entry.kind_name() };
            let LogEntry { number, hash, created_us, commit, parent, .. } = &entry;
            if self.json {
                let line = serde_json::json!({
                    "number": number, "hash": hash, "created_us": created_us, "kind": how,
                    "parent": parent, "commit": commit, "note": note,
                    "change": (!change.is_empty()).then_some(&change),
                });
                writeln!(out, "{line}")?;
            } else {
                let from = parent.map_or(String::new(), |parent| format!(" of {parent}"));
                let how = format!("{how}{from}");
                let when = utc(*created_us);
                // A note may have several lines; a version has one.
                let text = note.unwrap_or(&change).replace(char::is_control, " ");
                let line = format!("{number:>6}  {when}  {how:<16}  {hash}  {text}");
                writeln!(out, "{}", line.trim_end())?;
            }
        }
        Ok(())
    }
}

/// The options that an edit has added to those of the version that it was made from; none if this
/// is no edit of that version.
fn added<'a>(own: &'a Provenance, base: &Provenance) -> &'a [String] {
    own.options.strip_prefix(&base.for_edit().options[..]).unwrap_or_default()
}
