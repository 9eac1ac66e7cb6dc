//! The files of a scene that consists of several.

use std::io::Read;
use std::path::{Path, PathBuf};

use crate::limits;

use super::hash_reader::HashReader;
use super::unpack_budget::UnpackBudget;
use super::{FileError, IngestError, Progress, file};

/// Reads the files that a scene names.
pub(super) trait SceneFiles {
    /// Reads a whole file of at most `limit_bytes`. The name is relative to the folder of the file
    /// given first, with `/`.
    fn read(&mut self, name: &str, limit_bytes: u64) -> Result<Vec<u8>, IngestError>;

    /// How much the scene may unpack.
    fn budget(&mut self) -> &mut UnpackBudget;

    /// Number of Gaussians that cover the triangles of a mesh.
    fn mesh_gaussians(&self) -> u32 {
        limits::MESH_GAUSSIANS
    }
}

/// The folder of the file given first.
pub(super) struct Folder<'a> {
    path: PathBuf,
    /// Hashes of the files that were read, in order.
    hashes: Vec<String>,
    read_bytes: u64,
    progress: Progress<'a>,
    budget: UnpackBudget,
    mesh_gaussians: u32,
}

impl<'a> Folder<'a> {
    /// The folder of a file that was read, given its size and hash.
    pub(super) fn new(first: &Path, bytes: u64, hash: String, progress: Progress<'a>) -> Self {
        let path = first.parent().unwrap_or(Path::new("")).to_owned();
        let mut folder = Self {
            path,
            hashes: vec![hash],
            read_bytes: 0,
            progress,
            budget: UnpackBudget::default(),
            mesh_gaussians: limits::MESH_GAUSSIANS,
        };
        folder.add(bytes);
        folder
    }

    /// The same with another number of Gaussians for meshes.
    pub(super) fn with_mesh_gaussians(self, mesh_gaussians: u32) -> Self {
        Self { mesh_gaussians, ..self }
    }

    /// The hash of one file, or the hash of the hashes of several.
    pub(super) fn finish(self) -> String {
        match &self.hashes[..] {
            [one] => one.clone(),
            several => {
                let lines: String = several.iter().flat_map(|hash| [hash, "\n"]).collect();
                blake3::hash(lines.as_bytes()).to_hex().to_string()
            }
        }
    }

    fn add(&mut self, bytes: u64) {
        self.read_bytes += bytes;
        self.budget.read(bytes);
        (self.progress)(self.read_bytes, self.read_bytes);
    }
}

impl SceneFiles for Folder<'_> {
    fn read(&mut self, name: &str, limit_bytes: u64) -> Result<Vec<u8>, IngestError> {
        let failed = |cause| IngestError::Part { name: name.into(), cause };
        let is_below = name.split('/').all(|step| !["", ".", ".."].contains(&step));
        if !is_below || Path::new(name).is_absolute() || name.contains(['\\', '\0']) {
            return Err(failed(FileError::OutsideFolder));
        }
        if self.hashes.len() > limits::SCENE_PARTS {
            return Err(failed(FileError::TooMany { limit: limits::SCENE_PARTS }));
        }
        let (file, _) = file::open(&self.path.join(name)).map_err(failed)?;
        let mut input = HashReader::new(file);
        let bytes = file::read_at_most(input.by_ref(), limit_bytes).map_err(failed)?;
        self.hashes.push(input.finish());
        self.add(bytes.len() as u64);
        Ok(bytes)
    }

    fn budget(&mut self) -> &mut UnpackBudget {
        &mut self.budget
    }

    fn mesh_gaussians(&self) -> u32 {
        self.mesh_gaussians
    }
}
