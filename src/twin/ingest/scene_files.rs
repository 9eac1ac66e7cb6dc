//! The files of a scene that consists of several.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::hash_reader::HashReader;
use super::unpack_budget::UnpackBudget;
use super::{FileError, IngestError, Progress, ReadLimits, StopFlag, file};

/// Reads the files that a scene names.
pub(super) trait SceneFiles {
    /// Reads a whole file of at most `limit_bytes`. The name is relative to the folder of the file
    /// given first, with `/`. Each file may be read once.
    fn read(&mut self, name: &str, limit_bytes: u64) -> Result<Vec<u8>, IngestError>;

    /// Number of bytes that the scene may unpack.
    fn budget(&mut self) -> &mut UnpackBudget;

    /// Number of Gaussians that cover the triangles of a mesh.
    fn mesh_gaussians(&self) -> u32 {
        crate::limits::MESH_GAUSSIANS
    }
}

/// The files that a scene may name: paths by name.
pub type ListedFiles = BTreeMap<String, PathBuf>;

/// Whether a `/`-separated name is a plain path below the folder of the file that names it.
pub fn is_below_folder(name: &str) -> bool {
    let is_below = name.split('/').all(|step| !["", ".", ".."].contains(&step));
    is_below && !Path::new(name).is_absolute() && !name.contains(['\\', '\0'])
}

/// Further files of the scene, in the folder of the one given first, on the local disk.
pub(super) struct PartFiles<'a> {
    place: Place<'a>,
    /// Names of the files that were read.
    names: BTreeSet<String>,
    /// Hashes of the files that were read, in order; first that of the file given first.
    hashes: Vec<String>,
    read_bytes: u64,
    progress: Progress<'a>,
    budget: UnpackBudget,
    stop: StopFlag,
    mesh_gaussians: u32,
}

/// Where the files are.
enum Place<'a> {
    Folder(PathBuf),
    /// Anywhere, but only these.
    Listed(&'a ListedFiles),
}

impl<'a> PartFiles<'a> {
    /// The files that a scene may name.
    pub(super) fn new(first: &Path, limits: &ReadLimits<'a>, progress: Progress<'a>) -> Self {
        let folder = || first.parent().unwrap_or(Path::new("")).to_owned();
        Self {
            place: limits.listed.map_or_else(|| Place::Folder(folder()), Place::Listed),
            names: BTreeSet::new(),
            hashes: Vec::new(),
            read_bytes: 0,
            progress,
            budget: UnpackBudget::new(limits),
            stop: limits.stop.clone(),
            mesh_gaussians: limits.mesh_gaussians,
        }
    }

    /// The hash of one file, or the hash of the hashes of several.
    pub(super) fn hash(&self) -> String {
        match &self.hashes[..] {
            [one] => one.clone(),
            several => {
                let lines: String = several.iter().flat_map(|hash| [hash, "\n"]).collect();
                blake3::hash(lines.as_bytes()).to_hex().to_string()
            }
        }
    }

    /// The names of the files that were read in addition to the one given first.
    pub(super) fn into_names(self) -> BTreeSet<String> {
        self.names
    }

    /// Notes a file that was read.
    pub(super) fn add(&mut self, bytes: u64, hash: String) {
        self.hashes.push(hash);
        self.read_bytes += bytes;
        self.budget.read(bytes);
        // How many files follow is unknown, so that progress has no total.
        (self.progress)(self.read_bytes, self.read_bytes);
    }

    fn path(&self, name: &str) -> Result<PathBuf, FileError> {
        match &self.place {
            Place::Folder(folder) => {
                if !is_below_folder(name) {
                    return Err(FileError::OutsideFolder);
                }
                Ok(folder.join(name))
            }
            Place::Listed(listed) => listed.get(name).cloned().ok_or(FileError::NotListed),
        }
    }
}

impl SceneFiles for PartFiles<'_> {
    fn read(&mut self, name: &str, limit_bytes: u64) -> Result<Vec<u8>, IngestError> {
        let failed = |cause| IngestError::Part { name: name.into(), cause };
        if self.names.len() >= crate::limits::SCENE_PARTS {
            return Err(failed(FileError::TooMany { limit: crate::limits::SCENE_PARTS }));
        }
        let path = self.path(name).map_err(failed)?;
        // A name takes a few bytes, and a file any number: read once per name, a small file could
        // take any time.
        if !self.names.insert(name.to_owned()) {
            return Err(failed(FileError::Repeated));
        }
        let (file, file_bytes) = file::open(&path).map_err(failed)?;
        let mut input = HashReader::new(file, self.stop.clone());
        let bytes = file::read_at_most(&mut input, file_bytes, limit_bytes).map_err(failed)?;
        self.add(bytes.len() as u64, input.finish());
        Ok(bytes)
    }

    fn budget(&mut self) -> &mut UnpackBudget {
        &mut self.budget
    }

    fn mesh_gaussians(&self) -> u32 {
        self.mesh_gaussians
    }
}
