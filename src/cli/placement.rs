//! From the axes of a capture to those of its twin.

use anyhow::Context;

use wildcity_scene::align::Alignment;
use wildcity_scene::manifest::Provenance;
use wildcity_twin::ingest::Axes;
use wildcity_twin::store::{Catalog, Version};

use crate::cli::directories::{TwinVersion, Twins};

/// From the axes of a capture to those of its twin: as the twin was made, or as the options say.
#[derive(Debug, clap::Args)]
pub(super) struct Placement {
    /// The twin that was trained from the capture: its version says with which axes and scale it was imported, and how
    /// it was aligned.
    #[arg(long, value_name = "TWIN", conflicts_with_all = ["axes", "scale"])]
    twin: Option<TwinVersion>,

    /// Directions of the capture's axes, as of `wildcity import`; without --twin [default: y-down-z-forward]
    #[arg(long, value_name = "AXES", allow_hyphen_values = true)]
    axes: Option<String>,

    /// Metres per unit of the capture, as of `wildcity import`; without --twin [default: 1]
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
                of_version(&catalog, &version)
            }
        }
    }
}

/// The change of a version's axes and unit since its files were imported.
pub(super) fn of_version(catalog: &Catalog, version: &Version) -> anyhow::Result<Alignment> {
    let about = || format!("twin {} version {}", version.manifest.twin, version.number);
    check_lineage(catalog, version).with_context(about)?;
    of_provenance(&version.manifest.provenance).with_context(about)
}

/// The change of axes and unit of `--axes` and `--scale`.
pub(super) fn imported(axes: &str, scale: f64) -> anyhow::Result<Alignment> {
    let parsed: Axes = axes.parse()?;
    let alignment = parsed.scaled(scale)?.alignment();
    alignment.with_context(|| {
        format!("--axes {axes:?} mirrors the scene, and a mirrored camera has no pose: give axes without a mirror")
    })
}

/// Checks that a version says how all of it was made. A push of some cells replaces the provenance of its base by that of
/// the pushed files, which are in the twin's axes already.
fn check_lineage(catalog: &Catalog, version: &Version) -> anyhow::Result<()> {
    let twin = &version.manifest.twin;
    let log = catalog.versions(twin)?;
    let parent_of = |number| log.iter().find(|entry| entry.number == number)?.parent;
    let mut options = version.manifest.provenance.options.clone();
    let mut number = version.number;
    while let Some(parent) = parent_of(number).filter(|parent| *parent < number) {
        let before = catalog.version(twin, Some(parent)).with_context(|| {
            format!(
                "it was made from version {parent}, which cannot be read: give --axes and --scale"
            )
        })?;
        let before = before.manifest.provenance.options;
        anyhow::ensure!(
            options.starts_with(&before),
            "version {number} was pushed, and does not say how version {parent} was imported and aligned: name an older \
             version, or give --axes and --scale"
        );
        options = before;
        number = parent;
    }
    Ok(())
}

/// Follows the options with which a version was made: axes and scale of the import, then each alignment.
fn of_provenance(provenance: &Provenance) -> anyhow::Result<Alignment> {
    let values = |key: &str| -> Vec<&str> {
        provenance.options.iter().filter_map(|option| option.strip_prefix(key)).collect()
    };
    let one = |key: &str, default: &'static str| -> anyhow::Result<String> {
        let mut found = values(key);
        found.dedup();
        match found[..] {
            [] => Ok(default.to_owned()),
            [value] => Ok(value.to_owned()),
            _ => anyhow::bail!(
                "its files were imported with different {key}: give --axes and --scale"
            ),
        }
    };
    let scale = one("scale=", "1")?;
    let scale = scale.parse().with_context(|| format!("scale={scale}"))?;
    let mut alignment = imported(&one("axes=", "identity")?, scale)?;
    for text in values("align=") {
        alignment = text.parse::<Alignment>()?.after(&alignment);
    }
    Ok(alignment)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn provenance(options: &[&str]) -> Provenance {
        let options = options.iter().map(|&option| option.to_owned()).collect();
        Provenance { options, ..Provenance::of("test".into()) }
    }

    #[test]
    fn a_capture_goes_where_its_twin_went() {
        let made = provenance(&["axes=y-down-z-forward", "scale=2", "align=0,0,3,1,0,0,0,0.5"]);
        let alignment = of_provenance(&made).unwrap();
        // 1 down is -2 m up; 3 more, and half of it.
        let at = alignment.point_m(DVec3::new(1.0, 1.0, 4.0));
        assert!((at - DVec3::new(1.0, 4.0, 0.5)).length() < 1e-12, "{at}");
    }

    #[test]
    fn mirrors_and_different_files_are_refused() {
        let mirrored = of_provenance(&provenance(&["axes=y-up-z-forward"])).unwrap_err();
        assert!(mirrored.to_string().contains("mirror"), "{mirrored}");
        let several = ["axes=identity", "scale=1", "axes=y-down-z-forward", "scale=1"];
        let several = of_provenance(&provenance(&several)).unwrap_err();
        assert!(several.to_string().contains("--axes and --scale"), "{several}");
    }
}
