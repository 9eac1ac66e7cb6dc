//! Reads one scene file and converts it to the twin's axes.

use std::any::Any;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use wildcity_scene::Gaussians;
use wildcity_scene::manifest::Provenance;
use wildcity_twin::ingest::{
    self, Axes, FileAxes, FileNotes, IngestError, Progress, ReadLimits, ReadScene, TrackedObject,
};
use wildcity_twin::store::Version;

/// The axes and unit of a scene file, and how the user wrote them.
#[derive(Clone, Debug, Default)]
pub struct SourceAxes {
    axes: Option<(Axes, String)>,
    metres_per_unit: Option<f64>,
}

/// A scene file that waits to be read.
#[derive(Clone, Debug)]
pub struct SourceFile {
    pub name: String,
    /// Path on the local disk.
    pub path: PathBuf,
    /// Size of the file, for progress.
    pub bytes: u64,
    /// Keeps the file from being removed for as long as it is held.
    pub guard: Arc<dyn Any + Send + Sync>,
}

/// The content of a scene file in the axes of the twin.
#[derive(Clone, Debug)]
pub struct SourceScene {
    /// The Gaussians, in metres.
    pub gaussians: Gaussians,
    /// BLAKE3 of the bytes that were read, in hex.
    pub hash: String,
    /// The names of the files that the scene file names.
    pub parts: BTreeSet<String>,
    /// The axes and the scale that were used, as options, for the provenance of a version.
    pub options: [String; 2],
    /// What the file says besides its Gaussians.
    pub notes: FileNotes,
}

impl SourceAxes {
    /// Reads axes, as `y-down-z-forward` or nine numbers, and metres per unit of the file.
    ///
    /// # Errors
    /// The axes are not a rotation or reflection, or the scale is not a positive number.
    pub fn parse(axes: &str, scale: f64) -> Result<Self, IngestError> {
        Self::given(Some(axes), Some(scale))
    }

    /// As [`Self::parse`]. Axes that are not given are those that the file records, or else the
    /// twin's; a scale that is not given is 1.
    ///
    /// # Errors
    /// As [`Self::parse`].
    pub fn given(axes: Option<&str>, metres_per_unit: Option<f64>) -> Result<Self, IngestError> {
        // Only to check the scale: the axes may be unknown until the file is read.
        Axes::IDENTITY.scaled(metres_per_unit.unwrap_or(1.0))?;
        let parsed = |text: &str| Ok::<_, IngestError>((text.parse::<Axes>()?, text.to_owned()));
        Ok(Self { axes: axes.map(parsed).transpose()?, metres_per_unit })
    }

    /// The axes and the unit with which the files of a version were imported. Those that it does
    /// not record are not given.
    ///
    /// # Errors
    /// Says why they cannot be used: its files had different ones, or they cannot be read.
    pub fn from_version(version: &Version) -> Result<Self, String> {
        let options = &version.manifest.provenance.options;
        let found = |key: &str| {
            let mut found: Vec<&str> =
                options.iter().filter_map(|option| option.strip_prefix(key)).collect();
            // Only neighbours are compared, which is enough: with two values anywhere, more than
            // one stays.
            found.dedup();
            found
        };
        let axes = found("axes=");
        let scales = found("scale=");
        if axes.len() > 1 || scales.len() > 1 {
            return Err(format!(
                "give axes and scale: the twin was made from files of different ones ({})",
                options.join(" ")
            ));
        }
        let unreadable = |error: String| {
            format!("give axes and scale: those of the twin cannot be read: {error}")
        };
        let scale = scales.first().map(|scale| {
            scale.parse().map_err(|error| unreadable(format!("scale {scale:?}: {error}")))
        });
        Self::given(axes.first().copied(), scale.transpose()?)
            .map_err(|error| unreadable(error.to_string()))
    }

    /// Whether both are given.
    pub fn is_complete(&self) -> bool {
        self.axes.is_some() && self.metres_per_unit.is_some()
    }

    /// Converts a scene that was read to the twin's axes. `default` has those of a file for which
    /// they are not given.
    fn apply(&self, read: ReadScene, default: &Self) -> Result<SourceScene, IngestError> {
        let ReadScene { mut gaussians, hash, parts, mut notes } = read;
        let (axes, text) = self.used_axes(default, &mut notes);
        let scale = self.used_scale(default, &mut notes);
        // Rotation and scale are one step, because each pass goes over every Gaussian and its
        // harmonics.
        axes.scaled(scale)?.apply(&mut gaussians);
        let options = [format!("axes={text}"), format!("scale={scale}")];
        Ok(SourceScene { gaussians, hash, parts, options, notes })
    }

