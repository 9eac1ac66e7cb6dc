//! The request for a push, and the checks that need neither its files nor the twin.

use std::collections::BTreeSet;

use wildcity_scene::geometry::Pose;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::rig::is_name;
use wildcity_scene::{RecordFormat, RenderProfile};

use crate::error::PushError;
use crate::frame::Frame;
use crate::limits;
use crate::source::SourceAxes;

/// Request for a push.
#[derive(Clone, Debug)]
pub struct PushRequest {
    /// Chosen by the client; see [`crate::default_id`] for the id of a push without one.
    pub id: Option<String>,
    /// Name of the twin. A twin that does not exist is made.
    pub twin: String,
    /// BLAKE3 of everything that the client asked for: two requests of the same hash are the same
    /// push.
    pub request_hash: blake3::Hash,
    /// The files, which become one scene.
    pub files: Vec<RequestedFile>,
    /// The frame of the files and of [`PushRequest::preview_poses`].
    pub frame: Frame,
    /// Version that the scene was trained from; the latest if there is none.
    pub base: Option<u64>,
    /// The cells that the push replaces.
    pub cells: CellSelection,
    /// How Gaussians are stored; as in the rest of the twin if there is none.
    pub record: Option<RecordFormat>,
    /// Whether levels of detail are made.
    pub levels: bool,
    /// Changes of the twin's render profile, each as `near=0.2`.
    pub profile: Vec<String>,
    /// Description of the version, for people.
    pub note: Option<String>,
    /// `world_from_rig` of the poses of the preview; some along the twin's trajectories if there
    /// are none.
    pub preview_poses: Option<Vec<Pose>>,
    /// The push is refused if the images of a pose differ by more than this PSNR, in dB.
    pub min_psnr_db: Option<f64>,
    /// Whether Gaussians outside their bounds are left out; without it the push is refused.
    pub drop_bad: bool,
}

/// One file of a push.
#[derive(Clone, Debug)]
pub struct RequestedFile {
    /// Id of the upload.
    pub upload: String,
    /// The axes and unit of the file.
    pub axes: SourceAxes,
    /// The name by which other files of the push name it, if that is not the upload's. It is never
    /// used as a path.
    pub name: Option<String>,
}

/// Which cells a push replaces.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CellSelection {
    /// The cells that its Gaussians are in.
    Touched,
    /// These cells (x, y). Gaussians elsewhere are left out.
    These(BTreeSet<[i32; 2]>),
    /// All cells of the twin.
    All,
}

impl PushRequest {
    /// Checks everything that can be checked without the files and the twin.
    ///
    /// # Errors
    /// Names the first field that is outside its limits or cannot be understood.
    pub fn check(&self) -> Result<(), PushError> {
        let out_of_range = |field: &str, must: String| {
            Err(PushError::OutOfRange { field: field.to_owned(), must })
        };
        check_files(&self.files)?;
        if matches!(&self.cells, CellSelection::These(cells) if cells.is_empty()) {
            return out_of_range(
                "cells",
                "empty; leave it out, or name at least one cell".to_owned(),
            );
        }
        // Tried on the default profile: a setting is valid or not, whatever the others are. The
        // base, which is not known here, gets them in the pipeline.
        for (index, setting) in self.profile.iter().enumerate() {
            RenderProfile::default().set(setting).map_err(|error| PushError::InvalidField {
                field: format!("profile[{index}]"),
                reason: error.to_string(),
            })?;
        }
        // Characters and not bytes: a note in Japanese may be as long as one in English.
        if self.note.as_ref().is_some_and(|note| note.chars().count() > limits::NOTE_CHARS) {
            return out_of_range("note", format!("longer than {} characters", limits::NOTE_CHARS));
        }
        if let Some(poses) = &self.preview_poses
            && poses.len() > limits::PREVIEW_MAX_POSES
        {
            let must = format!("{} poses; at most {}", poses.len(), limits::PREVIEW_MAX_POSES);
            return out_of_range("golden.poses", must);
        }
        // Both become keys of the queue, and the twin becomes a path of the store.
        for (field, name) in [("id", self.id.as_ref()), ("twin", Some(&self.twin))] {
            if let Some(name) = name
                && !is_name(name)
            {
                return Err(PushError::InvalidName { field, name: name.clone() });
            }
        }
        Ok(())
    }
}

/// Checks the number of files of one push, and their names.
pub(crate) fn check_files(files: &[RequestedFile]) -> Result<(), PushError> {
    if !(1..=limits::PUSH_FILES).contains(&files.len()) {
        let must = format!("{} entries; 1 to {} are accepted", files.len(), limits::PUSH_FILES);
        return Err(PushError::OutOfRange { field: "files".to_owned(), must });
    }
    let is_bad = |name: &String| {
        // The name is only compared with the names within other files, so slashes and dots are
        // harmless. Control characters would reach logs and terminals.
        !(1..=limits::FILE_NAME_BYTES).contains(&name.len()) || name.chars().any(char::is_control)
    };
    let names = files.iter().map(|file| file.name.as_ref());
    match names
        .enumerate()
        .find_map(|(index, name)| name.filter(|name| is_bad(name)).map(|_| index))
    {
        None => Ok(()),
        Some(index) => Err(PushError::OutOfRange {
            field: format!("files[{index}].name"),
            must: format!(
                "no name of a file; 1 to {} bytes without control characters are accepted",
                limits::FILE_NAME_BYTES
            ),
        }),
    }
}

/// A render profile with some settings changed, each given as `near=0.2`.
///
/// # Errors
/// Names the first setting that cannot be used.
pub fn profile_with(
    mut profile: RenderProfile,
    settings: &[String],
) -> Result<RenderProfile, ProfileError> {
    for setting in settings {
        profile.set(setting)?;
    }
    Ok(profile)
}
