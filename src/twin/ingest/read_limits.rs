//! Limits of reading a scene.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::IngestError;
use super::scene_files::ListedFiles;
use crate::limits;

/// Limits of reading a scene, and its resolution. The first three are for scenes from an untrusted
/// source.
#[derive(Clone, Debug)]
pub struct ReadLimits<'a> {
    /// The files that the scene may name; without a list, those below the folder of its own file.
    pub listed: Option<&'a ListedFiles>,
    /// Bytes of memory that compressed content may unpack to.
    pub memory_bytes: u64,
    pub stop: StopFlag,
    /// About how many Gaussians the triangles of a mesh become; triangles smaller than one
    /// Gaussian's share add more. Scenes of Gaussians keep theirs.
    pub mesh_gaussians: u32,
    /// Leaves out Gaussians outside their bounds; without it they are errors.
    pub drop_bad: bool,
    /// The level of detail of a streamed SOG that is read, 0 being the finest; without it that one.
    pub level: Option<u32>,
}

/// Tells readers of other threads to stop. Clones are one flag.
#[derive(Clone, Debug, Default)]
pub struct StopFlag(Arc<AtomicBool>);

impl ReadLimits<'_> {
    /// The limits of a file that the user of this machine named: its folder, all of the memory, any
    /// time.
    pub fn for_own_file() -> Self {
        Self {
            listed: None,
            memory_bytes: u64::MAX,
            stop: StopFlag::default(),
            mesh_gaussians: limits::MESH_GAUSSIANS,
            drop_bad: false,
            level: None,
        }
    }
}

impl StopFlag {
    /// Lets the readers end with [`IngestError::Stopped`], or an error that follows from it, soon.
    pub fn stop(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// # Errors
    /// [`IngestError::Stopped`] if the reading is to stop.
    pub(super) fn check(&self) -> Result<(), IngestError> {
        if self.0.load(Ordering::Relaxed) { Err(IngestError::Stopped) } else { Ok(()) }
    }
}
