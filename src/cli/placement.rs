//! The transform from the axes of a capture to those of its twin.

use anyhow::Context;

use wildcity_scene::align::Alignment;
use wildcity_scene::manifest::Provenance;
use wildcity_twin::ingest::Axes;
use wildcity_twin::store::{Catalog, Version};

use crate::cli::directories::{TwinVersion, Twins};

/// The transform from the axes of a capture to those of its twin: that of the twin's import, or
/// that of the options.
#[derive(Debug, clap::Args)]
pub(super) struct Placement {
    /// The twin that was trained from the capture: its version records with which axes and scale it
    /// was imported, and how it was aligned.
    #[arg(long, value_name = "TWIN", conflicts_with_all = ["axes", "scale"])]
    twin: Option<TwinVersion>,

    /// Directions of the capture's axes, in the form of `wildcity import --axes`; without --twin
    /// [default: y-down-z-forward]
    #[arg(long, value_name = "AXES", allow_hyphen_values = true)]
    axes: Option<String>,

    /// Metres per unit of the capture, applied after --axes; without --twin [default: 1]
    #[arg(long, value_name = "M")]
    scale: Option<f64>,

    #[command(flatten)]
    twins: Twins,
}

impl Placement {
    /// The change of axes and unit.
    pub(super) fn alignment(&self) -> anyhow::Result<Alignment> {
        match &self.twin {
            None => {
                let axes = self.axes.as_deref().unwrap_or("y-down-z-forward");
                imported(axes, self.scale.unwrap_or(1.0))
            }
            Some(twin) => {
                let catalog = self.twins.catalog()?;
                let version = catalog.version(&twin.name, twin.number)?;
                from_version(&catalog, &version)
            }
        }
    }
}

/// The change of a version's axes and unit since its capture was imported.
pub(super) fn from_version(catalog: &Catalog, version: &Version) -> anyhow::Result<Alignment> {
    let about = || format!("twin {} version {}", version.manifest.twin, version.number);
    let import = original_import(catalog, version).with_context(about)?;
    let aligned = version.manifest.alignment().with_context(about)?;
    import.placed(aligned).with_context(about)
}

/// The change of axes and unit of `--axes` and `--scale`.
pub(super) fn imported(axes: &str, scale: f64) -> anyhow::Result<Alignment> {
    let parsed: Axes = axes.parse()?;
    let alignment = parsed.scaled(scale)?.alignment();
    alignment.with_context(|| {
        format!("--axes {axes:?} mirrors the scene, and a mirrored camera has no pose: give axes without a mirror")
    })
}

/// The options of an import that place its capture.
#[derive(Debug, PartialEq)]
struct Import {
    axes: String,
    scale: f64,
}

/// The import that a version was made from by pushes and edits.
///
/// # Errors
/// An older version cannot be read; a push of its files had other axes or another scale, so that
/// there are two captures; or a push lost the alignment of the previous version, as pushes did
/// before versions recorded it.
fn original_import(catalog: &Catalog, version: &Version) -> anyhow::Result<Import> {
    let twin = &version.manifest.twin;
    let log = catalog.versions(twin)?;
    let parent_of = |number| log.iter().find(|entry| entry.number == number)?.parent;
    let import = Import::from_provenance(&version.manifest.provenance)?;
    let remedies = |parent: u64| {
        format!(
            "name an older version; or roll back (`wildcity twin rollback {twin} {parent}`) and push again; or give --axes \
             and --scale (without --twin), which then include its alignment"
        )
    };
    let mut number = version.number;
    let mut is_aligned = version.manifest.alignment()?.is_some();
    // A parent is older: a log that says otherwise is damaged, and must not loop here.
    while let Some(parent) = parent_of(number).filter(|parent| *parent < number) {
        let before = catalog.version(twin, Some(parent)).with_context(|| {
            format!(
                "it was made from version {parent}, which cannot be read: give --axes and --scale"
            )
        })?;
        let was_aligned = before.manifest.alignment()?.is_some();
        anyhow::ensure!(
            // The version has lost an alignment that its parent had: a push does not say it.
            is_aligned || !was_aligned,
            "version {number} was pushed, and does not say how version {parent} was aligned: {}",
            remedies(parent)
        );
        anyhow::ensure!(
            import == Import::from_provenance(&before.manifest.provenance)?,
            "version {number} was pushed with other axes or another scale than version {parent}: {}",
            remedies(parent)
        );
        number = parent;
        is_aligned = was_aligned;
    }
    Ok(import)
}

impl Import {
    /// The transform from the axes of the capture to those of a twin that was aligned since.
    fn placed(&self, aligned: Option<Alignment>) -> anyhow::Result<Alignment> {
        // The import comes first, and the alignment moves what it has made.
        let capture = imported(&self.axes, self.scale)?;
        Ok(aligned.map_or(capture, |aligned| aligned.after(&capture)))
    }

    /// The options that a version records for the files that it was made from.
    fn from_provenance(provenance: &Provenance) -> anyhow::Result<Self> {
        let one = |key: &str, default: &'static str| -> anyhow::Result<String> {
            let options = &provenance.options;
            let mut found: Vec<&str> =
                options.iter().filter_map(|option| option.strip_prefix(key)).collect();
            // Each push repeats the option: equal ones are one.
            found.dedup();
            match found[..] {
                [] => Ok(default.to_owned()),
                [value] => Ok(value.to_owned()),
                _ => anyhow::bail!(
                    "its files were imported with different {key}: give --axes and --scale"
                ),
            }
        };
        let text = one("scale=", "1")?;
        let scale = text.parse().with_context(|| format!("scale={text}"))?;
        Ok(Self { axes: one("axes=", "identity")?, scale })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn provenance(options: &[&str]) -> Provenance {
        let options = options.iter().map(|&option| option.to_owned()).collect();
        Provenance { options, ..Provenance::new("test".into()) }
    }

    #[test]
    fn a_capture_goes_where_its_twin_went() {
        let made =
            Import::from_provenance(&provenance(&["axes=y-down-z-forward", "scale=2", "note=one"]));
        let aligned = "0,0,3,1,0,0,0,0.5".parse().unwrap();
        let alignment = made.unwrap().placed(Some(aligned)).unwrap();
        // 1 down is -2 m up; 3 more, and half of it.
        let at = alignment.point_m(DVec3::new(1.0, 1.0, 4.0));
        assert!((at - DVec3::new(1.0, 4.0, 0.5)).length() < 1e-12, "{at}");
    }

    #[test]
    fn mirrors_and_different_files_are_refused() {
        let mirrored = Import::from_provenance(&provenance(&["axes=y-up-z-forward"]))
            .unwrap()
            .placed(None)
            .unwrap_err();
        assert!(mirrored.to_string().contains("mirror"), "{mirrored}");
        let options = ["axes=identity", "scale=1", "axes=y-down-z-forward", "scale=1"];
        let several = Import::from_provenance(&provenance(&options)).unwrap_err();
        assert!(several.to_string().contains("--axes and --scale"), "{several}");
    }
}
