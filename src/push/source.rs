//! Reads one scene file and converts it to the twin's axes.

use std::any::Any;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use wildcity_scene::Gaussians;
use wildcity_scene::manifest::Provenance;
use wildcity_twin::ingest::{
    self, Axes, IngestError, Progress, ReadLimits, ReadScene, TrackedObject,
};

/// The axes and unit of a scene file, and how the user wrote them.
#[derive(Clone, Debug)]
pub struct SourceAxes {
    axes: Axes,
    options: [String; 2],
}

/// A scene file that waits to be read.
#[derive(Clone, Debug)]
pub struct SourceFile {
    /// Name for messages.
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
}

impl SourceAxes {
    /// Reads axes, as `y-down-z-forward` or nine numbers, and metres per unit of the file.
    ///
    /// # Errors
    /// The axes are not a rotation or reflection, or the scale is not a positive number.
    pub fn parse(axes: &str, scale: f64) -> Result<Self, IngestError> {
        let options = [format!("axes={axes}"), format!("scale={scale}")];
        Ok(Self { axes: axes.parse::<Axes>()?.scaled(scale)?, options })
    }

    /// Converts a scene that was read to the twin's axes.
    fn apply(&self, read: ReadScene) -> SourceScene {
        let ReadScene { mut gaussians, hash, parts } = read;
        self.axes.apply(&mut gaussians);
        SourceScene { gaussians, hash, parts }
    }

    /// The axes and the scale as options, for the provenance of a version.
    pub fn options(&self) -> &[String; 2] {
        &self.options
    }
}

/// Reads a scene file of any format, checks every Gaussian, and converts them to the twin's axes. The scene
/// may name the files below its folder.
///
/// # Errors
/// As [`ingest::read`].
pub fn read_scene(
    path: &Path,
    axes: &SourceAxes,
    progress: Progress<'_>,
) -> Result<SourceScene, IngestError> {
    let (gaussians, hash) = ingest::read_hashed(path, progress)?;
    Ok(axes.apply(ReadScene { gaussians, hash, parts: BTreeSet::new() }))
}

/// As [`read_scene`], within limits.
///
/// # Errors
/// As [`ingest::read_limited`].
pub(crate) fn read_limited(
    path: &Path,
    axes: &SourceAxes,
    limits: &ReadLimits<'_>,
    progress: Progress<'_>,
) -> Result<SourceScene, IngestError> {
    ingest::read_limited(path, limits, progress).map(|read| axes.apply(read))
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
    let limits = ReadLimits { mesh_gaussians, ..ReadLimits::of_own_file() };
    read_limited(path, axes, &limits, progress)
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
    objects.iter_mut().for_each(|object| axes.axes.apply(&mut object.gaussians));
    Ok((objects, hash))
}

/// The provenance of a version that is made from files with these hashes. It contains no time and no user,
/// so that the same content gives the same version.
pub fn provenance(hashes: &[String], mut options: Vec<String>, levels: bool) -> Provenance {
    let source = match hashes {
        [one] => one.clone(),
        several => blake3::hash(several.join("\n").as_bytes()).to_hex().to_string(),
    };
    if !levels {
        options.push("lod=off".to_owned());
    }
    Provenance { options, ..Provenance::of(format!("blake3:{source}")) }
}