    /// The given axes, or else those that the file records, or else the default; notes which ones
    /// if that may surprise.
    fn used_axes(&self, default: &Self, notes: &mut FileNotes) -> (Axes, String) {
        let of_file = notes.axes.as_ref();
        let other = |axes: &Axes| of_file.filter(|of_file| !axes.has_same_rotation(&of_file.axes));
        let is_assumed = of_file.is_some_and(|of_file| of_file.is_assumed);
        let mut assumed = None;
        let (used, warning) = match (&self.axes, of_file, &default.axes) {
            // Programs that do not keep to a specification are why the option exists.
            (Some((axes, text)), ..) => {
                let recorded = other(axes).filter(|_| !is_assumed);
                let warning = recorded.map(|FileAxes { axes: recorded, said_by, .. }| {
                    let recorded = recorded.option_text();
                    format!("{said_by} says axes {recorded}; the given ones, {text}, are used")
                });
                ((*axes, text.clone()), warning)
            }
            (None, Some(FileAxes { axes, said_by, is_assumed: false }), _) => {
                let text = axes.option_text();
                let warning = format!("{said_by}: axes {text} are used");
                ((*axes, text), Some(warning))
            }
            (None, _, Some((axes, text))) => {
                let also = other(axes).map_or(String::new(), |of_file| {
                    format!("; {} says {}", of_file.said_by, of_file.axes.option_text())
                });
                let says = format!("no axes are given: those of the twin, {text}, are used{also}");
                let warning = if also.is_empty() {
                    // Nothing contradicts them, so that they are as expected.
                    let is_told = !axes.has_same_rotation(&Axes::IDENTITY);
                    assumed = is_told.then_some(says);
                    None
                } else {
                    Some(says)
                };
                ((*axes, text.clone()), warning)
            }
            (None, Some(FileAxes { axes, said_by, .. }), None) => {
                let text = axes.option_text();
                let warning = format!(
                    "no axes are given, and the file records none: {text} are used, as {said_by} says; some programs keep \
                     the axes of the PLY (y-down-z-forward)"
                );
                ((*axes, text), Some(warning))
            }
            (None, None, None) => ((Axes::IDENTITY, "identity".to_owned()), None),
        };
        notes.warnings.extend(warning);
        notes.assumed.extend(assumed);
        if self.axes.is_none() {
            notes.warnings.append(&mut notes.axes_hints);
        }
        used
    }

    /// The given metres per unit, or else the default; notes it if that may surprise.
    fn used_scale(&self, default: &Self, notes: &mut FileNotes) -> f64 {
        // No scene file gives its unit here, so there are only two sources.
        let inherited = default.metres_per_unit.filter(|_| self.metres_per_unit.is_none());
        if let Some(scale) = inherited.filter(|scale| *scale != 1.0) {
            notes.assumed.push(format!("no scale is given: that of the twin, {scale}, is used"));
        }
        self.metres_per_unit.or(inherited).unwrap_or(1.0)
    }

    /// The axes and the scale as options, for the provenance of a version; those that are not given
    /// are `identity` and 1.
    pub fn options(&self) -> [String; 2] {
        let axes = self.axes.as_ref().map_or("identity", |(_, text)| text);
        [format!("axes={axes}"), format!("scale={}", self.metres_per_unit.unwrap_or(1.0))]
    }
}

/// Reads a scene file of any format within limits, checks every Gaussian, and converts them to the
/// twin's axes. `default` has the axes and the scale that are used if none are given.
///
/// # Errors
/// As [`ingest::read_limited`].
pub fn read_scene(
    path: &Path,
    axes: &SourceAxes,
    default: &SourceAxes,
    limits: &ReadLimits<'_>,
    progress: Progress<'_>,
) -> Result<SourceScene, IngestError> {
    axes.apply(ingest::read_limited(path, limits, progress)?, default)
}

/// As [`read_scene`], with another number of Gaussians for the triangles of a mesh.
///
/// # Errors
/// As [`ingest::read`].
pub fn read_actor(
    path: &Path,
    axes: &SourceAxes,
    mesh_gaussians: u32,
    progress: Progress<'_>,
) -> Result<SourceScene, IngestError> {
    let limits = ReadLimits { mesh_gaussians, ..ReadLimits::for_own_file() };
    read_scene(path, axes, &SourceAxes::default(), &limits, progress)
}

/// The tracked objects of a recorded drive, each in its own axes, and the file's BLAKE3 in hex.
///
/// # Errors
/// As [`ingest::read_tracked`].
pub fn read_tracked(
    path: &Path,
    axes: &SourceAxes,
    progress: Progress<'_>,
) -> Result<(Vec<TrackedObject>, String), IngestError> {
    let (mut objects, hash) = ingest::read_tracked(path, progress)?;
    let (file_axes, _) = axes.axes.clone().unwrap_or((Axes::IDENTITY, String::new()));
    // There is no twin to inherit from: an asset has axes of its own.
    let file_axes = file_axes.scaled(axes.metres_per_unit.unwrap_or(1.0))?;
    objects.iter_mut().for_each(|object| file_axes.apply(&mut object.gaussians));
    Ok((objects, hash))
}

/// The provenance of a version that is made from files with these hashes. It contains no time and
/// no user, so that the same content gives the same version.
pub fn provenance(hashes: &[String], mut options: Vec<String>, levels: bool) -> Provenance {
    // The hash of one file is the provenance itself, so that a user can compare it with `b3sum`.
    // The order of several counts, as it does for the content.
    let source = match hashes {
        [one] => one.clone(),
        several => blake3::hash(several.join("\n").as_bytes()).to_hex().to_string(),
    };
    if !levels {
        options.push("lod=off".to_owned());
    }
    Provenance { options, ..Provenance::new(format!("blake3:{source}")) }
}
